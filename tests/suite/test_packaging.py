"""The lock, the wheel, a package that adds to the suite, and a JAX that computes rightly."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.tools import built_wheel, program, python
from tracks.common.provenance import VERSION

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ROOMS = {"tracks", "policies", "eval", "suite"}
LOCK_LINES = [
    line
    for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]
LOCK = dict(line.partition(";")[0].split("==") for line in LOCK_LINES)


def test_the_lock_has_exact_public_versions_of_all_that_the_project_needs():
    exact = re.compile(r"[a-z0-9-]+==[0-9][0-9a-z.]*(; python_version < \"3.13\")?")
    assert not [line for line in LOCK_LINES if not exact.fullmatch(line)]
    for text in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]):
        wanted = Requirement(text)
        assert wanted.specifier.contains(LOCK[canonicalize_name(wanted.name)]), text
    wanted = PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]
    names = program(ROOT / "tools" / "lock.py").closure(wanted).keys()
    # Platforms differ in what a package needs (torch brings GPU libraries on Linux).
    missing = {n for n in names - LOCK.keys() if not n.startswith(("nvidia-", "cuda-", "triton"))}
    assert not missing


def test_python_3_13_gets_no_package_that_has_no_build_for_it():
    # labmaze, which dm-control requires, would be compiled with bazel.
    marked = {line.partition("==")[0] for line in LOCK_LINES if line.endswith('< "3.13"')}
    assert {"dm-control", "labmaze"} <= marked and not {"mujoco", "numpy"} & marked


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the wheel from a copy: an old build/ in the checkout would leak into it."""
    folder, copy = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source")
    for room in ROOMS:
        shutil.copytree(ROOT / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return built_wheel(copy, folder)


def test_the_wheel_holds_the_four_rooms_and_their_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == ROOMS
    shipped = {
        path.relative_to(ROOT).as_posix()
        for room in tops
        for path in (ROOT / room).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert shipped <= set(names), "a file in a room that the wheel leaves out"
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_wheel_works_from_an_empty_folder(wheel, tmp_path):
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    (site,) = home.glob("lib/python*/site-packages")
    # The requirements come from this environment; the suite itself must come from the wheel.
    zipfile.ZipFile(wheel).extractall(site)
    baked = site / "tracks" / "common" / "built_from.txt"
    assert baked.is_file(), "the build writes the commit into the wheel"
    baked.write_text("0123abc\n")
    installed = [path for path in sys.path if path.endswith("site-packages")]
    (site / "requirements.pth").write_text("\n".join(installed) + "\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    code = (
        "import eval, policies, suite, tracks\n"
        f"for room in (eval, policies, suite, tracks): assert {str(site)!r} in room.__file__\n"
        "from suite.cli import main\n"
        "from tracks.common.provenance import VERSION, git_commit\n"
        "print(VERSION, git_commit())\n"
        "raise SystemExit(main(['list']))\n"
    )
    command = [home / "bin" / "python", "-c", code]
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=empty, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{VERSION} 0123abc\n") and "race-small" in done.stdout
    assert list(empty.iterdir()) == []


RUN = """
import sys
import pytest
from suite.cli import main
from tests.support.judged_cells import cut_short
cut_short(pytest.MonkeyPatch(), 0.4)
for line in sys.stdin.read().splitlines():
    code = main([*line.split(), "--json"])
    if code:
        raise SystemExit(code)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory, root):
    """The environment of a process that finds the example package."""
    place = tmp_path_factory.mktemp("plugin")
    shutil.copytree(root / "examples" / "plugin", place / "source")
    zipfile.ZipFile(built_wheel(place / "source", place)).extractall(place / "site")
    return {**os.environ, "PYTHONPATH": f"{place / 'site'}{os.pathsep}{root}"}


def suite(commands, env, cwd):
    """Run commands in one process and return what each printed."""
    done = python(RUN, input="\n".join(commands), env=env, cwd=cwd)
    assert done.returncode == 0, done.stderr
    found, text = [], done.stdout.strip()
    while text:
        answer, end = json.JSONDecoder().raw_decode(text)
        found.append(answer)
        text = text[end:].strip()
    return found


@pytest.mark.extended
def test_all_four_are_used_by_commands(installed, tmp_path, root):
    text = (root / "eval" / "vehicles" / "reference.toml").read_text(encoding="utf-8")
    fins = "\n[effects.fin_drag]\ncoefficient = 0.3\n"
    (tmp_path / "finned.toml").write_text(text + fins)
    time_s = np.arange(0.0, 2.0, 0.01)
    circle = np.stack([np.cos(time_s), np.sin(time_s), 1.0 + 0.0 * time_s], 1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    rows = np.concatenate(
        [time_s[:, None], circle, level, 0.0 * circle, 800.0 + 0.0 * level], axis=1
    )
    np.savetxt(tmp_path / "flight.simlog", rows, header="simlog")
    fly = "eval --policy race-paper --track staircase --trials 1 --time-limit-s 1"
    lines = ["effects", "tracks", "import flight.simlog --no-fix --out flight.parquet"]
    fly += " --workers 1 --simulator"
    lines += [
        f"{fly} coarse --out coarse",
        f"{fly} mujoco --out plain",
        f"{fly} mujoco --vehicle finned.toml --out finned",
    ]
    effects, tracks, imported, *_ = suite(lines, installed, tmp_path)
    assert list(effects["effects"])[-1] == "fin_drag"
    assert tracks["families"]["staircase"] == {
        "about": "Staircase: eight gates in a line along world x, each higher than the one before.",
        "judged": False,
    }
    assert imported["rows"] == 200
    run = json.loads((tmp_path / "coarse" / "run.json").read_text())
    assert "coarse" in json.dumps(run)
    coarse, plain, finned = (
        pq.read_table(tmp_path / name / "trials.parquet")["pos_x"][0].as_py()
        for name in ("coarse", "plain", "finned")
    )
    assert plain not in (coarse, finned), "simulator and effect each change the flight"


def test_jitted_batch_of_products_then_a_reduction():
    # JAX issue 39103: 0.10.2 on the CPU is wrong in the last rows above 16k rows in float64 and
    # 32k in float32. Frames, rays and distances are all computed so.
    rng, rows = np.random.default_rng(0), 100_000
    matrix = rng.normal(size=(3, 3)).astype(np.float32)
    vectors = rng.normal(size=(rows, 3)).astype(np.float32)

    def squared_length(vector):
        return jnp.sum((matrix @ vector) ** 2)

    expected = ((vectors.astype(np.float64) @ matrix.astype(np.float64).T) ** 2).sum(axis=-1)
    np.testing.assert_allclose(jax.jit(jax.vmap(squared_length))(vectors), expected, rtol=1e-4)
