"""Files in, a vehicle file out; what cannot be left is refused."""

from dataclasses import replace

import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from eval.vehicles.vehicle import MotorMap
from suite.common.console import Console
from suite.diagnose.identify import run
from suite.diagnose.identify.identify import Identified
from suite.diagnose.identify.numbers import Number
from suite.diagnose.identify.run import PARTS, identify_files
from tests.support import identified as known
from tests.support.vehicles import PLAIN, with_effects


def test_a_part_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=f"allowed: {', '.join(PARTS)}"):
        identify_files([tmp_path], "reference", tmp_path / "v.toml", ["wings"], Console())


def test_leaving_everything_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing remains to estimate"):
        identify_files([tmp_path], "reference", tmp_path / "v.toml", PARTS, Console())


def test_what_was_found_is_said_where_no_file_may_hold_it(tmp_path, monkeypatch):
    numbers = (Number("motors.thrust", "N", [9.0, -8.0], [(8.0, 10.0), None]),)
    weak = replace(PLAIN, motors=MotorMap((9.0, -8.0), 16.0))
    found = Identified(weak, numbers, ("the rest",), "pwm", {}, ("one",))
    monkeypatch.setattr(run, "identify", lambda *_: found)
    write_flight(tmp_path / "one.parquet", known.logs("rates", 0)[0])
    out = tmp_path / "v.toml"
    with pytest.raises(ValueError, match="must grow with the command") as refused:
        identify_files([tmp_path / "one.parquet"], "reference", out, [], Console())
    assert "motors.thrust[0] = 9: 8 to 10 N\nnot identifiable: the rest" in str(refused.value)
    assert not out.exists()


def test_a_file_with_a_load_on_a_line_is_refused_before_the_flights_are_read(tmp_path):
    file = tmp_path / "loaded.toml"
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), file)
    with pytest.raises(ValueError, match="plain: effects.slung_load has a motion of its own"):
        identify_files([tmp_path / "none"], str(file), tmp_path / "v.toml", [], Console())
