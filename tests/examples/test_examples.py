"""Every program of examples/ runs at a small size without a warning, says what it should, is short.

Eight programs are shown in docs/start.md; a file that is not in the table here fails.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = {
    "fly_and_plot": (["."], "8 gates, finished", ["trial.png", "trial.gif", "trial.rrd"]),
    "train_and_judge": ([".", "1"], r"\d of 5 succeed", ["policy/weights.safetensors"]),
    "own_track": (["."], "2 gates, finished", ["course.toml", "roof.stl", "course.png"]),
    "own_effect": ([], r"0\.0 N/m: 8 gates, finished\n(.*\n)*0\.4 N/m: [0-7] gates", []),
    "diagnose_a_log": (["."], r"verdict: named\ncom_offset\.offset", ["report.html"]),
    "bring_your_own_policy": (
        ["."],
        r"onnx at 50 Hz: action \[4\.8\d*, 3\.6.*\n.*pt2 at 50 Hz: action \[4\.8\d*, 3\.6",
        ["to_the_gate.onnx", "to_the_gate.pt2"],
    ),
    "gymnasium_loop": (["1"], r"[1-8] gates, \w+ after", []),
    "quadrotor_gradient": (["3"], r"0\.06000 kg; the truth is 0\.06 kg", []),
}
"""Name: arguments, what it must say (an expression), files that it must write."""
# A diagnosis runs for longer than it compiles.
OPTIMISED = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}


def source(name):
    return (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")


def test_every_example_is_run_here_and_shown_to_newcomers():
    assert sorted(EXAMPLES) == sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
    start = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    for name in EXAMPLES:
        assert f"(../examples/{name}.py)" in start
        assert 25 <= len(source(name).splitlines()) <= 80


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs(name, tmp_path):
    args, said, written = EXAMPLES[name]
    command = [sys.executable, "-W", "error", str(ROOT / "examples" / f"{name}.py"), *args]
    env = OPTIMISED if name == "diagnose_a_log" else None
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(said, done.stdout), done.stdout
    assert "arning" not in done.stderr, done.stderr
    for file in written:
        assert (tmp_path / file).stat().st_size > 0
