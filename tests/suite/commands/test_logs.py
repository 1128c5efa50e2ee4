"""Commands on logs: check, import, identify and example."""

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import suite
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding, findings_of
from eval.logs.files import write_columns
from eval.logs.flight_log import columns_from_log, read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.diagnose.example.flights import FOLDER, HIDDEN
from suite.experiments.injected.flights import as_log
from tests.eval.logs.faults.test_kinds import good
from tests.support import foreign_logs as made
from tests.support.commands import answer, refused, run
from tests.support.log_tables import level
from tests.support.vehicles import PLAIN


@pytest.fixture
def flight(tmp_path):
    """Write a good flight with its rates times a factor, and return its path."""

    def written(factor, **changes):
        parts = good(end=10.0)
        log = as_log({**parts, "rate": factor * parts["rate"]}, "flight")
        return write_flight(tmp_path / "flight.parquet", replace(log, **changes))

    save_vehicle(PLAIN, tmp_path / "plain.toml")
    return written


def checked(tmp_path, capsys, path, *options):
    return answer(capsys, "check --vehicle", tmp_path / "plain.toml", path, *options)


def test_a_fault_is_reported_with_its_fix_and_put_right(tmp_path, capsys, flight):
    path, fix = flight(1.0 / 0.0174532925), ("--fix", "--out", tmp_path / "checked")
    found = gyro_scale(checked(tmp_path, capsys, path))
    assert found["status"] == "doubt" and found["fix"].startswith("--read rate=0.01745")
    assert found["flight"] == str(path) and found["confidence"] > 0.9
    assert abs(found["size"] - 57.3) < 2.0
    answered = checked(tmp_path, capsys, path, *fix)
    assert gyro_scale(answered)["status"] == "corrected"
    fixed = read_flight(answered["written"][0])
    np.testing.assert_allclose(fixed.rate_b, good(end=10.0)["rate"], rtol=1e-6, atol=1e-9)
    again = checked(tmp_path, capsys, answered["written"][0])
    assert not [f for f in again["findings"] if f["status"] == "doubt"]


def test_a_throttle_that_the_log_keeps_as_another_column_is_put_right(tmp_path, capsys, flight):
    throttle = good(end=10.0)["throttle"].ravel()
    path = flight(1.0, extra={"throttle": 1000.0 + 1000.0 * throttle})
    answered = checked(tmp_path, capsys, path, "--fix", "--out", tmp_path / "checked")
    assert ("throttle_range", "corrected") in {
        (finding["fault"], finding["status"]) for finding in answered["findings"]
    }
    fixed = read_flight(answered["written"][0]).extra["throttle"]
    np.testing.assert_allclose(fixed, throttle, atol=1e-12)


def gyro_scale(answered):
    """Return the one finding about the gyro's scale."""
    (found,) = (f for f in answered["findings"] if f["fault"] == "gyro_scale")
    return found


def test_a_log_beyond_all_limits_is_checked_and_corrected_but_not_diagnosed(tmp_path, capsys):
    save_vehicle(PLAIN, tmp_path / "plain.toml")
    parts, counts = good(end=10.0), 16.384 / 0.0174532925
    log = as_log({**parts, "rate": counts * parts["rate"]}, "flight")
    path = write_columns(tmp_path / "flight.csv", columns_from_log(log), "{}")
    with pytest.raises(FlightLogError, match="200 rad/s.*suite check names the fault"):
        read_flight(path)
    answered = checked(tmp_path, capsys, path, "--fix", "--out", tmp_path / "checked")
    assert gyro_scale(answered)["status"] == "corrected"
    fixed = read_flight(answered["written"][0])
    np.testing.assert_allclose(fixed.rate_b, parts["rate"], rtol=1e-6, atol=1e-9)


def test_nothing_is_concluded_of_a_log_with_an_open_fault(tmp_path, capsys, flight):
    path, out = flight(1.2), tmp_path / "out.toml"
    for command in ("diagnose", "identify"):
        line = (command, "--vehicle", tmp_path / "plain.toml", "--out", out, path)
        said = refused(capsys, *line, lines=3)
        assert "gyro_scale" in said and "--read rate=0.8" in said and "--accept gyro_scale" in said
        assert not out.exists()
        assert "gyro_scale" in refused(capsys, *line, "--accept", "gyro_scales")


def test_what_an_import_left_open_is_repeated_and_invalid_records_are_left_out(
    tmp_path, capsys, flight
):
    doubt = Finding("doubt", "motors", "6 motors turn", "motor_count", 6.0, 0.97, "none")
    path = flight(1.0, about={"findings": [doubt._asdict()]})
    assert findings_of(read_flight(path).about) == (doubt,)
    answered = checked(tmp_path, capsys, path)
    # Without --json the manoeuvre of every fault that this flight does not show is printed.
    assert run("check", path) == 0
    said = " ".join(capsys.readouterr().out.split())
    shown = [one["manoeuvre"] for one in answered["not_identifiable"]]
    assert shown and all(f": {manoeuvre}" in said for manoeuvre in shown)
    assert "motor_count" in {f["fault"] for f in answered["findings"]}
    line = ("diagnose --vehicle", tmp_path / "plain.toml", "--out", tmp_path / "out", path)
    assert "6 motors turn" in refused(capsys, *line, lines=3)
    short = {"status": "doubt", "signal": "attitude", "evidence": "39 % off"}
    odd = ["odd", doubt._asdict() | {"confidence": "high"}, doubt._asdict() | {"fault": [1]}]
    assert findings_of({"findings": [short, *odd]}) == (Finding("doubt", "attitude", "39 % off"),)


def test_logs_of_several_vehicles_are_named(tmp_path, capsys, flight):
    flight(1.0, about={"vehicle": "a"}).rename(tmp_path / "first.parquet")
    flight(1.0, about={"vehicle": "b"})
    assert run("check", tmp_path) == 0
    assert f"{tmp_path / 'flight.parquet'}: doubt" in capsys.readouterr().out
    found = answer(capsys, "check", tmp_path)["findings"]
    (mixed,) = (one for one in found if one["fault"] == "vehicle_mixed")
    assert mixed["flight"].endswith("flight.parquet") and "of vehicle 'b'" in mixed["evidence"]


def test_no_log_is_overwritten_by_its_correction_or_by_that_of_another(tmp_path, capsys, flight):
    first, second = flight(1.0), tmp_path / "b/flight.parquet"
    second.parent.mkdir()
    second.write_bytes(first.read_bytes())
    for flights, out, reason in (
        ([tmp_path], tmp_path, "is also an input"),
        ([tmp_path, second], second.parent, "is also an input"),
        ([tmp_path, second], tmp_path / "out", f"{first} and {second}"),
    ):
        assert reason in refused(capsys, "check", *flights, "--fix", "--out", out)
    assert first.read_bytes() == second.read_bytes() and not (tmp_path / "out").exists()


def test_fix_needs_flights(capsys):
    assert "--fix corrects flights" in refused(capsys, "check --vehicle racer5 --fix")


FILES = sorted(FOLDER.glob("*.parquet"))


def test_a_log_becomes_a_flight_log_and_json_is_one_object(tmp_path, capsys):
    log, out = made.write_ulog(tmp_path / "log.ulg"), tmp_path / "flight.parquet"
    assert run("import --full-thrust 30 --out", out, log) == 0
    said, flight = capsys.readouterr().out, read_flight(out)
    assert "attitude: the force off body z is" in said
    assert f"{len(flight.time_s)} rows" in said and flight.about["source"] == "px4"
    log, out = made.write_usd(tmp_path / "log00"), tmp_path / "flight.csv"
    found = answer(capsys, "import --vehicle racer5 --out", out, log)
    assert found["rows"] == len(read_flight(out).time_s)
    assert {"status", "signal", "evidence"} < set(found["findings"][0])


def test_time_on_the_ground_is_cut_or_kept(tmp_path, capsys):
    time_s = np.arange(0.0, 10.0, 0.01)
    height = np.interp(time_s, [2.0, 3.0, 7.0, 8.0], [0.0, 1.0, 1.0, 0.0])
    pos_w = height[:, None] * [0.0, 0.0, 1.0]
    motor = np.where((time_s > 2.0) & (time_s < 8.0), 800.0, 50.0)[:, None] + np.zeros(4)
    log = level(time_s, pos_w=pos_w, rotor_speed=motor)
    path = write_flight(tmp_path / "log.parquet", log)
    line = (path, "--out", tmp_path / "out.parquet")
    assert 550 < answer(capsys, "import --no-fix", *line)["rows"] < 800
    assert answer(capsys, "import --no-fix --keep-ground", *line)["rows"] == len(time_s)


def test_bad_options_are_code_2_in_one_line(tmp_path, capsys):
    log = made.write_usd(tmp_path / "log00", span=(0, 3))
    for options, reason in (
        ("--out flight.txt", "--out is 'flight.txt'"),
        ("--rate 1", "--rate is 1"),
        ("--motor-poles 13", "magnets is even"),
        ("--full-thrust -3", "--full-thrust is -3"),
        ("--start 5 --end 2", "0 <= start < end"),
        ("--pose-map m.toml", "--pose, which is not given"),
        ("--vehicle racer6", "racer5"),
        ("--format px5", "px4"),
        ("--pose nowhere.csv", "nowhere.csv: cannot be read"),
        ("--format table --map nowhere.toml", "nowhere.toml: cannot be read"),
    ):
        where = "" if "--out" in options else f"--out {tmp_path / 'flight.parquet'}"
        assert reason in refused(capsys, f"import {log} {where} {options}")
        assert [path.name for path in tmp_path.iterdir()] == [log.name]


def test_files_that_are_read_are_not_written_over(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    log, pose = made.write_usd(tmp_path / "log00", span=(0, 3)), tmp_path / "pose.csv"
    pose.write_text("t\n")
    vehicle, table = shutil.copy(FOLDER / "vehicle.toml", tmp_path), log.rename("log.csv")
    contents = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for line, path in (
        (f"import {table} --out {table}", table),
        (f"import {table} --pose {pose} --out {pose}", pose),
        (f"identify {FOLDER} --vehicle ./vehicle.toml", "vehicle.toml"),
    ):
        assert f"{path} is also an input" in refused(capsys, line)
    assert contents == {path: path.read_bytes() for path in tmp_path.iterdir()}
    said = refused(capsys, f"identify {FOLDER} --vehicle {vehicle} --out v.json")
    assert "must be .toml" in said
    (folder := tmp_path / "folder.toml").mkdir()
    for line in (f"identify {FOLDER} --vehicle racer5 --out", "import no.csv --out"):
        folder = folder.rename(folder.with_suffix(".csv" if "import" in line else ".toml"))
        assert f"is a directory: {folder}" in refused(capsys, line, folder)


def test_the_command_copies_all_a_diagnosis_needs(tmp_path, capsys):
    files = answer(capsys, "example --out", tmp_path)["files"]
    assert files == sorted([*(p.name for p in FILES), "vehicle.toml"])
    for name in files:
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes()
    (tmp_path / "mine.parquet").write_bytes(b"")
    assert run("example --out", tmp_path) == 0
    said = capsys.readouterr()
    assert "1 flight(s) that are not the example's" in said.err
    assert "flight_3.parquet --vehicle" in said.out and "mine" not in said.out
    (vehicle := tmp_path / "vehicle.toml").write_text("# my own\n")
    given = f"{tmp_path / 'flight_1.parquet'} --vehicle reference"
    asked = {"example": tmp_path, f"identify {given}": vehicle, f"diagnose {given}": tmp_path}
    for line, out in asked.items():
        assert f"{vehicle} exists, and " in refused(capsys, f"{line} --out", out)
    assert vehicle.read_text() == "# my own\n"


def test_the_next_command_can_be_pasted_if_the_folder_has_a_space(tmp_path, capsys):
    folder = tmp_path / "my flights"
    for option in ((), ("--real",)):
        assert run("example --out", folder, *option) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if "next: suite" in line)
    assert shlex.split(line)[3] == str(folder)
    text = (folder / "README.md").read_text()
    (line,) = [line for line in text.splitlines() if "import" in line and "eight" in line]
    assert shlex.split(line)[2] == f"{folder}/B3_figure8_fast_rep1.csv"


def test_the_real_flights_come_as_published(tmp_path, capsys):
    names = answer(capsys, "example --real --out", tmp_path)["files"]
    assert f"import {tmp_path}/B3_figure8_fast_rep1.csv" in (tmp_path / "README.md").read_text()
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


@pytest.mark.extended
def test_the_real_flights_tell_a_vehicle_at_the_first_try(tmp_path, capsys):
    assert run("example --real --out", tmp_path) == 0
    raw, log = tmp_path / "B3_figure8_fast_rep1.csv", tmp_path / "eight.parquet"
    mapping, out = tmp_path / "nanobench.toml", tmp_path / "mine.toml"
    assert run("import --vehicle crazyflie21 --end 8 --map", mapping, "--out", log, raw) == 0
    found = answer(capsys, "identify --vehicle crazyflie21 --out", out, log)
    drag = found["parameters"]["effects.linear_drag.coefficient"]
    assert 0.3 < drag["value"][0] < 0.6 and 0.3 < drag["value"][1] < 0.6
    assert drag["ci95"][0][0] < drag["value"][0] < drag["ci95"][0][1]
    assert any("a crazyflie loop are not fitted" in text for text in found["not_identified"])
    assert len(found["flights"]) == 1
    assert list(load_vehicle(out).effects["linear_drag"].coefficient) == drag["value"]
    assert "effects.linear_drag.coefficient[0]" in out.read_text()


@pytest.mark.slow
def test_the_diagnosis_names_it(tmp_path, capsys):
    assert run("example --out", tmp_path / "x") == 0
    line = ("diagnose --vehicle", tmp_path / "x" / "vehicle.toml", tmp_path / "x")
    found = answer(capsys, *line, "--out", tmp_path / "out")
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert effect["name"] == "com_offset" and effect["alternatives"] == []
    entry = effect["parameters"]["offset"]
    for truth, (low, high) in zip(HIDDEN["com_offset"].offset[:2], entry["ci95"][:2], strict=True):
        half = (high - low) / 2
        assert low - half <= truth <= high + half
    assert entry["value"][2] is None and found["gap"]["after"] < 1.15


def test_an_inertia_that_was_not_told_is_as_it_was_but_for_what_goes_with_the_others(
    tmp_path, monkeypatch, capsys
):
    inertia = {"value": [2.5, 2.0, 4.0], "unit": "kg m^2", "ci95": [[2.0, 3.0], None, None]}
    drag = {"value": [0.3, 0.0, 0.0], "unit": "1/s", "ci95": [[0.2, 0.4], None, None]}
    parameters = {"inertia": inertia, "effects.linear_drag.coefficient": drag}
    found = {"drive": "pwm", "parameters": parameters, "not_identified": [], "warnings": ["noted"]}
    given = []
    name = "suite.diagnose.identify.run.identify_files"
    monkeypatch.setattr(name, lambda *args: given.append(args) or found)
    line = "identify none --vehicle reference --leave drag lag --out"
    assert run(line, tmp_path / "v.toml") == 0
    for flights in (["none"], "none"):  # a text is one file, not its letters
        assert suite.identify_vehicle(flights, "reference", tmp_path / "v.toml") is found
    inputs = ([Path("none")], "reference", tmp_path / "v.toml")
    assert [(list(flights), *rest[:2]) for flights, *rest in given] == [inputs] * 3
    assert [tuple(args[3]) for args in given] == [("drag", "lag"), (), ()]
    said = "".join(capsys.readouterr())
    assert "inertia: 2.5 (2 to 3), 2 (as it was), 4 (goes with the others) kg m^2" in said
    assert "coefficient: 0.3 (0.2 to 0.4), 0 (as it was), 0 (as it was) 1/s" in said
    assert "warning: noted" in said
