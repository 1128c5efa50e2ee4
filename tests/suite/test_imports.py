"""Imports go one way, rooms open empty, and the trainer needs jax, numpy and pure Python only."""

import ast
import functools
import json
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

from suite.cli import COMMANDS
from suite.experiments import EXPERIMENTS
from tests.support.policy_files import small_checkpoint
from tests.support.tools import BLOCKER

ROOMS = ("tracks", "policies", "eval", "suite")
STEPS = ("estimate", "data", "evidence", "search", "verdict", "sources", "report")
ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
HEAVY = ("numpy", "jax", "mujoco", "torch", "tyro", "rich", "scipy", "pyarrow", "argparse")
SLOW = ("jax", "mujoco", "torch", "dm_control", "trimesh", "matplotlib", "rerun", "scipy")
BARE_HAS_NOT = (
    "torch", "onnx", "onnxruntime", "mujoco", "dm_control", "gymnasium", "trimesh", "rerun",
    "pyarrow", "matplotlib", "rich", "tyro", "pandas",
)  # fmt: skip
JUDGE = ("eval.judging.judge", "eval.worlds.mujoco", "eval.worlds.scene_slots")
DOORS = (
    "policies.policy", "policies.formats.checkpoint", "policies.formats.export",
    "eval.quadrotor.stepper",
)  # fmt: skip


@functools.cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(node, of_types=True):
    """Yield the import statements below a node; with `of_types` those for type checkers too."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        yield node
    elif of_types or getattr(getattr(node, "test", None), "id", "") != "TYPE_CHECKING":
        if isinstance(node, ast.mod | ast.stmt | ast.ExceptHandler | ast.match_case):
            for child in ast.iter_child_nodes(node):
                yield from statements(child, of_types)


def imported(path, top_level_only=False):
    """Yield the names of the modules that a file imports."""
    tree = tree_of(path)
    for node in tree.body if top_level_only else statements(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            yield node.module or ""


def test_imports_go_one_way():
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        for name in imported(path)
        if name.split(".")[0] in ROOMS[ROOMS.index(path.relative_to(ROOT).parts[0]) + 1 :]
    ]
    assert not wrong


def test_the_steps_of_the_diagnosis_import_one_way():
    folder = "suite.diagnose."
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for number, step in enumerate(STEPS)
        for path in (ROOT / "suite" / "diagnose" / step).glob("*.py")
        for name in imported(path)
        if name.startswith(folder) and name.split(".")[2] in STEPS[number + 1 :]
    ]
    assert not wrong


def _module(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_no_two_files_import_each_other():
    """Imports inside functions count, those for type checkers alone do not."""
    modules, graph = {_module(path): path for path in FILES}, {}
    for name, path in modules.items():
        used = {
            found
            for node in statements(tree_of(path), of_types=False)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            for found in (f"{node.module}.{alias.name}", node.module)
        }
        graph[name] = used & modules.keys() - {name}
    TopologicalSorter(graph).prepare()  # raises where there is a circle, and names it


def test_rooms_are_typed_and_open_empty_and_their_folders_without_a_heavy_library():
    light = (*ROOMS, *sys.stdlib_module_names)
    heavy = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.name == "__init__.py"
        for name in imported(path, top_level_only=True)
        if name.split(".")[0] not in (light if path.parent.parent == ROOT else (*light, "numpy"))
    ]
    assert not heavy
    for room in ROOMS:
        assert (ROOT / room / "py.typed").is_file()
    missing = {path.parent for path in FILES if not (path.parent / "__init__.py").is_file()}
    assert not missing


LIGHT = f"""{BLOCKER}
import contextlib, io
from suite import cli
said = dict()
for line, heavy in json.loads(sys.argv[1]):
    blocked.update(heavy)
    blocked.intersection_update(heavy)
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert cli.main(line.split()) == 0, line
    said[line] = text.getvalue()
    if line.startswith("reproduce"):
        assert not any(name.startswith("suite.experiments.") for name in sys.modules)
blocked.update(json.loads(sys.argv[2]))
for name in json.loads(sys.argv[3]):
    __import__(name)
blocked.clear()
blocked.add("jax")
for name in json.loads(sys.argv[4]):
    __import__(name)
print(json.dumps(said))
"""
BARE = f"""{BLOCKER}
import pathlib
blocked.update(json.loads(sys.argv[1]))
for name in json.loads(sys.argv[2]):
    __import__(name)
import numpy as np
from policies.formats import policy_file
from policies.networks import tree_arrays
from policies.policy import load_policy
stored = policy_file.load_policy_checkpoint(pathlib.Path(sys.argv[3]))
tree_arrays.tree_from_arrays(stored.params, tree_arrays.tree_to_arrays(stored.params), "here")
policy_file.save_policy(pathlib.Path(sys.argv[4]), stored.params, stored.spec, seed=1)
policy = load_policy(pathlib.Path(sys.argv[4]))
state, image = np.zeros((2, 12)), np.zeros((2, 24, 32))
action, _ = policy.act(policy.start(2), state, image, np.ones(2, bool))
assert np.isfinite(action).all()
try:
    import policies.formats.torch_twin
except ImportError as error:
    print(error)
"""


def _said(code, *arguments):
    """Return what a program says whose imports fail where they are blocked."""
    texts = [a if isinstance(a, str) else json.dumps(a) for a in arguments]
    command = [sys.executable, "-W", "error", "-c", code, *texts]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_help_and_the_doors_of_the_rooms_import_nothing_slow():
    """Each line is run where importing what is named with it fails; the judge needs no JAX."""
    lines = [("--help", HEAVY), ("reproduce --help", SLOW)]
    lines += [(f"{name} --help", SLOW) for name in COMMANDS if name != "reproduce"]
    light = ("jax", "safetensors", *BARE_HAS_NOT)
    light = [name for name in light if name not in ("rich", "tyro", "pandas")]
    said = json.loads(_said(LIGHT, lines, light, DOORS, JUDGE))
    assert all(f"  {name} " in said["--help"] for name in COMMANDS)
    assert all(name in said["reproduce --help"] for name in EXPERIMENTS)
    assert all(f"suite {name}" in said[f"{name} --help"] for name in COMMANDS)


def test_a_bare_machine_trains_and_flies_our_policies(tmp_path):
    """It has jax, numpy and pure Python; the last import is one that has to fail there."""
    trainer = sorted(
        _module(path)
        for path in FILES
        if path.relative_to(ROOT).parts[:2] == ("suite", "train") and path.name != "__init__.py"
    )
    policy = small_checkpoint(tmp_path)
    said = _said(BARE, BARE_HAS_NOT, trainer, str(policy), str(tmp_path / "again"))
    assert "torch is blocked" in said
