"""suite loop --hidden-vehicle: a hidden effect is flown, named, trained for; nothing else leaks.

As in the other loop's test the gradient step is a stand-in and trials are cut short; so are the
diagnosis and the fit, which have tests of their own.
"""

import json
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from eval.effects.body import ComOffset, TorqueTrim
from eval.judging.results import read_trials
from eval.logs.flight_log import read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import with_effects
from policies.formats.policy_file import load_policy_checkpoint, save_delta
from policies.networks import delta_network
from suite import cli
from suite.common.console import Quiet
from suite.delta.run import flight_files
from suite.loop import work
from suite.loop.compare import policy_results
from suite.loop.config import HiddenLoopConfig, resolve
from suite.loop.hidden_effect import (
    LABELS,
    LOOP,
    describe_hidden,
    hidden_effects,
    vehicle_phrase,
    verdict,
)
from suite.loop.measured import CONTACT_MARGIN_S, Noise
from tests.support.engines import STAND_IN
from tests.support.loops import Small, trial_result

EXAMPLE = "examples/hidden.toml"
ARGS = ["--hidden-vehicle", EXAMPLE, "--recipe", "quick", "--track", "zigzag", "--difficulty", "0"]
ARGS += ["--trials", "3", "--flights", "3", "--finetune-iterations", "2", "--seed", "4"]
ARGS += ["--set", "episode.batch=2"]
TUNED = [variant.name for variant in LOOP.variants if variant.tuned]
STAGES = ["given", "eval-nominal", "eval-before", "flights", "measured", "diagnosis"]
STAGES += ["delta-control", "delta-named", *(f"tuned-{name}" for name in TUNED)]
STAGES += [*(f"eval-{name}" for name in TUNED), "replays"]


def answer(effects):
    return {
        "verdict": "named" if effects else "unknown",
        "effects": effects,
        "gap": {"before": 9.0, "after": 1.1, "noise_floor": 1.0},
        "unexplained": {"share": 0.0, "where": None},
    }


NAMED = {
    "name": "com_offset",
    "alternatives": ["torque_trim"],
    "parameters": {"offset": {"value": [0.011, 0.0, None], "unit": "m", "ci95": None}},
}


class Stub(Small):
    """Also in place of the diagnosis and the fits."""

    def __init__(self, monkeypatch, effects=(NAMED,)):
        super().__init__(monkeypatch)
        self.effects, self.diagnosed, self.fitted = list(effects), [], []
        monkeypatch.setattr("suite.diagnose.run.diagnose_files", self.diagnose)
        monkeypatch.setattr(work, "fit_delta", self.fit)

    def diagnose(self, paths, vehicle, out, console, *, drive, seed):
        logs, _ = read_flights(paths)
        self.diagnosed.append((vehicle, drive, [log.name for log in logs]))
        base = load_vehicle(vehicle)
        corrected = {**base.effects, "com_offset": ComOffset((0.011, 0.0, 0.0))}
        out.mkdir(parents=True, exist_ok=True)
        save_vehicle(replace(base, effects=corrected), out / "vehicle.toml", "found")
        (out / "report.html").write_text("<p>diagnosis</p>")
        (out / "diagnosis.json").write_text(json.dumps(answer(self.effects)))

    def fit(self, config, quad, paths, out, console):
        self.fitted.append((quad.vehicle, sorted(path.name for path in flight_files(paths))))
        params = delta_network.init(jax.random.key(0))
        shift = 0.01 if "com_offset" in quad.vehicle.effects else 0.02
        params = {k: np.asarray(v) + shift for k, v in params.items()}
        save_delta(out / "delta", params, seed=0, fit={"model": "quad"})
        errors = {"position_m": 0.1, "velocity_m_s": 0.2}
        stored = {"without": errors, "delta_action": errors}
        (out / "delta.json").write_text(json.dumps(stored))
        (out / "table.md").write_text("| fitted |\n")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, root):
    """Return a finished loop's folder and what it did."""
    out = tmp_path_factory.mktemp("hidden") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        stub = Stub(patch)
        assert cli.main(["loop", *ARGS, "--out", str(out)]) == 0
    return out, stub


def test_the_loop_leaves_tables_report_and_recording(whole):
    out, _ = whole
    for name in ("table.md", "loop.json", "report.html", "recording.rrd", "run.json"):
        assert (out / name).stat().st_size > 100, name
    found = json.loads((out / "loop.json").read_text())
    assert list(found["stage_seconds"]) == STAGES
    assert [one["name"] for one in found["standings"]] == list(LABELS)
    assert found["diagnosis"]["effects"][0]["name"] == "com_offset"
    table = (out / "table.md").read_text()
    assert found["verdict"] in table and "com_offset (or torque_trim)" in found["verdict"]
    assert all(f"| {label} |" in table for label in LABELS.values())
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4 and "<script" not in page
    assert "com_offset (offset [0.012, 0.0, 0.0] m)." in page
    rows = page.replace("\n", "")
    assert "<td>offset x [m]</td><td>0.011</td><td></td>" in rows
    assert "<td>offset z [m]</td><td>not identifiable</td>" in rows
    for line in page.split('href="')[1:]:
        assert (out / line.split('"')[0]).is_file()


def test_only_the_judge_flies_the_hidden_vehicle(whole):
    out, stub = whole
    rows = {name: read_trials(out / f"eval-{name}" / "trials.parquet") for name in LABELS}
    for name, trials in rows.items():
        assert {row.vehicle for row in trials} == {"reference" if name == "nominal" else "hidden"}
        assert [row.trial for row in trials] == [("zigzag", 0, seed) for seed in (4, 5, 6)]
    assert [vehicle for vehicle, _, _ in stub.diagnosed] == ["reference"]
    offsets = [config.quadrotor.vehicle.effects.get("com_offset") for config, _, _ in stub.trained]
    assert offsets == [None] * 4 + [ComOffset((0.011, 0.0, 0.0))] * 4
    assert [with_delta for _, with_delta, _ in stub.trained] == [False, False, True, True] * 2
    corrected = [vehicle.effects.get("com_offset") for vehicle, _ in stub.fitted]
    assert corrected == [None, ComOffset((0.011, 0.0, 0.0))]


def test_all_are_tuned_alike_on_the_same_tracks(whole):
    out, stub = whole
    for k in (0, 1):
        starts = [worlds for _, _, worlds in stub.trained[k::2]]
        assert all(np.array_equal(starts[0], other) for other in starts[1:])
    plain = [config for config, _, _ in stub.trained]
    assert all(one.optimizer == plain[0].optimizer and one.loss == plain[0].loss for one in plain)
    weights = [load_policy_checkpoint(out / f"tuned-{name}" / "policy") for name in TUNED]
    values = [float(np.ravel(one.params["action.weight"])[0]) for one in weights]
    # The stand-in leans by the tracks and the delta alone: named and control agree, delta differs.
    assert values[0] == values[2] and len({values[0], values[1], values[3]}) == 3


def test_measured_flights_are_others_than_the_judged_and_noisy(whole):
    out, stub = whole
    exact, _ = read_flights(sorted((out / "flights").glob("*.parquet")))
    logs, _ = read_flights(sorted((out / "measured").glob("*.parquet")))
    assert {log.about["seed"] for log in logs} <= {100_004, 100_005, 100_006}
    assert stub.diagnosed[0][1] == "commands"
    one = next(log for log in exact if log.about["seed"] == logs[0].about["seed"])
    count = len(logs[0].time_s)
    assert one.time_s[-1] - logs[0].time_s[-1] <= CONTACT_MARGIN_S + 0.011
    spread = (logs[0].pos_w - one.pos_w[:count]).std()
    assert spread == pytest.approx(Noise().pos, rel=0.2)
    assert one.thrust_cmd is not None and one.action_b is not None
    np.testing.assert_array_equal(logs[0].thrust_cmd, one.thrust_cmd[:count])
    np.testing.assert_array_equal(logs[0].action_b, one.action_b[:count])


@pytest.mark.slow
def test_without_delta_the_same_comes_of_half_the_stages(whole, tmp_path, monkeypatch, root):
    monkeypatch.chdir(root)
    stub, out = Stub(monkeypatch), tmp_path / "out"
    assert cli.main(["loop", *ARGS, "--no-delta", "--out", str(out)]) == 0
    found, other = (json.loads((f / "loop.json").read_text()) for f in (out, whole[0]))
    assert list(found["stage_seconds"]) == [
        name for name in STAGES if not name.endswith(("-delta", "-both", "delta-control", "named"))
        or name in ("tuned-named", "eval-named")
    ]  # fmt: skip
    assert not stub.fitted and len(stub.trained) == 4
    mine = {one["name"]: one for one in found["standings"]}
    theirs = {one["name"]: one for one in other["standings"]}
    assert list(mine) == ["nominal", "before", "control", "named"]
    assert all(mine[name]["success"] == theirs[name]["success"] for name in mine)
    assert "Delta Action Model" not in (out / "table.md").read_text()
    assert "Delta Action Model" not in (out / "report.html").read_text()


def test_where_nothing_is_named_the_loop_ends_and_says_so(
    whole, tmp_path, monkeypatch, root, capfd
):
    monkeypatch.chdir(root)
    out = tmp_path / "out"
    shutil.copytree(whole[0], out)
    for name in ("diagnosis", "loop.json", "table.md"):
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    stub = Stub(monkeypatch, effects=())
    assert cli.main(["loop", *ARGS, "--out", str(out)]) == 1
    said = capfd.readouterr().err
    assert "has the verdict unknown and names nothing to correct" in said and "--flights" in said
    assert not stub.trained and not (out / "loop.json").exists()


def test_the_example_hides_one_effect(root):
    true, simulated = load_vehicle(root / EXAMPLE), load_vehicle("reference")
    assert true.mass == simulated.mass and true.rotors == simulated.rotors
    assert true.controller == simulated.controller
    assert set(true.effects) - set(simulated.effects) == {"com_offset"}
    assert hidden_effects(simulated, true) == "com_offset (offset [0.012, 0.0, 0.0] m)"
    assert hidden_effects(true, simulated) == "no com_offset"
    assert hidden_effects(simulated, replace(simulated, mass=0.8)) == "other nominal values"
    trimmed = with_effects(simulated, {"torque_trim": TorqueTrim(np.array([0.01, 0.0, 0.0]))})
    stored = hidden_effects(simulated, replace(trimmed, mass=0.8))
    assert stored == "torque_trim (torque [0.01, 0.0, 0.0] N m); other nominal values"


def test_all_but_the_first_judging_are_in_the_other_simulator(monkeypatch, root, tmp_path):
    monkeypatch.chdir(root)
    monkeypatch.setattr("eval.worlds.rotorpy.rotorpy", lambda: STAND_IN)
    config = resolve(recipe="quick", simulator="rotorpy", hidden_vehicle="examples/rotorpy.toml")
    assert isinstance(config, HiddenLoopConfig)
    run = work.LoopRun(LOOP, config, tmp_path, Quiet())
    judged = [work._evaluation(run, variant) for variant in LOOP.variants]
    assert [one.simulator for one in judged] == ["mujoco"] + ["rotorpy"] * 5
    assert [one.vehicle for one in judged] == ["reference"] + ["examples/rotorpy.toml"] * 5
    assert vehicle_phrase(config) == "the simulator rotorpy"
    stored = describe_hidden(config)
    assert "rotor_drag (coefficient 7.8e-05 kg/rad)" in stored[0] and "no linear_drag" in stored[0]
    assert "the rotors' drag acts at each hub" in stored[1]
    same = resolve(recipe="quick", simulator="rotorpy")
    assert isinstance(same, HiddenLoopConfig)
    plain = describe_hidden(same)
    assert plain[0] == "The hidden vehicle's file is that of the simulation."
    assert "linear_drag: RotorPy's drag is proportional to the rotors' speed" in plain[1]


@pytest.mark.parametrize(
    ("nominal", "control", "named", "how"),
    [
        (39, 12, 36, "25 % of 40 trials succeed, with the simulation's vehicle 98 %"),
        (39, 12, 36, "more than the same fine-tuning without it (30 %; difference +60 points [+"),
        (40, 20, 20, "not significantly different from the same fine-tuning without it"),
        (39, 10, 40, ", and not significantly different from the policy where nothing is hidden"),
        (20, 10, 40, ", and above the policy where nothing is hidden"),
        (40, 10, 20, ", and below the policy where nothing is hidden"),
    ],
)
def test_the_verdict_claims_what_the_intervals_hold(nominal, control, named, how):
    won = {"nominal": nominal, "before": 10, "control": control, "named": named}
    results = {name: [trial_result(k, k < count) for k in range(40)] for name, count in won.items()}
    words = verdict(policy_results(results, ("before", "control", "nominal")), answer([NAMED]), 40)
    assert how in words
