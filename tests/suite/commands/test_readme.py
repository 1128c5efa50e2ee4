"""README and docs: commands are read by the program, marked ones run, links and imports hold.

A fenced sh block below the comment ``<!-- run -->`` is run, in an empty folder. Every other
`suite` line must be one that the command line accepts, and every `make` line a target; what stands
`suite so` within a sentence must be a command, with options that it has. The site is made of the
same pages. Commands in docs/archive are those of an earlier commit; only links are checked there.
"""

import ast
import contextlib
import functools
import importlib
import io
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from suite import cli

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
PYTHON = [
    pytest.param(body, id=f"{page.name}-{number}")
    for page in PAGES
    for number, body in enumerate(
        re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    )
]
BLOCKS = [
    pytest.param(bool(marked), body, id=f"{page.name}-{number}")
    for page in PAGES
    for number, (marked, body) in enumerate(BLOCK.findall(page.read_text(encoding="utf-8")))
]


def _commands(body):
    for line in body.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


def _check(words):
    match words:
        case ["suite", ("--help" | "--version")]:
            pass
        case ["suite", name, *args]:
            assert name in cli.COMMANDS, f"no command {name!r}"
            if "--help" not in args:
                cli.parse(name, args)
        case ["make", *targets]:
            makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
            for target in targets:
                if "=" not in target:
                    assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


@pytest.mark.parametrize(("marked", "body"), BLOCKS)
def test_every_command_is_one_that_exists(marked, body):
    for words in _commands(body):
        _check(words)


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
        _check(["suite", name, *words])
        return
    for word in words:
        if re.fullmatch(r"--[a-z][a-z-]*", word) and word != "--help":
            assert word in _options(name), f"suite {name} has no option {word}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_within_a_sentence_exist_and_none_hides_in_another_fence(page):
    text = page.read_text(encoding="utf-8")
    for kind, body in FENCE.findall(text):
        assert kind == "sh" or not re.match(r"(suite|make|pip) ", body), "fence it with ```sh"
    for words in SENTENCE.findall(FENCE.sub("", text)):
        _check_sentence(words)


@pytest.mark.parametrize("text", ["nothing", "eval --trails 3", "view runs/x --giff"])
def test_an_option_that_does_not_exist_is_found_within_a_sentence(text):
    with pytest.raises(AssertionError):
        _check_sentence(text)


@pytest.mark.parametrize("words", [["suite", "nothing"], ["suite", "info", "--x"], ["make", "tea"]])
def test_a_command_that_does_not_exist_is_found(words):
    with pytest.raises((AssertionError, SystemExit)):
        _check(words)


@pytest.mark.parametrize(
    "body", [pytest.param(b.values[1], id=b.id) for b in BLOCKS if b.values[0]]
)
def test_marked_commands_run(body, tmp_path):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", body],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("body", PYTHON)
def test_python_on_a_page_imports_what_there_is(body):
    for node in ast.walk(ast.parse(body)):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = importlib.import_module(node.module)
            assert all(hasattr(module, alias.name) for alias in node.names), node.module


@pytest.mark.parametrize("page", [*PAGES, *ARCHIVE], ids=lambda page: page.name)
def test_links_within_the_repository_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_readme_is_short_and_its_picture_small():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 160
    picture = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)[0]
    assert (ROOT / picture).stat().st_size < 3e6


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
