"""README and docs: commands are read by the program, marked ones run, links and imports hold.

A fenced sh block below the comment ``<!-- run -->`` is run, in an empty folder. Every other
`suite` line must be one that the command line accepts, and every `make` line a target; what stands
`suite so` within a sentence must be a command, with options that it has. The same holds for the
examples in help texts. The options of a training and of a fit must go together, and a folder is of
one run. The site is made of the same pages. Commands in docs/archive are those of an earlier
commit; only links are checked there.
"""

import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import io
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import suite
from eval.logs import files
from policies import shipped
from policies.formats import model_process
from policies.formats.policy_file import load_policy_checkpoint
from policies.spec import PolicySpec
from suite import cli
from suite.commands.train import resolve
from suite.common.usage import EXAMPLES
from suite.train.recipes import named_recipe, with_model
from suite.train.run import start_params
from tests import test_fuzz
from tests.support.judged_cells import cut_short
from tracks.common.files import plain
from tracks.common.work import cluster
from tracks.formats import custom, mesh_reader

ROOT = Path(__file__).resolve().parents[3]
ARCHIVE = sorted((ROOT / "docs/archive").glob("*.md"))
PAGES = [
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if page not in ARCHIVE),
]
BLOCK = re.compile(r"(<!-- run -->\n+)?```sh\n(.*?)```", re.DOTALL)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SENTENCE = re.compile(r"`suite ([^`]+)`")
MADE_UP = {"hello", "COMMAND"}
"""Commands that a page speaks of and that are none."""
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
BLOCKS = {
    f"{page.relative_to(ROOT)}-{number}": (bool(marked), body)
    for page, text in TEXTS.items()
    for number, (marked, body) in enumerate(BLOCK.findall(text))
}
"""Page and number -> whether the block is run, and its lines."""
BLOCKS["EXAMPLES"] = (False, "\n".join(line for lines in EXAMPLES.values() for line in lines))
RUNS = ("delta", "eval", "loop", "train")
"""Commands that refuse a folder --out with a run of another kind."""


def _commands(body):
    for line in body.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


@functools.cache
def _check(*words):
    match words:
        case ["suite", ("--help" | "--version")]:
            pass
        case ["suite", name, *args]:
            assert name in cli.COMMANDS, f"no command {name!r}"
            if "--help" not in args:
                # A vehicle of the user may be any.
                args = [re.sub(r"^[\w/]+\.toml$", "racer5", word) for word in args]
                _check_together(name, cli.parse(name, args)[1])
        case ["make", *targets]:
            for target in targets:
                assert "=" in target or re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target


def _check_together(name, config):
    """Refuse options of a training or a fit that do not go together."""
    if name == "delta":
        with_model(named_recipe(config.recipe), config.model, config.vehicle)
    elif name == "train":
        training = resolve(config)
        if config.init_from in shipped.names():
            start_params(load_policy_checkpoint(shipped.locate(config.init_from)), training.spec)


@contextlib.contextmanager
def _named(where):
    """Say where a wrong command stands."""
    try:
        yield
    except (AssertionError, KeyError, SystemExit, TypeError, ValueError) as error:
        raise AssertionError(f"{where}: {error}") from error


def test_every_command_is_one_that_exists():
    for where, (_, body) in BLOCKS.items():
        for words in _commands(body):
            with _named(f"{where}: {shlex.join(words)}"):
                _check(*words)


def test_no_page_gives_the_folder_of_another_run():
    """Who follows the pages one after the other would be refused."""
    runs = {}
    for where, (_, body) in BLOCKS.items():
        for _, name, *args in _commands(body):
            if where.startswith(("EXAMPLES", "docs/reference")) or "--out" not in args:
                continue
            if name in RUNS:
                config = cli.parse(name, args)[1]
                # Processes share a training.
                shared = {"train": {"process_options": None}}
                run = (name, dataclasses.replace(config, **shared.get(name, {})))
                first, place = runs.setdefault(config.out, (run, where))
                assert first == run, f"{place} and {where}: --out {config.out}"


@functools.cache
def _options(name):
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        cli.main([name, "--help"])
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", said.getvalue()))


def _check_sentence(text):
    name, *words = text.split()
    if name in MADE_UP or name.startswith("-"):
        return
    assert name in cli.COMMANDS, f"no command {name!r}"
    if name == "reproduce" and words[1:]:  # its options are its experiment's
        _check("suite", name, *words)
        return
    for word in words:
        if re.fullmatch(r"--[a-z][a-z-]*", word) and word != "--help":
            assert word in _options(name), f"suite {name} has no option {word}"


def test_commands_within_a_sentence_exist_and_none_hides_in_another_fence():
    for page, text in TEXTS.items():
        for kind, body in FENCE.findall(text):
            hides = kind != "sh" and re.match(r"(suite|make|pip) ", body)
            assert not hides, f"{page.name}: fence it with ```sh: {body}"
        for words in SENTENCE.findall(FENCE.sub("", text)):
            with _named(f"{page.name}: suite {words}"):
                _check_sentence(words)


def test_what_does_not_exist_is_found():
    for text in ("nothing", "eval --trails 3", "view runs/x --giff"):
        with pytest.raises(AssertionError):
            _check_sentence(text)
    for line in ("suite nothing", "suite info --x", "make tea"):
        with pytest.raises((AssertionError, SystemExit)):
            _check(*line.split())


@pytest.mark.parametrize("where", [where for where, (marked, _) in BLOCKS.items() if marked])
def test_marked_commands_run(where, tmp_path, monkeypatch, capfd):
    """One after the other in this process, where what the first compiles the next one has."""
    cut_short(monkeypatch, 0.6)
    monkeypatch.chdir(tmp_path)
    for program, *words in _commands(BLOCKS[where][1]):
        assert program == "suite" and cli.main(words) == 0, (words, capfd.readouterr().err)


def test_python_on_a_page_imports_what_there_is_and_calls_it_as_defined():
    fences = [re.findall(r"```python\n(.*?)```", text, re.DOTALL) for text in TEXTS.values()]
    trees = [ast.parse(body) for bodies in fences for body in bodies]
    defined = {f"suite.{name}": getattr(suite, name) for name in suite.__all__}
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = importlib.import_module(node.module)
            defined |= {alias.name: getattr(module, alias.name) for alias in node.names}
    bound = set()
    for call in (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = ast.unparse(call.func)
        if name in defined or name.startswith("suite."):
            keywords = {str(word.arg): word.value for word in call.keywords}
            with _named(ast.unparse(call)):
                inspect.signature(defined[name]).bind(*call.args, **keywords)
            bound.add(name)
    assert "suite.evaluate_policy" in bound


def test_the_card_of_the_default_policy_has_rows_of_the_page_of_its_results():
    card = (ROOT / "policies/shipped/race/card.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| race \|(.*)$", card, re.MULTILINE)
    page = (ROOT / "docs/results/table2.md").read_text(encoding="utf-8")
    assert len(rows) == 12 and all(f"| ours |{row}" in page for row in rows)


def test_the_page_of_policies_has_every_key_of_the_spec_with_its_default():
    (text,) = re.findall(r"```json\n(.*?)```", TEXTS[ROOT / "docs/policies.md"], re.DOTALL)
    assert json.loads(text)["spec"] == plain(PolicySpec())


def test_the_page_of_promises_has_the_limits_of_the_code():
    promised = TEXTS[ROOT / "docs/reliability.md"]
    gates, rows, cells = custom.MOST_TABLES, files.MOST_ROWS, files.MOST_CELLS
    for limits in (
        f"limits of {mesh_reader.READ_S:g} s and {mesh_reader.MEMORY_BYTES / 2**30:g} GB",
        f"at most {gates:,} gates and {gates:,} solids of each kind",
        f"at most {rows / 1e6:g} million rows and {cells / 1e6:g} million values",
        f"{model_process.LOAD_S:g} s to load, {model_process.ANSWER_S:g} s for an answer, and "
        f"{model_process.MEMORY_BYTES / 2**30:g} GB",
        f"ends within {cluster.ANSWER_S + cluster.GRACE_S:g} s",
        f"damaged files of {len((*test_fuzz.KINDS, *test_fuzz.FOREIGN))} kinds",
        f"refused with one line within {test_fuzz.WITHIN_S:g} s",
    ):
        assert limits in promised


def test_every_page_installs_optional_packages_in_one_way():
    """`pip install '.[cuda]'` would replace the editable install of `make env`."""
    for page, text in TEXTS.items():
        assert not re.search(r"pip install ['\"]?\.(?!/)", text), page.name


def test_links_within_the_repository_lead_somewhere():
    for page in (*PAGES, *ARCHIVE):
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.extended
def test_the_site_is_whole_and_loads_nothing_from_elsewhere(tmp_path):
    # The tool says that its own next version may never come; nothing of ours hangs on that.
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in [*PAGES[1:], *ARCHIVE]:
        assert (tmp_path / page.relative_to(ROOT / "docs").with_suffix(".html")).is_file()
    index = (tmp_path / "search/search_index.json").read_text(encoding="utf-8")
    assert '"results/table2.html' in index and '"archive/' not in index
    tag = r"""<(?:script|img|link|iframe)[^>]*(?:src|href)=["']?(?:https?:)?//"""
    loads = tag + r"""|url\(["']?https?:|@import"""
    for path in tmp_path.rglob("*"):
        if path.suffix in (".html", ".css"):
            found = re.search(loads, path.read_text(encoding="utf-8"))
            assert found is None, f"{path.name}: {found}"
