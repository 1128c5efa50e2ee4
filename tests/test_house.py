"""The house keeps its shape: small folders, short files, and a test at every module's path."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("tracks", "policies", "eval", "suite")
MODULES = sorted(
    path.relative_to(ROOT)
    for room in ROOMS
    for path in (ROOT / room).rglob("*.py")
    if path.name != "__init__.py"
)
CATALOGUES = ("eval/effects", "suite/commands")
"""Folders that hold one file a thing, and a test for all of them."""


def places_of(module):
    """Return where the test of `module` may stand: at its own path, or as its folder's."""
    folder = Path("tests", *module.parts[:-1])
    return folder / f"test_{module.stem}.py", folder / f"test_{module.parts[-2]}.py"


def imported_by(test):
    """Return the dotted names that a test file takes something from."""
    tree = ast.parse((ROOT / test).read_text(encoding="utf-8"))
    found = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {node.module for node in found} | {
        f"{node.module}.{alias.name}" for node in found for alias in node.names
    }


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_a_modules_test_is_found_from_its_path(module):
    if str(module.parent) in CATALOGUES:
        assert any((ROOT / "tests" / module.parent).glob("test_*.py"))
        return
    own, folders = places_of(module)
    if not (ROOT / own).is_file():
        name = ".".join(module.with_suffix("").parts)
        assert (ROOT / folders).is_file(), f"neither {own} nor {folders}"
        assert name in imported_by(folders), f"{folders} does not import {name}; write {own}"


def test_a_tests_module_is_found_from_its_path():
    known = {place for module in MODULES for place in places_of(module)}
    whole = ("tests/examples", "tests/suite/commands", "tests/eval/effects")
    lost = [
        path
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if (short := path.relative_to(ROOT)) not in known
        and len(short.parts) > 3
        and not str(short).startswith(whole)
    ]
    assert not lost


@pytest.mark.parametrize("folder", sorted({module.parent for module in MODULES}), ids=str)
def test_a_folder_is_one_idea(folder):
    files = list((ROOT / folder).glob("*.py"))
    assert len(files) <= 12 or str(folder) in CATALOGUES


@pytest.mark.parametrize("room", ROOMS)
def test_a_rooms_root_is_seen_at_one_glance(room):
    hidden = ("__init__.py", "py.typed", "__pycache__", "commands")
    entries = [path.name for path in (ROOT / room).iterdir() if path.name not in hidden]
    assert len(entries) <= 9, entries
