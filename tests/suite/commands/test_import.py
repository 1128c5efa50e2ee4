"""`suite identify`, `suite import` and `suite example` from the command line."""

import json

import pytest

from eval.logs.flight_log import read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite import cli
from suite.diagnose.example.flights import FOLDER, HIDDEN
from tests.support import foreign_logs as made
from tests.support import identified as known


def test_a_log_becomes_a_flight_log(tmp_path, capsys):
    log, out = made.write_ulog(tmp_path / "log.ulg"), tmp_path / "flight.parquet"
    code = cli.main(["import", str(log), "--out", str(out), "--full-thrust", "30"])
    said = capsys.readouterr().out
    assert code == 0 and "attitude: the force off body z is" in said
    flight = read_flight(out)
    assert f"{len(flight.time_s)} rows" in said and flight.about["source"] == "px4"


def test_json_is_one_object(tmp_path, capsys):
    log, out = made.write_usd(tmp_path / "log00"), tmp_path / "flight.csv"
    assert cli.main(["import", str(log), "--out", str(out), "--vehicle", "racer5", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["rows"] == len(read_flight(out).time_s)
    assert {"status", "signal", "evidence"} < set(answer["findings"][0])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--out", "flight.txt"], "--out is 'flight.txt'"),
        (["--rate", "0"], "--rate is 0"),
        (["--full-thrust", "-3"], "--full-thrust is -3"),
        (["--start", "5", "--end", "2"], "0 <= start < end"),
        (["--pose-map", "m.toml"], "--pose, which is not given"),
        (["--vehicle", "racer6"], "racer5"),
        (["--format", "px5"], "px4"),
        (["--pose", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["--format", "table", "--map", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
)
def test_bad_options_are_code_2_in_one_line(tmp_path, capsys, options, reason):
    log = made.write_usd(tmp_path / "log00", span=(0, 3))
    out = tmp_path / "flight.parquet"
    where = [] if "--out" in options else ["--out", str(out)]
    code = cli.main(["import", str(log), *where, *options])
    said = capsys.readouterr().err
    assert code == 2 and reason in said and "Traceback" not in said and not out.exists()


def test_a_log_that_is_read_is_not_written_over(tmp_path, capsys):
    log, pose = made.write_usd(tmp_path / "log00", span=(0, 3)), tmp_path / "pose.csv"
    pose.write_text("t\n")
    table = log.rename(tmp_path / "log.csv")
    for args in (
        [str(table), "--out", str(table)],
        [str(table), "--pose", str(pose), "--out", str(pose)],
    ):
        assert cli.main(["import", *args]) == 2
        assert f"{args[-1]} is also an input" in capsys.readouterr().err
    assert pose.read_text() == "t\n"


FILES = sorted(FOLDER.glob("*.parquet"))


def test_the_command_copies_all_a_diagnosis_needs(tmp_path, capsys):
    assert cli.main(["example", "--out", str(tmp_path / "x"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["files"] == sorted([*(p.name for p in FILES), "vehicle.toml"])
    for name in answer["files"]:
        assert (tmp_path / "x" / name).read_bytes() == (FOLDER / name).read_bytes()


def test_the_real_flights_come_as_published_with_licence_and_mapping(tmp_path, capsys):
    assert cli.main(["example", "--real", "--out", str(tmp_path), "--json"]) == 0
    names = json.loads(capsys.readouterr().out)["files"]
    logs = [name for name in names if name.endswith(".csv")]
    assert len(logs) == 2
    for name in logs:
        assert f"{name.removesuffix('.csv')}_metadata.yaml" in names
        rows = (tmp_path / name).read_text().splitlines()
        assert rows[0].startswith("t,px,py,pz,qx,qy,qz,qw,vx") and len(rows) == 1451
    assert "Redistributions in binary form" in (tmp_path / "LICENSE").read_text()
    assert "arXiv 2603.09908" in (tmp_path / "README.md").read_text()
    packed = sum(path.stat().st_size for path in (FOLDER / "real").iterdir() if path.is_file())
    assert packed < 320_000


def test_a_real_log_imports_at_the_first_try_and_tells_a_vehicle(tmp_path, capsys):
    assert cli.main(["example", "--real", "--out", str(tmp_path)]) == 0
    raw, log = tmp_path / "B3_figure8_fast_rep1.csv", tmp_path / "eight.parquet"
    line = ["--map", str(tmp_path / "nanobench.toml"), "--vehicle", "crazyflie21"]
    assert cli.main(["import", str(raw), *line, "--out", str(log)]) == 0
    line = ["--vehicle", "crazyflie21", "--out", str(tmp_path / "mine.toml"), "--json"]
    capsys.readouterr()
    assert cli.main(["identify", str(log), *line]) == 0
    found = json.loads(capsys.readouterr().out)
    drag = found["parameters"]["effects.linear_drag.coefficient"]["value"]
    assert 0.3 < drag[0] < 0.6 and 0.3 < drag[1] < 0.6
    assert any("a crazyflie loop are not fitted" in text for text in found["not_identified"])


@pytest.mark.slow
def test_the_diagnosis_names_it(tmp_path, capsys):
    assert cli.main(["example", "--out", str(tmp_path / "x")]) == 0
    line = [str(tmp_path / "x"), "--vehicle", str(tmp_path / "x" / "vehicle.toml")]
    capsys.readouterr()
    assert cli.main(["diagnose", *line, "--out", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert effect["name"] == "com_offset" and effect["alternatives"] == []
    entry = effect["parameters"]["offset"]
    for truth, (low, high) in zip(HIDDEN["com_offset"].offset[:2], entry["ci95"][:2], strict=True):
        half = (high - low) / 2
        assert low - half <= truth <= high + half
    assert entry["value"][2] is None and found["gap"]["after"] < 1.15


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
