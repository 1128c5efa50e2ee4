"""Every program of examples/ runs at a small size without a warning, says what it should, is short.

Eight programs are shown in docs/start.md; a file that is not in the table here fails.
"""

import importlib
import inspect
import json
import re
import runpy
import sys
from functools import partial
from pathlib import Path

import pytest

import suite
from eval.effects import EFFECTS
from eval.logs.flight_log import flight_files, read_flights
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from policies.formats import torch_file
from suite.commands import train as train_command
from suite.diagnose import run as diagnose_run
from suite.train import run as train_run
from suite.train.overrides import with_changes
from tests.support.judged_cells import cut_short
from tests.support.loops import made_update
from tests.support.marks import more
from tests.support.policy_files import InProcess

RECIPE = train_command.named_recipe
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
    "jax_policy": (["1"], r"seed 0: [0-8] gates, \w+", []),
    "quadrotor_gradient": (["3"], r"0\.06000 kg; the truth is 0\.06 kg", []),
}
"""Name: arguments, what it must say (an expression), files that it must write."""
IN_FULL = (
    *("bring_your_own_policy", "fly_and_plot", "own_effect", "own_track", "quadrotor_gradient"),
)
"""These take seconds also in short; the types of all are checked with each run of all tests."""


def source(name):
    return (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")


def test_every_example_is_run_here_and_shown_to_newcomers():
    # One needs a package of its own, one is longer: test_trainers.py.
    elsewhere = ["sb3_race", "cleanrl_ppo"]
    names = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
    assert sorted([*EXAMPLES, *elsewhere]) == names
    start = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    for name in EXAMPLES:
        assert f"(../examples/{name}.py)" in start
        assert 25 <= len(source(name).splitlines()) <= 80


def test_the_helpers_of_a_track_family_are_where_the_docs_say_with_these_arguments():
    text = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    section = text.partition("## A track family")[2].partition("\n## ")[0]
    places = dict(re.findall(r"`(\w+)`(?: is)? in\s`([\w.]+)`", section))
    rows = re.findall(r"^\| `(\w+)(\(.*?\))`", section, re.MULTILINE)
    assert len(rows) == 5 and len(places) == 2
    for name, arguments in rows:
        module = importlib.import_module(places.get(name, "tracks.families.layout"))
        every = [*inspect.signature(getattr(module, name)).parameters.values()]
        count = arguments.count(",") + 1
        shown, left_out = every[:count], every[count:]
        assert arguments == f"({', '.join(str(p.replace(annotation=p.empty)) for p in shown)})"
        assert all(p.default is not p.empty for p in left_out)


@pytest.fixture(autouse=True)
def as_a_program(tmp_path, monkeypatch):
    """Run in an empty folder, train in few worlds; effects that a program adds go again."""
    few = ("episode.batch=4", "episode.steps=8", "optimizer.warmup=0")
    monkeypatch.setattr(train_command, "named_recipe", lambda name: with_changes(RECIPE(name), few))
    monkeypatch.chdir(tmp_path)
    for table in ("_entries", "_values"):
        monkeypatch.setattr(EFFECTS, table, dict(getattr(EFFECTS, table)))


@pytest.mark.filterwarnings("ignore:.*after a very short training this is no fault")
@pytest.mark.parametrize(
    ("name", "short"),
    [
        *((name, True) for name in EXAMPLES if name not in IN_FULL),
        *(more(name, False) for name in EXAMPLES),
    ],
)
def test_the_example_runs(name, short, tmp_path, monkeypatch, capsys):
    """In this process, where jax and what is compiled are there already; warnings are errors."""
    args, said, written = EXAMPLES[name]
    if short:
        cut_short(monkeypatch, 0.6)
        made = partial(suite.make_env, rules=Rules(time_limit_s=0.6))
        monkeypatch.setattr(suite, "make_env", made)
        # In full it is compiled for seconds, as in tests/suite/train/test_run.py.
        monkeypatch.setattr(train_run, "make_update", partial(made_update, trained := []))
        said = said.replace("[1-8] gates", r"\d gates")
    program = str(ROOT / "examples" / f"{name}.py")
    monkeypatch.setattr(sys, "argv", [program, *args])
    if name == "bring_your_own_policy":
        monkeypatch.setattr(torch_file, "ModelProcess", InProcess)
    if name == "diagnose_a_log":
        monkeypatch.setattr(diagnose_run, "diagnose_files", diagnosed)
    runpy.run_path(program, run_name="__main__")
    out, err = capsys.readouterr()
    assert re.search(said, out), out
    assert "arning" not in err, err
    for file in written:
        assert (tmp_path / file).stat().st_size > 0
    assert not short or len(trained) == (name == "train_and_judge")


def diagnosed(config, console):
    """Stand for the diagnosis, which tests/suite/commands/test_logs.py makes in full (slow)."""
    assert load_vehicle(config.vehicle) and len(read_flights(flight_files(config.flights))[0]) == 3
    (config.out / "report.html").write_text("as the command writes it")
    entry = {"value": [0.004, 0.001, None], "ci95": [[0.003, 0.005], [0.0, 0.002], None]}
    return {
        "verdict": "named",
        "effects": [{"name": "com_offset", "parameters": {"offset": entry}}],
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*after a very short training this is no fault")
def test_the_notebook_runs_from_top_to_bottom():
    cells = json.loads((ROOT / "examples" / "tour.ipynb").read_text(encoding="utf-8"))["cells"]
    spaces = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            text = "".join(cell["source"]).replace("TRIALS = 100, 10", "TRIALS = 2, 2")
            exec(compile(text, cell["id"], "exec"), spaces)
    assert spaces["found"]["verdict"] == "named" and "com_offset" in spaces["corrected"].effects
