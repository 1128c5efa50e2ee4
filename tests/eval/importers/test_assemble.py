"""A recording becomes a checked flight log, or is refused for what it lacks; what is reported."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.assemble import assemble, usable_for
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, Signal
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding, finding_lines
from eval.logs.flight_log import read_flight, write_flight
from tests.support.imported import flight, write
from tests.support.vehicles import PLAIN


def test_half_a_command_is_left_out_or_refused(tmp_path):
    good = flight()
    lone = {name: value for name, value in good.items() if name != "cmd_thrust"}
    path = write(tmp_path / "log.csv", lone)
    with pytest.raises(FlightLogError, match="neither a thrust and rate command nor motor"):
        import_log(path)


def recording(**left_out):
    parts = flight(end=2.0)
    signals = {
        name: Signal(parts["time"], value)
        for name, value in parts.items()
        if name != "time" and name not in left_out
    }
    return Recording("log.bin", signals, about={"firmware": "made up"})


def test_a_recording_becomes_a_log_that_says_where_it_is_from():
    log, findings = assemble(recording(), "made", ImportOptions(vehicle=PLAIN))
    parts = flight(end=2.0)
    np.testing.assert_allclose(log.pos_w, parts["pos"], atol=1e-12)
    assert log.thrust_cmd is not None
    np.testing.assert_allclose(log.thrust_cmd, parts["cmd_thrust"][:, 0], atol=1e-12)
    known = {key: log.about[key] for key in ("firmware", "source", "imported_from", "vehicle")}
    assert known == {
        "firmware": "made up",
        "source": "made",
        "imported_from": "log.bin",
        "vehicle": "plain",
    }
    assert log.about["findings"] == [finding._asdict() for finding in findings]


def test_start_and_end_cut_more_than_the_time_on_the_ground():
    parts = dict(recording().signals)
    del parts["cmd_thrust"], parts["cmd_rate"]
    time_s = parts["pos"].time_s
    flying = (time_s > 0.4) & (time_s < 1.7)
    height = np.where(flying, 1.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    parts["pos"] = Signal(time_s, height)
    parts["motor"] = Signal(time_s, np.where(flying, 800.0, 50.0)[:, None] * np.ones(4))
    asked = ImportOptions(fix=False, start_s=0.1, end_s=1.6)
    log, findings = assemble(Recording("log", parts), "made", asked)
    assert any("before take-off and the" in f.evidence for f in findings)
    assert log.rotor_speed is not None and log.rotor_speed.min() > 400.0
    assert log.duration_s == pytest.approx(1.2, abs=0.05)
    kept, _ = assemble(Recording("log", parts), "made", replace(asked, trim=False))
    assert kept.duration_s == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        (["rate"], r"log\.bin: holds no gyro; --partial keeps"),
        (["pos", "quat"], "holds no position and no attitude; --pose FILE adds"),
    ],
)
def test_what_a_log_needs_is_asked_for(missing, reason):
    with pytest.raises(FlightLogError, match=reason):
        assemble(recording(**dict.fromkeys(missing)), "made", ImportOptions())


def test_a_partial_log_keeps_what_is_there_and_says_what_can_be_asked(tmp_path):
    parts = flight(end=2.0)
    lone = recording(quat=None, cmd_rate=None)
    with pytest.raises(FlightLogError, match="no attitude"):
        assemble(lone, "made", ImportOptions())
    log, findings = assemble(lone, "made", ImportOptions(partial=True))
    assert log.partial == ("quat", "command")
    assert np.isnan(log.quat_wxyz).all()
    np.testing.assert_allclose(log.rate_b, parts["rate"], atol=1e-12)
    said = [finding for finding in findings if finding.signal == "partial"]
    assert "the vertical force" in said[0].evidence
    write_flight(tmp_path / "log.parquet", log)
    with pytest.raises(FlightLogError, match="a partial log, without quat, command"):
        read_flight(tmp_path / "log.parquet")
    back = read_flight(tmp_path / "log.parquet", partial=True)
    np.testing.assert_array_equal(back.thrust_cmd, log.thrust_cmd)
    assert back.partial == log.partial


def test_the_serious_come_first_and_the_rest_in_order():
    findings = (
        Finding("ok", "units", "as they should be"),
        Finding("note", "rows", "at 100 Hz"),
        Finding("doubt", "velocity", "is off"),
        Finding("note", "motors", "put in order"),
        Finding("corrected", "attitude", "is xyzw"),
    )
    assert finding_lines(findings) == [
        "corrected attitude: is xyzw",
        "doubt     velocity: is off",
        "note      rows: at 100 Hz",
        "note      motors: put in order",
        "ok        units: as they should be",
    ]


def test_motor_commands_and_positions_tell_weight_and_balance():
    rows = {"pos": np.zeros((3, 3)), "pwm": np.zeros((3, 4))}
    text = usable_for(rows, ["quat", "rate"]).evidence
    assert "no attitude and no body rates" in text
    assert "balance of the rotors in hover" in text
    assert "its torque" not in text


def test_a_path_alone_tells_nothing_more():
    text = usable_for({"pos": np.zeros((3, 3))}, ["quat", "rate", "command"]).evidence
    assert text.endswith("only its path")
