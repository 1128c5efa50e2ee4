"""A recording becomes a checked flight log, or is refused for what it lacks."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.assemble import assemble
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, Signal
from eval.logs.columns import FlightLogError
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


@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        (["rate"], r"log\.bin: holds no gyro; --partial keeps"),
        (["pos", "quat"], "holds no position and no attitude; --pose FILE brings"),
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
    said = [finding for finding in findings if finding.subject == "partial"]
    assert "the vertical force" in said[0].text
    write_flight(tmp_path / "log.parquet", log)
    with pytest.raises(FlightLogError, match="a partial log, without quat, command"):
        read_flight(tmp_path / "log.parquet")
    back = read_flight(tmp_path / "log.parquet", partial=True)
    np.testing.assert_array_equal(back.thrust_cmd, log.thrust_cmd)
    assert back.partial == log.partial
