"""docs/architecture.md has a line for every file of the rooms, and none for files there are not."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ROOMS = ("tracks", "policies", "eval", "suite")
ONE_LINE = ("families/", "effects/", "commands/", "shipped/")
"""Folders of many files of one kind, which share a line."""


def lines_of(room):
    part = PAGE.split(f"\n## {room}:")[1].split("\n## ")[0]
    return re.findall(r"^\| `([^`]+)` \|", part, re.MULTILINE)


@pytest.mark.parametrize("room", ROOMS)
def test_every_file_has_a_line(room):
    files = [str(path.relative_to(ROOT / room)) for path in (ROOT / room).rglob("*.py")]
    files = [f for f in files if not f.endswith("__init__.py") and not f.startswith(ONE_LINE)]
    missing = sorted(set(files) - set(lines_of(room)))
    assert not missing, f"add to docs/architecture.md, section {room}: {missing}"


@pytest.mark.parametrize("room", ROOMS)
def test_every_line_is_of_a_file(room):
    lines = lines_of(room)
    gone = [line for line in lines if not (ROOT / room / line).exists()]
    assert not gone and len(lines) == len(set(lines))
