"""A package that adds an effect, a track family, a log format and a world, installed and used."""

import json
import os
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.support.tools import built_wheel

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
    done = subprocess.run(
        [sys.executable, "-c", RUN], input="\n".join(commands), env=env, cwd=cwd,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found, text = [], done.stdout.strip()
    while text:
        answer, end = json.JSONDecoder().raw_decode(text)
        found.append(answer)
        text = text[end:].strip()
    return found


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
    fly = "eval --policy race-paper --track staircase --trials 1 --workers 1 --simulator"
    lines = ["effects", "tracks", "import flight.simlog --no-fix --out flight.parquet"]
    lines += [f"{fly} coarse --out coarse", f"{fly} mujoco --vehicle finned.toml --out finned"]
    effects, tracks, imported, *_ = suite(lines, installed, tmp_path)
    assert list(effects["effects"])[-1] == "fin_drag"
    assert tracks["families"]["staircase"] == {
        "about": "Staircase: eight gates in a line along world x, each higher than the one before.",
        "judged": False,
    }
    assert imported["rows"] == 200
    run = json.loads((tmp_path / "coarse" / "run.json").read_text())
    assert "coarse" in json.dumps(run)
    ends = [
        pq.read_table(tmp_path / name / "trials.parquet")["pos_x"][0].as_py()
        for name in ("coarse", "finned")
    ]
    assert ends[0] != ends[1], "each flies otherwise"
