"""`suite check` on flights, and what diagnose and identify do of a log with an open fault."""

from dataclasses import replace

import numpy as np
import pytest

from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding, findings_of
from eval.logs.files import write_columns
from eval.logs.flight_log import columns_from_log, read_flight, write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from suite.experiments.injected.flights import as_log
from tests.eval.logs.faults.test_kinds import good
from tests.support.commands import answer, refused, run
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


def test_what_an_import_left_open_is_repeated_and_findings_of_earlier_versions_are_read(
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
    old = {"level": "doubt", "subject": "attitude", "text": "39 % off"}
    odd = ["odd", doubt._asdict() | {"confidence": "high"}, doubt._asdict() | {"fault": [1]}]
    assert findings_of({"findings": [old, *odd]}) == (Finding("doubt", "attitude", "39 % off"),)


def test_logs_of_several_vehicles_are_named(tmp_path, capsys, flight):
    flight(1.0, about={"vehicle": "a"}).rename(tmp_path / "first.parquet")
    flight(1.0, about={"vehicle": "b"})
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
