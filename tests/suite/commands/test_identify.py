"""`suite identify` from the command line."""

import json

import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite import cli
from tests.support import identified as known


@pytest.fixture
def flights(tmp_path):
    folder = tmp_path / "flights"
    folder.mkdir()
    for index, log in enumerate(known.logs("rates", 0)[:3]):
        write_flight(folder / f"{index}.parquet", log)
    save_vehicle(known.start(), tmp_path / "start.toml")
    return folder


def test_a_vehicle_file_comes_out_with_what_was_told(flights, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    line = [str(flights), "--vehicle", str(tmp_path / "start.toml"), "--out", str(out)]
    assert cli.main(["identify", *line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["drive"] == "rates"
    gain = told["parameters"]["controller.rate_gain"]
    written = load_vehicle(out)
    assert list(written.controller.rate_gain) == gain["value"]
    assert gain["ci95"][0][0] < gain["value"][0] < gain["ci95"][0][1]
    assert "controller.rate_gain[0]" in out.read_text()
    assert len(told["flights"]) == 3


def test_the_file_that_is_started_from_is_not_written_over(flights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = (tmp_path / "start.toml").rename("vehicle.toml").read_text()
    assert cli.main(["identify", str(flights), "--vehicle", "./vehicle.toml"]) == 2
    assert "vehicle.toml is also an input and would be overwritten" in capsys.readouterr().err
    assert (tmp_path / "vehicle.toml").read_text() == before


def test_an_inertia_that_was_not_told_is_as_it_was_but_for_what_goes_with_the_others(
    tmp_path, monkeypatch, capsys
):
    inertia = {"value": [2.5, 2.0, 4.0], "unit": "kg m^2", "ci95": [[2.0, 3.0], None, None]}
    drag = {"value": [0.3, 0.0, 0.0], "unit": "1/s", "ci95": [[0.2, 0.4], None, None]}
    found = {
        "drive": "pwm",
        "parameters": {"inertia": inertia, "effects.linear_drag.coefficient": drag},
        "not_identified": [],
        "warnings": ["of a note"],
    }
    monkeypatch.setattr("suite.diagnose.identify.run.identify_files", lambda *_: found)
    line = ["identify", "none", "--vehicle", "reference", "--out", str(tmp_path / "v.toml")]
    assert cli.main(line) == 0
    said = "".join(capsys.readouterr())
    assert "inertia: 2.5 (2 to 3), 2 (as it was), 4 (goes with the others) kg m^2" in said
    assert "coefficient: 0.3 (0.2 to 0.4), 0 (as it was), 0 (as it was) 1/s" in said
    assert "warning: of a note" in said


@pytest.mark.parametrize(
    ("options", "reason"),
    [(["--leave", "wings"], "--leave 'wings': allowed"), (["--out", "v.json"], "must be .toml")],
)
def test_what_cannot_be_used_ends_with_2(flights, tmp_path, capsys, options, reason):
    line = [str(flights), "--vehicle", str(tmp_path / "start.toml")]
    line += ["--out", str(tmp_path / "v.toml")] if "--out" not in options else []
    assert cli.main(["identify", *line, *options]) == 2
    assert reason in capsys.readouterr().err
