"""README and docs: commands are read by the program, marked ones run, links and imports hold.

A fenced sh block below the comment ``<!-- run -->`` is run, in an empty folder. Every other
`suite` line must be one that the command line accepts, and every `make` line a target.
"""

import ast
import importlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from suite import cli

ROOT = Path(__file__).resolve().parents[3]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(<!-- run -->\n+)?```sh\n(.*?)```", re.DOTALL)
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_within_the_repository_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
