"""What a diagnosis writes: every step in the report, a recording that loads, a plan."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main
from tests.support.recordings import columns
from tests.support.vehicles import PLAIN, with_effects

STEPS = (
    "The logs",
    "The measurement noise",
    "The candidates",
    "Alternatives to the named effects",
    "Remaining error",
    "The evidence",
)


@pytest.fixture
def written(diagnosed):
    """Return the folder of what was written."""
    return diagnosed[0]


def test_files_come_out_whole_and_bad_flights_are_named(written):
    found = json.loads((written / "diagnosis.json").read_text(encoding="utf-8"))
    assert json.loads((written.parent / "said.json").read_text(encoding="utf-8")) == found
    assert any("bad.csv" in warning for warning in found["warnings"])
    names = {effect["name"] for effect in found["effects"]}
    assert names and set(load_vehicle(written / "vehicle.toml").effects) == names


def test_every_step_is_in_the_report(written):
    text = (written / "report.html").read_text(encoding="utf-8")
    shown = re.findall(r"<h2>(.*?)</h2>", text)
    assert shown[:2] == ["What to do next", "Measured and simulated"]
    folded = re.findall(r'class="section"><summary>(.*?)</summary>', text)
    assert [head for head in folded if head in STEPS] == list(STEPS)
    assert "Actuators, apart from the air" in folded
    assert text.count("data:image/png;base64,") >= 3
    assert "<script" not in text and not re.search(r'(src|href)="https?:', text)
    for link in re.findall(r'href="([^"]+)"', text):
        assert (written / link).is_file()


def test_the_numbers_beside_the_names_are_in_the_json(written):
    found = json.loads((written / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["seed"] == 3 and found["black_box"] is None
    assert found["actuators"][0]["followed"] > 0.9
    effect = found["effects"][0]
    assert found["plan"]["flights"] == [] or effect["alternatives"]


def test_the_recording_holds_what_was_measured_and_simulated(written):
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


def test_the_recording_opens_with_the_command_that_people_have(written):
    line = [sys.executable, "-m", "rerun", "rrd", "verify", str(written / "recording.rrd")]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_file_with_a_load_on_a_line_is_refused_in_one_line(tmp_path, capsys):
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), tmp_path / "loaded.toml")
    line = [str(tmp_path), "--vehicle", str(tmp_path / "loaded.toml"), "--out", str(tmp_path / "o")]
    assert main(["diagnose", *line]) == 2
    said = capsys.readouterr().err.strip()
    assert "effects.slung_load" in said and "remove it" in said and "\n" not in said


def test_what_is_read_is_not_written_over(tmp_path, capsys):
    save_vehicle(PLAIN, tmp_path / "vehicle.toml")
    flown = tmp_path / "plan" / "flights" / "plan_1_circle.parquet"
    flown.parent.mkdir(parents=True)
    flown.write_bytes(b"a log")
    own, out = str(tmp_path / "vehicle.toml"), ["--out", str(tmp_path)]
    for args in (["--vehicle", own], ["--vehicle", "reference", "--fly", own],
                 ["--vehicle", "reference", "--fly", "reference"]):  # fmt: skip
        assert main(["diagnose", str(flown), *args, *out]) == 2
        said = "plan_1_circle.parquet" if own not in args else "vehicle.toml"
        assert f"{said} is also an input and would be overwritten" in capsys.readouterr().err
