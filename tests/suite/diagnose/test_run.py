"""What `suite diagnose` writes, by rollouts and by views, and what it refuses."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.logs.flight_log import read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main
from suite.diagnose import run as diagnose_run
from suite.diagnose.sources.rollouts import can_fly
from tests.support.commands import refused
from tests.support.diagnosis_flights import fly
from tests.support.real_flights import VEHICLE, flights
from tests.support.recordings import columns
from tests.support.vehicles import PLAIN, REMEMBERING, with_effects

STEPS = ["The logs", "The measurement noise", "The candidates",
         "Alternatives to the named effects", "Remaining error", "The evidence"]  # fmt: skip


@pytest.fixture
def written(diagnosed):
    """Return the folder of what was written."""
    return diagnosed[0]


def test_files_come_out_whole_and_bad_flights_are_named(written):
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


def test_without_a_recording_all_else_is_written(diagnosed, tmp_path, monkeypatch):
    flights, made = diagnosed[0].parent, diagnosed[1]
    monkeypatch.setattr(diagnose_run, "diagnose", lambda *_, **options: made)
    line = [str(flights / "0.parquet"), "--vehicle", str(flights / "v.toml"), "--no-recording"]
    assert main(["diagnose", *line, "--out", str(tmp_path)]) == 0
    names = {"diagnosis.json", "report.html", "run.json", "vehicle.toml"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_every_step_is_in_the_report(written):
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


def test_the_recording_has_what_was_measured_and_simulated(written):
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


def test_what_is_read_is_not_written_over_and_flights_too_short_or_missing_are_refused(
    tmp_path, capsys
):
    save_vehicle(PLAIN, tmp_path / "vehicle.toml")
    own, out = tmp_path / "vehicle.toml", ("--out", tmp_path)
    said = refused(capsys, "diagnose --vehicle", own, tmp_path, *out)
    assert "vehicle.toml is also an input and would be overwritten" in said
    assert "none.csv" in refused(capsys, "diagnose --vehicle reference", tmp_path / "none.csv")
    record = {"config_type": "suite.loop.config.LoopConfig", "command": ["suite", "loop"]}
    (tmp_path / "run.json").write_text(json.dumps(record))
    said = refused(capsys, "diagnose --vehicle reference", tmp_path, *out)
    assert "holds a run of another kind (made by suite loop)" in said
    path = write_flight(tmp_path / "short.parquet", fly(PLAIN, 0, duration_s=1.2))
    assert "1.3 s" in refused(capsys, "diagnose --vehicle reference", path)


def test_logs_without_what_a_rollout_needs_are_diagnosed_by_views(log):
    assert can_fly([log], PLAIN)
    assert not can_fly([replace(log, about={"partial": ["quat"]})], PLAIN)
    no_commands = replace(log, rotor_speed=None, thrust_cmd=None, rate_cmd_b=None)
    pwm = np.full((len(log.time_s), 4), 0.5)
    assert not can_fly([replace(no_commands, pwm=pwm)], PLAIN)
    # The state of a firmware's loop at the start of a stretch is in no log.
    assert can_fly([log], REMEMBERING)
    assert not can_fly([replace(log, rotor_speed=None)], REMEMBERING)


def test_a_change_is_written_as_every_diagnosis_is(tmp_path, capsys):
    save_vehicle(VEHICLE, tmp_path / "v.toml", "for a test")
    for folder, seed, effects in (("new", 8, {"mass_offset": (0.15,)}), ("old", 9, {})):
        (tmp_path / folder).mkdir()
        for number, log in enumerate(flights(2, seed, 4.0, 2.0, hidden=effects)):
            write_flight(tmp_path / folder / f"{number}.parquet", log)
    words = ["diagnose", str(tmp_path / "new"), "--reference", str(tmp_path / "old"), "--plan",
             "--drive", "motors", "--vehicle", str(tmp_path / "v.toml"),
             "--out", str(tmp_path / "out")]  # fmt: skip
    (tmp_path / "out").mkdir()
    (tmp_path / "out/recording.rrd").touch()
    assert main([*words, "--json"]) == 0
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


def test_a_single_reference_is_refused(tmp_path, capsys):
    save_vehicle(VEHICLE, tmp_path / "v.toml", "for a test")
    for number, log in enumerate(flights(2, duration_s=3.0)):
        write_flight(tmp_path / f"{number}.parquet", log)
    words = ("--reference", tmp_path / "1.parquet", "--vehicle", tmp_path / "v.toml")
    said = refused(capsys, "diagnose --out", tmp_path / "out", tmp_path / "0.parquet", *words)
    assert "at least 2" in said
    assert not (tmp_path / "out" / "diagnosis.json").exists()
