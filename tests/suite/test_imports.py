"""Imports go one way, rooms open empty, and the trainer needs jax, numpy and pure Python only."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOMS = ("tracks", "policies", "eval", "suite")
ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
TRAINER_HAS_NOT = ("mujoco", "torch", "dm_control", "gymnasium", "trimesh", "onnx", "rerun")


def _imported(path, top_level_only=False):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            yield node.module or ""


@pytest.mark.parametrize("room", ROOMS)
def test_imports_go_one_way(room):
    to_the_right = ROOMS[ROOMS.index(room) + 1 :]
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.relative_to(ROOT).parts[0] == room
        for name in _imported(path)
        if name.split(".")[0] in to_the_right
    ]
    assert not wrong


def _module(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_no_two_files_import_each_other():
    """Imports inside functions count, those for type checkers alone do not."""
    modules = {_module(path) for path in FILES}
    graph = {}
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
                node.body = []
        used = {
            name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            for name in (f"{node.module}.{alias.name}", node.module)
        }
        graph[_module(path)] = (used & modules) - {_module(path)}
    TopologicalSorter(graph).prepare()  # raises where there is a circle, and names it


def test_rooms_open_empty_and_their_folders_without_a_heavy_library():
    light = (*ROOMS, *sys.stdlib_module_names)
    heavy = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.name == "__init__.py"
        for name in _imported(path, top_level_only=True)
        if name.split(".")[0] not in (light if path.parent.parent == ROOT else (*light, "numpy"))
    ]
    assert not heavy


def test_no_file_is_longer_than_400_lines():
    long = {
        str(path.relative_to(ROOT)): lines
        for path in FILES
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > 400
    }
    assert not long


def test_every_package_is_typed_and_has_an_init():
    for room in ROOMS:
        assert (ROOT / room / "py.typed").is_file()
    missing = {path.parent for path in FILES if not (path.parent / "__init__.py").is_file()}
    assert not missing


def test_the_trainer_runs_on_a_bare_gpu_machine():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in FILES
        if path.relative_to(ROOT).parts[:2] == ("suite", "train") and path.name != "__init__.py"
    ]
    code = (
        "import importlib, sys\n"
        "class Blocker:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] in {TRAINER_HAS_NOT!r}:\n"
        "            raise ImportError('blocked: ' + name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
