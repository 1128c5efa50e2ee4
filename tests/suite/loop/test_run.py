"""suite loop: from training or a hidden effect to the report, interrupted anywhere.

The gradient step and the fits are stand-ins, since compiling the real ones takes minutes; trials
are cut short. With a hidden effect the diagnosis is a stand-in as well. All of them have tests of
their own; all else is what a person runs.
"""

import json
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from eval.effects.body import ComOffset, TorqueTrim
from eval.judging.results import read_trials
from eval.logs.faults.catalogue import FAULTS
from eval.logs.flight_log import read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import with_effects
from policies.formats.checkpoint import WEIGHTS, save_arrays
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import delta_network
from suite import cli
from suite.common.console import Quiet
from suite.delta.fit import DeltaFit, ReplayErrors
from suite.delta.replay import nominal_model
from suite.loop import hidden_effect, work
from suite.loop.compare import CAVEAT, policy_results
from suite.loop.hidden_effect import LABELS, LOOP, describe_hidden, hidden_effects
from tests.support.engines import STAND_IN
from tests.support.judged_cells import results_of
from tests.support.loops import Small, resolve
from tracks.common.files import write_text

EXAMPLE = "examples/hidden.toml"
SIZES = "loop --recipe quick --track zigzag --difficulty 0 --trials 2 --flights 2"
SIZES += " --finetune-iterations 2 --seed 4 --set episode.batch=2 loss.tilt=1"
TUNE = [*SIZES.split(), "--fit-iterations", "3"]
TRAIN = [*TUNE, "--iterations", "3"]
HIDDEN = [*SIZES.split(), "--hidden-vehicle", EXAMPLE]
DIAGNOSED = ["given", "eval-nominal", "eval-before", "flights", "measured", "diagnosis"]
"""The first stages of a loop with a hidden effect."""
TUNED = [variant.name for variant in LOOP.variants if variant.tuned]


def fitted(config, physics, fit_windows, held_out, show):
    """Stand in for the fit of a Delta Action Model and of a point mass."""
    assert len(fit_windows.pos_w) > 0 < len(held_out.pos_w)
    params = {k: np.asarray(v) + 0.01 for k, v in delta_network.init(jax.random.key(0)).items()}
    curve = [{"iteration": k, "fit_m": 0.2, "held_out_m": 0.2} for k in range(config.iterations)]
    models = {"point_mass": 0.2, "fitted_point_mass": 0.15, "delta_action": 0.1}
    errors = {name: ReplayErrors(error, error) for name, error in models.items()}
    return DeltaFit(params, errors, curve, nominal_model(physics))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a finished loop's folder and what it did."""
    out = tmp_path_factory.mktemp("loop") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("suite.delta.run.fit_point_mass", fitted)
        small = Small(patch, painted=True)
        assert cli.main([*TRAIN, "--out", str(out)]) == 0
    return out, small


@pytest.fixture(scope="module")
def hidden(tmp_path_factory, root):
    """Return the folder of a finished loop with a hidden effect, and what it did."""
    out = tmp_path_factory.mktemp("hidden") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        stub = Stub(patch)
        assert cli.main([*HIDDEN, "--out", str(out)]) == 0
    return out, stub


def finished(out, stages, pictures):
    """Return a loop's numbers, table and page, having checked what holds for all."""
    for name in ("table.md", "loop.json", "report.html", "recording.rrd", "run.json"):
        assert (out / name).stat().st_size > 100, name
    found = json.loads((out / "loop.json").read_text())
    assert list(found["stage_seconds"]) == stages
    assert all((out / name / "stage.json").is_file() for name in stages)
    table, page = (out / "table.md").read_text(), (out / "report.html").read_text()
    assert found["verdict"] in table and table.count("<!--") == 1
    assert page.count("data:image/png;base64,") == pictures
    assert "<script" not in page and "http" not in page
    assert all((out / line.split('"')[0]).is_file() for line in page.split('href="')[1:])
    return found, table, page


def test_the_loop_leaves_tables_report_and_recording_and_its_control_sees_the_same_tracks(whole):
    out, _ = whole
    stages = ["train", "eval-before", "flights", "delta", "tuned-without", "tuned-with"]
    found, table, _ = finished(out, [*stages, "eval-without", "eval-with", "replays"], 5)
    assert set(found) >= {"schema", "suite_version", "git_commit", "seed", "standings", "delta"}
    assert [policy["name"] for policy in found["standings"]] == ["before", "without", "with"]
    assert CAVEAT in table and "point mass, lag, drag and delay fitted" in table
    recording = (out / "recording.rrd").read_bytes()
    for name in (b"before", b"tuned with delta"):
        assert name + b", zigzag level 0 seed 4" in recording
    trained = whole[1].trained
    assert [with_delta for _, with_delta, _ in trained] == [False] * 5 + [True] * 2
    for (config, _, pos_w), (config_2, _, pos_2_w) in zip(trained[3:5], trained[5:], strict=True):
        assert config == config_2 and np.array_equal(pos_w, pos_2_w)
    assert not np.array_equal(trained[0][2], trained[3][2]), "fine-tuning sees new tracks"


def test_a_finished_loop_is_only_told_again_and_another_one_refused(whole, monkeypatch, capfd):
    out, _ = whole
    small = Small(monkeypatch)
    before = (out / "table.md").read_text()
    assert cli.main([*TRAIN, "--out", str(out), "--json"]) == 0
    printed = capfd.readouterr()
    said = json.loads(printed.out)
    assert said["verdict"] in before and (out / "table.md").read_text() == before
    for name, count in (("fine-tunings", 2), ("training", 3)):
        assert f"the {name}: {count} gradient steps, not more than the warm-up" in printed.err
    assert "warning: loss.tilt has no gradient through the point mass" in printed.err
    assert "| point mass with Delta Action Model |" in printed.err and "<!--" not in printed.err
    other = " ".join(TRAIN).replace("--trials 2", "--trials 5").split()
    assert cli.main([*other, "--out", str(out)]) == 2
    said = capfd.readouterr().err
    assert "trials is 2 there, 5 here" in said and "another --out" in said
    assert not small.flown and not small.trained


def test_stages_of_several_versions_of_the_code_are_reported(whole, tmp_path, monkeypatch, capfd):
    """They are compared with each other, so a difference may be one of the code."""
    out, mark = tmp_path / "copy", tmp_path / "copy" / "eval-before" / "stage.json"
    shutil.copytree(whole[0], out)
    assert "versions of the code" not in (out / "table.md").read_text()
    mark.write_text(json.dumps({**json.loads(mark.read_text()), "git_commit": "!old"}))
    Small(monkeypatch)
    assert cli.main([*TRAIN, "--out", str(out)]) == 0
    assert "warning: by the code of commit !old" in capfd.readouterr().err
    for name in ("table.md", "report.html"):
        assert "done by 2 versions of the code: !old, " in (out / name).read_text()
    assert "!old" in json.loads((out / "loop.json").read_text())["stage_commits"]


@pytest.mark.extended
def test_a_loop_goes_on_where_its_folder_was_moved(whole, tmp_path, monkeypatch):
    """In the middle of recording: what was flown counts. An evaluation goes on by itself."""
    given, small = whole[0] / "train" / "policy", Small(monkeypatch)
    args = [*TUNE, "--policy", str(given), "--out"]
    for place, flown in (("one", 3), ("end", 4)):
        small.stop_after = flown
        assert cli.main([*args, str(tmp_path / place)]) == 130
        assert len(small.flown) == flown
        if place == "one":
            (tmp_path / place).rename(tmp_path / "end")
    assert len(set(small.flown)) == 4, "two judged, two recorded, none twice"
    end = tmp_path / "end"
    assert not small.trained and not (end / "train").exists(), "a given policy is not trained"
    assert (end / "given" / "policy" / WEIGHTS).read_bytes() == (given / WEIGHTS).read_bytes()
    both = (read_trials(run / "eval-before" / "trials.parquet") for run in (whole[0], end))
    one, two = ([row._replace(policy="") for row in rows] for rows in both)
    assert one == two, "as in the loop that trained it and was never stopped"


def answer(effects):
    return {
        "verdict": "named" if effects else "unknown",
        "effects": effects,
        "gap": {"before": 9.0, "after": 1.1, "noise_floor": 1.0, "unit": "times the noise"},
        "unexplained": {"share": 0.0, "where": None},
    }


FOUND = ComOffset((0.011, 0.0, 0.0))
NAMED = {
    "name": "com_offset",
    "alternatives": ["torque_trim"],
    "parameters": {
        "offset": {
            "value": [0.011, 0.0, None],
            "unit": "m",
            "ci95": None,
            "file": [0.001, 0.0, None],
        }
    },
}


class Stub(Small):
    """Also in place of the diagnosis, the fits and the pictures."""

    recorded_s = 2.0  # what is measured ends before a contact

    def __init__(self, monkeypatch, effects=(NAMED,)):
        super().__init__(monkeypatch)
        self.effects, self.diagnosed, self.fitted = list(effects), [], []
        monkeypatch.setattr("suite.diagnose.run.diagnose_files", self.diagnose)
        monkeypatch.setattr(work, "fit_delta", self.fit)
        drawn = lambda path, *_: write_text(path, "a picture")  # noqa: E731
        monkeypatch.setattr("eval.view.picture.write_grid", drawn)

    def diagnose(self, config, console):
        vehicle, out = config.vehicle, config.out
        assert set(config.accept) == set(FAULTS), "a large hidden effect resembles them"
        logs, _ = read_flights(config.flights)
        self.diagnosed.append((vehicle, config.drive, [log.name for log in logs]))
        out.mkdir(parents=True, exist_ok=True)
        corrected = with_effects(load_vehicle(vehicle), {"com_offset": FOUND})
        save_vehicle(corrected, out / "vehicle.toml", "found")
        (out / "report.html").write_text("<p>diagnosis</p>")
        (out / "diagnosis.json").write_text(json.dumps(answer(self.effects)))

    def fit(self, config, quad, flights, out, console):
        self.fitted.append((quad.vehicle, [log.name for log in flights.logs]))
        params = delta_network.init(jax.random.key(0))
        shift = 0.01 if "com_offset" in quad.vehicle.effects else 0.02
        params = {k: np.asarray(v) + shift for k, v in params.items()}
        save_arrays(out / "delta", params, kind="delta", seed=0, extra={"fit": {"model": "quad"}})
        errors = {"position_m": 0.1, "velocity_m_s": 0.2}
        stored = {"horizon_s": 1.0, "without": errors, "delta_action": errors}
        (out / "delta.json").write_text(json.dumps(stored))
        (out / "table.md").write_text("| fitted |\n")


def test_a_loop_with_a_hidden_effect_leaves_tables_report_and_recording(hidden):
    stages = [*DIAGNOSED, "delta-control", "delta-named", *(f"tuned-{name}" for name in TUNED)]
    stages += [*(f"eval-{name}" for name in TUNED), "replays"]
    found, table, page = finished(hidden[0], stages, 4)
    assert [one["name"] for one in found["standings"]] == list(LABELS)
    assert found["diagnosis"]["effects"][0]["name"] == "com_offset"
    assert "com_offset (or torque_trim)" in found["verdict"]
    assert [fit["without"]["position_m"] for fit in found["delta"].values()] == [0.1, 0.1]
    assert all(f"| {label} |" in table for label in LABELS.values())
    assert "com_offset (offset [0.012, 0.0, 0.0] m)." in page
    rows = page.replace("\n", "")
    assert "<td>offset x [m]</td><td>0.001</td><td>0.011</td><td></td>" in rows
    assert "<td>offset z [m]</td><td></td><td>not identifiable</td>" in rows


@pytest.mark.extended
def test_without_the_delta_none_is_fitted_and_two_policies_are_tuned(
    hidden, tmp_path, monkeypatch, root
):
    """As `make race` runs it; the stages up to the diagnosis are those of the other loop."""
    monkeypatch.chdir(root)
    for stage in DIAGNOSED:
        shutil.copytree(hidden[0] / stage, tmp_path / stage)
    stub = Stub(monkeypatch)
    assert cli.main([*HIDDEN, "--no-delta", "--out", str(tmp_path)]) == 0
    stages = ["tuned-control", "tuned-named", "eval-control", "eval-named", "replays"]
    found, *_ = finished(tmp_path, [*DIAGNOSED, *stages], 4)
    assert [one["name"] for one in found["standings"]] == ["nominal", "before", "control", "named"]
    assert "delta" not in found
    assert not stub.fitted and not any(with_delta for _, with_delta, _ in stub.trained)


def test_only_the_judge_flies_the_hidden_vehicle_and_all_are_tuned_alike(hidden):
    out, stub = hidden
    measured = sorted((out / "measured").glob("*.parquet"))
    rows = {name: read_trials(out / f"eval-{name}" / "trials.parquet") for name in LABELS}
    for name, trials in rows.items():
        assert {row.vehicle for row in trials} == {"reference" if name == "nominal" else "hidden"}
        assert [row.trial for row in trials] == [("zigzag", 0, seed) for seed in (4, 5)]
    assert stub.diagnosed == [("reference", "commands", [str(file) for file in measured])]
    # Others than those that are judged.
    assert {log.about["seed"] for log in read_flights(measured)[0]} <= {100_004, 100_005}
    offsets = [config.quadrotor.vehicle.effects.get("com_offset") for config, _, _ in stub.trained]
    assert offsets == [None] * 4 + [FOUND] * 4
    assert [with_delta for _, with_delta, _ in stub.trained] == [False, False, True, True] * 2
    assert [vehicle.effects.get("com_offset") for vehicle, _ in stub.fitted] == [None, FOUND]
    for k in (0, 1):
        starts = [worlds for _, _, worlds in stub.trained[k::2]]
        assert all(np.array_equal(starts[0], other) for other in starts[1:])
    plain = [config for config, _, _ in stub.trained]
    assert all(one.optimizer == plain[0].optimizer and one.loss == plain[0].loss for one in plain)
    weights = [load_policy_checkpoint(out / f"tuned-{name}" / "policy") for name in TUNED]
    values = [float(np.ravel(one.params["action.weight"])[0]) for one in weights]
    # The stand-in leans by the tracks and the delta alone: named and control agree, delta differs.
    assert values[0] == values[2] and len({values[0], values[1], values[3]}) == 3


def test_where_nothing_is_named_the_loop_ends(hidden, tmp_path, monkeypatch, root, capfd):
    monkeypatch.chdir(root)
    out = tmp_path / "out"
    shutil.copytree(
        hidden[0], out, ignore=shutil.ignore_patterns("diagnosis", "loop.json", "table.md")
    )
    stub = Stub(monkeypatch, effects=())
    assert cli.main([*HIDDEN, "--out", str(out)]) == 1
    said = capfd.readouterr().err
    assert "2 of 2 flights last 1.5 s or longer; 2 of them are diagnosed" in said
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
    same = resolve(recipe="quick", simulator="rotorpy")
    config = resolve(recipe="quick", simulator="rotorpy", hidden_vehicle="examples/rotorpy.toml")
    run = work.LoopRun(LOOP, config, tmp_path, Quiet())
    judged = [work._evaluation(run, variant) for variant in LOOP.variants]
    flown = [(one.simulator, one.vehicle) for one in judged]
    assert flown == [("mujoco", "reference"), *[("rotorpy", "examples/rotorpy.toml")] * 5]
    assert hidden_effect.vehicle_phrase(config) == "the simulator rotorpy"
    assert same.true_vehicle == "reference"
    effects, simulator = describe_hidden(config)
    assert "rotor_drag (coefficient 7.8e-05 kg/rad)" in effects and "no linear_drag" in effects
    assert "the rotors' drag acts at each hub" in simulator
    copied = replace(load_vehicle("reference"), name="copied")
    save_vehicle(copied, tmp_path / "copied.toml", "")
    for one in (same, replace(same, hidden_vehicle=str(tmp_path / "copied.toml"))):
        effects, simulator = describe_hidden(one)
        assert effects == "The hidden vehicle's file is that of the simulation."
        assert "linear_drag: RotorPy's drag is proportional to the rotors' speed" in simulator


@pytest.mark.parametrize(
    ("nominal", "control", "named", "words"),
    [
        (39, 12, 36, ("25 % of 40 trials succeed, with the simulation's vehicle 98 %",
                      "more than the same fine-tuning without it (30 %; difference +60 points [+")),
        (40, 20, 20, ("not significantly different from the same fine-tuning without it",)),
        (39, 10, 40, ("and not significantly different from the policy where nothing is hidden",)),
        (20, 10, 40, ("and above the policy where nothing is hidden",)),
        (40, 10, 20, ("and below the policy where nothing is hidden",)),
        (11, 10, 11, ("does not lower the success rate significantly here", "raise --difficulty")),
        (1, 10, 11, ("perhaps --vehicle and --hidden-vehicle are swapped",)),
    ],
)  # fmt: skip
def test_the_verdict_claims_what_the_intervals_hold(nominal, control, named, words):
    won = {"nominal": nominal, "before": 10, "control": control, "named": named}
    standings = policy_results(results_of(won), ("before", "control", "nominal"))
    said = hidden_effect.verdict(standings, answer([NAMED]), 40)
    assert all(one in said for one in words), said
    assert ("nothing to regain" in said) == (nominal == 11)
