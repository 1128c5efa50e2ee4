"""What `suite diagnose` writes, refuses and plans; the shipped example of flights for it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.flights import simulate
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main
from suite.diagnose import plan as planning
from suite.diagnose import run as diagnose_run
from suite.diagnose.diagnose import diagnose
from suite.diagnose.example import flights as example
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.sources.rollouts import can_fly
from tests.support.broken_logs import rows
from tests.support.commands import refused
from tests.support.diagnosis_flights import fly_all
from tests.support.real_flights import VEHICLE, flights
from tests.support.recordings import columns
from tests.support.vehicles import LAGGED, PLAIN, REMEMBERING, with_effects

STEPS = ["The logs", "The measurement noise", "The candidates",
         "Alternatives to the named effects", "Remaining error", "The evidence"]  # fmt: skip


def test_files_come_out_whole_and_bad_flights_are_named(diagnosed):
    written = diagnosed[0]
    found = json.loads((written / "diagnosis.json").read_text(encoding="utf-8"))
    assert json.loads((written.parent / "said.json").read_text(encoding="utf-8")) == found
    assert any("bad.csv" in warning for warning in found["warnings"])
    assert set(load_vehicle(written / "vehicle.toml").effects) == {"linear_drag"}
    assert found["seed"] == 3
    assert found["actuators"][0]["followed"] > 0.9
    # One effect without alternatives leaves nothing to separate.
    assert [(effect["name"], effect["alternatives"]) for effect in found["effects"]] == [
        ("linear_drag", [])
    ]
    assert not found["plan"]["flights"] and "no flight is planned" in found["plan"]["words"][0]
    assert not (written / "plan").exists()


def test_without_a_recording_all_else_is_written(diagnosed, tmp_path, monkeypatch, capsys):
    flights, made = diagnosed[0].parent, diagnosed[1]
    monkeypatch.setattr(diagnose_run, "diagnose", lambda *_, **options: made)
    line = [str(flights / "0.parquet"), "--vehicle", str(flights / "v.toml"), "--no-recording"]
    assert main(["diagnose", *line, "--out", str(tmp_path)]) == 0
    names = {"diagnosis.json", "report.html", "run.json", "vehicle.toml"}
    assert {path.name for path in tmp_path.iterdir()} == names
    capsys.readouterr()
    monkeypatch.setattr(diagnose_run, "without_slow_rotors", lambda _: load_vehicle("none"))
    for more, said in (([], ""), (["--seed", "5"], "seed is 0 there, 5 here")):
        assert main(["diagnose", *line, "--out", str(tmp_path), *more]) == 2
        notes = capsys.readouterr().err
        assert said in notes and ("which will be overwritten" in notes) == bool(said)


def test_every_step_is_in_the_report(diagnosed):
    written = diagnosed[0]
    text = (written / "report.html").read_text(encoding="utf-8")
    shown = re.findall(r"<h2>(.*?)</h2>", text)
    assert shown[:2] == ["What to do next", "Measured and simulated"]
    folded = re.findall(r'class="section"><summary>(.*?)</summary>', text)
    assert [head for head in folded if head in STEPS] == STEPS
    assert "Actuators, apart from the air" in folded
    assert text.count("data:image/png;base64,") == 1
    assert "<script" not in text and not re.search(r'(src|href)="https?:', text)
    for link in re.findall(r'href="([^"]+)"', text):
        assert (written / link).is_file()


def test_the_recording_has_what_was_measured_and_simulated(diagnosed):
    written = diagnosed[0]
    found = columns(written / "recording.rrd")
    entities = {entity for entity, _ in found}
    simulated = ["simulated\\ as\\ given", "simulated\\ with\\ the\\ named\\ effects"]
    for who in ("measured", *simulated):
        assert f"/flight_0/world/{who}/drone" in entities
        assert f"/flight_0/velocity_x/{who}" in entities
    errors = []
    for who in simulated:
        _, values = found[f"/flight_0/error_velocity/{who}", "Scalars:scalars"]
        errors.append(float(np.sqrt(np.nanmean(np.array(values, dtype=float) ** 2))))
    assert errors[1] < 0.5 * errors[0]
    times, poses = found["/flight_0/world/measured/drone", "Transform3D:translation"]
    (held_out,) = json.loads((written / "diagnosis.json").read_text())["gap"]["held_out"]
    log = read_flight(written.parent / Path(held_out).name)
    assert len(poses) == len(log.time_s)
    np.testing.assert_allclose(np.array(poses)[:, 0], log.pos_w, atol=1e-5)
    assert times is not None and (np.diff(times) > 0).all()


@pytest.mark.parametrize("command", ["diagnose", "identify"])
def test_a_file_with_a_load_on_a_line_is_refused_before_flights_are_read(command, tmp_path, capsys):
    file, none, out = (str(tmp_path / name) for name in ("loaded.toml", "none.csv", "out.toml"))
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), file)
    said = refused(capsys, command, none, "--vehicle", file, "--out", out)
    assert "effects.slung_load" in said and "remove it" in said


def test_an_input_that_would_be_written_over_and_too_few_flights_are_refused(tmp_path, capsys):
    own, out = tmp_path / "vehicle.toml", ("--out", tmp_path)
    save_vehicle(PLAIN, own)
    said = refused(capsys, "diagnose --vehicle", own, tmp_path, *out)
    assert "vehicle.toml is also an input and would be overwritten" in said
    assert "none.csv" in refused(capsys, "diagnose --vehicle reference", tmp_path / "none.csv")
    record = {"config_type": "suite.loop.config.LoopConfig", "command": ["suite", "loop"]}
    (tmp_path / "run.json").write_text(json.dumps(record))
    said = refused(capsys, "diagnose --vehicle reference", tmp_path, *out)
    assert "holds a run of another kind (made by suite loop)" in said
    logs, new = fly_all([PLAIN] * 2, range(2), duration_s=2.0, motors=True), tmp_path / "new"
    short = write_flight(tmp_path / "short.parquet", rows(logs[0], logs[0].time_s < 1.2))
    assert "1.3 s" in refused(capsys, "diagnose --vehicle reference", short)
    one, other = (write_flight(tmp_path / f"{log.name}.parquet", log) for log in logs)
    given = (one, "--reference", other, "--vehicle", own, "--out", new)
    assert "at least 2" in refused(capsys, "diagnose", *given)
    assert not (new / "diagnosis.json").exists()


def test_logs_without_what_a_rollout_needs_are_diagnosed_by_views(log):
    assert can_fly([log], PLAIN)
    assert not can_fly([replace(log, about={"partial": ["quat"]})], PLAIN)
    no_commands = replace(log, rotor_speed=None, thrust_cmd=None, rate_cmd_b=None)
    pwm = np.full((len(log.time_s), 4), 0.5)
    assert not can_fly([replace(no_commands, pwm=pwm)], PLAIN)
    # The state of a firmware's loop at the start of a stretch is in no log.
    assert can_fly([log], REMEMBERING)
    assert not can_fly([replace(log, rotor_speed=None)], REMEMBERING)


def test_a_change_is_written_as_every_diagnosis_is(tmp_path, capsys, monkeypatch):
    save_vehicle(VEHICLE, tmp_path / "v.toml", "for a test")
    for folder, seed, effects in (("new", 8, {"mass_offset": (0.15,)}), ("old", 9, {})):
        (tmp_path / folder).mkdir()
        for number, log in enumerate(flights(2, seed, 3.0, 2.0, hidden=effects)):
            write_flight(tmp_path / folder / f"{number}.parquet", log)
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    Path("out/recording.rrd").touch()
    words = "diagnose new --reference old --plan --drive motors --vehicle v.toml --out out --json"
    assert main(words.split()) == 0
    kept = {"diagnosis.json", "vehicle.toml", "report.html", "run.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} - {"plan"} == kept
    said = capsys.readouterr()
    told = json.loads(said.out)
    names = {name for e in told["effects"] for name in (e["name"], *e["alternatives"])}
    assert "mass_offset" in names and told["views"] and len(told["reference"]) == 2
    assert any("--drive" in line for line in told["warnings"])
    assert any("depends on the motion" in line for line in told["warnings"]), "two new flights"
    assert "warning: --drive needs rollouts" in said.err
    planned = {flight["file"] for flight in told["plan"]["flights"]}
    assert planned and planned <= {path.name for path in (tmp_path / "out/plan").iterdir()}
    assert any("mass_offset" in words for words in told["plan"]["words"])
    for axis in told["gap"]["channels"]["force"].values():
        assert {"before", "after", "noise_floor", "repeatability"} <= set(axis)
    assert json.loads((tmp_path / "out/diagnosis.json").read_text())["verdict"] == told["verdict"]
    # Means of flights are compared: their floor is the spread of the reference flights, and the
    # chart has one point for each of the two reference flights and the held-out one.
    assert "the mean of each flight" in told["gap"]["measure"]
    assert 0.0 < told["gap"]["noise_floor"] < told["gap"]["before"]
    report = (tmp_path / "out/report.html").read_text()
    assert "data:image/png" in report and "flights 1 to 2 are the reference flights" in report
    assert "while p is at most 0.02" in report
    assert load_vehicle(str(tmp_path / "out/vehicle.toml")).effects


SET = {"effects": [{"name": "rotor_drag", "alternatives": ["linear_drag"]}]}
(DRAGS,) = planning.separations_of(["rotor_drag", "linear_drag"])


def test_the_plan_is_for_the_sets_alone_and_comes_back_from_its_file(tmp_path):
    ways, words = planning.trajectories_for(SET)
    assert {way.kind for way in ways} == {way.kind for way in DRAGS.separating}
    assert len(ways) == 2 * len(DRAGS.separating) and DRAGS.words in words[0]
    alone = {"effects": [{"name": "rotor_drag", "alternatives": []}]}
    assert planning.trajectories_for(alone) == ([], [])
    assert planning.write_plan(tmp_path / "plan", [], [])["flights"] == []
    assert not (tmp_path / "plan").exists()
    ways = [Trajectory("punches", 3.0, speed=2.0), Trajectory("hover", 2.0, turn="sweep")]
    plan, folder = planning.write_plan(tmp_path / "plan", ways, ["fly them"]), tmp_path / "plan"
    written = json.loads((folder / "plan.json").read_text())
    assert [Trajectory(**flight["trajectory"]) for flight in written["flights"]] == ways
    table = np.loadtxt(folder / plan["flights"][0]["file"], delimiter=",", skiprows=1)
    assert table.shape == (301, len(planning.COLUMNS))
    wanted = ways[0].reference(table[:, 0])
    np.testing.assert_allclose(table[:, 1:4], wanted.pos_w, atol=1e-5)
    np.testing.assert_allclose(table[:, 4:7], wanted.vel_w, atol=1e-4)
    fastest = np.linalg.norm(wanted.vel_w, axis=1).max()
    assert plan["flights"][0]["top_speed"] == pytest.approx(fastest)


def test_an_earlier_plan_goes_and_what_is_not_of_it_stays(tmp_path):
    folder = tmp_path / "plan"
    plan = planning.write_plan(folder, [Trajectory("hover", 3.0), Trajectory("punches", 3.0)], [])
    own, outside, file = folder / "own.parquet", tmp_path / "outside.csv", folder / "plan.json"
    own.write_bytes(b"a real flight")
    outside.write_text("not the plan's to remove")
    listed = json.loads(file.read_text())
    listed["flights"][0]["file"] = "../outside.csv"
    file.write_text(json.dumps(listed))
    planning.write_plan(folder, [], [])
    assert not file.exists() and not (folder / plan["flights"][1]["file"]).exists()
    assert own.exists() and outside.exists()
    file.write_text("[]")
    assert planning.write_plan(folder, *planning.trajectories_for(SET))["flights"]


@pytest.mark.slow
def test_flying_the_plan_turns_the_set_into_a_name():
    truth = with_effects(LAGGED, rotor_drag=(3e-5,))
    rng = np.random.default_rng(5)

    def flown(ways):
        sensors, flights = simulate.SENSORS["estimator"], simulate.fly(LAGGED, truth, ways)
        return [simulate.log_of(one, truth, sensors, rng, str(k)) for k, one in enumerate(flights)]

    logs = flown([*DRAGS.blurred, *DRAGS.blurred])
    found = diagnosis_json(diagnose(logs, LAGGED))
    (effect,) = found["effects"]
    assert {effect["name"], *effect["alternatives"]} >= {"rotor_drag", "linear_drag"}
    ways, _ = planning.trajectories_for(found)
    (effect,) = diagnosis_json(diagnose([*logs, *flown(ways)], LAGGED))["effects"]
    assert (effect["name"], effect["alternatives"]) == ("rotor_drag", [])
    low, high = effect["parameters"]["coefficient"]["ci95"]
    assert low < 3e-5 < high


def test_plans_name_catalogue_effects_and_end_in_flights():
    for entry in planning.SEPARATIONS:
        assert set(entry.pair) <= set(EFFECTS) and entry.pair[0] != entry.pair[1]
        assert entry.separating and entry.blurred and entry.words
    assert DRAGS.pair == ("linear_drag", "rotor_drag")
    (wind,) = planning.separations_of(["frame_tilt", "constant_wind + linear_drag"])
    assert wind.pair == ("constant_wind", "frame_tilt") and "two headings" in wind.words
    # An unknown pair gets the flights that excite most.
    assert planning.plan_for(["gusts", "inflow"])
    words = planning.advice("linear_drag", "rotor_drag")
    assert words.startswith("linear_drag from rotor_drag: ") and planning.OTHERWISE not in words
    assert planning.OTHERWISE in planning.advice("inflow", "gyro_bias")


FILES = sorted(example.FOLDER.glob("*.parquet"))


@pytest.mark.extended
def test_the_files_are_what_the_script_makes():
    made = example.make_flights()
    assert [path.stem for path in FILES] == [log.name for log in made]
    for path, log in zip(FILES, made, strict=True):
        kept = read_flight(path)
        assert (kept.integrator, kept.step_s) == (log.integrator, log.step_s)
        for name, bits in example.BITS.items():
            # Another machine's rounding may fall to the other side of a step.
            both = getattr(kept, name), getattr(log, name)
            np.testing.assert_allclose(*both, rtol=0, atol=1.01 * 2.0**-bits)


def test_the_files_are_small_and_nothing_in_them_tells_what_is_hidden():
    assert len(FILES) == 3 and sum(path.stat().st_size for path in FILES) < 400_000
    assert not set(example.HIDDEN) & set(load_vehicle(str(example.VEHICLE)).effects)
    for path in FILES:
        log = read_flight(path)
        assert (log.integrator, log.step_s) == ("euler", 0.002)
        text = json.dumps(log.about)
        assert "com_offset" not in text and "battery" not in text
