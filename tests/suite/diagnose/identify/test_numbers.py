"""Fitted numbers become entries of a file; what is not identified is reported with the reason."""

import re
from dataclasses import replace

import numpy as np
import pytest

from eval.logs.flight_log import write_flight
from eval.vehicles.vehicle import MotorMap
from suite.common.console import Console
from suite.diagnose.identify import run
from suite.diagnose.identify.body import lag_unknowns
from suite.diagnose.identify.entries import (
    DELAY,
    inertia_from,
    loop_entries,
    with_entries,
    with_reachable_speed,
)
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.identify import Identified
from suite.diagnose.identify.numbers import Number, not_attempted, not_identified
from suite.diagnose.identify.run import PARTS, identify_files
from tests.support import identified as known
from tests.support.vehicles import PLAIN, with_effects

DRAG = "effects.linear_drag.coefficient"


def test_the_inertia_about_z_follows_the_others():
    found = inertia_from(PLAIN, {"inertia_x": 0.2, "inertia_y": 0.0})
    np.testing.assert_allclose(found[2], PLAIN.inertia[2] * np.exp(0.1))
    assert np.all(found <= found.sum() - found + 1e-15), "no body has one larger than both others"


def test_rotors_that_are_too_slow_to_hover_get_the_speed_that_they_flew_at():
    """1.6e-6 x 1000^2 = 1.6 N a rotor, of 1.84 N that are needed; one row is no speed."""
    speeds = [np.full((50, 4), 1100.0), np.full((60, 4), 1200.0), np.full((1, 4), 9e4)]
    slow = replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=1000.0))
    assert with_reachable_speed(slow, speeds).rotors.speed_max == 1200.0
    assert with_reachable_speed(PLAIN, speeds) == PLAIN


def test_identified_numbers_are_put_in_and_what_no_file_may_hold_is_noted():
    lag = Number("rotors.time_constant", "s", [0.05], [(0.04, 0.06)])
    assert with_entries(PLAIN, [lag])[0].rotors.time_constant == 0.05
    assert with_entries(PLAIN, [lag._replace(ci95=[None])])[0] == PLAIN
    spans = [(0.2, 0.4), (-0.2, 0.0), None]
    drag = Number(DRAG, "1/s", [0.3, -0.1, 0.0], spans)
    vehicle, (entry,), (note,) = with_entries(PLAIN, [drag])
    assert vehicle.effects["linear_drag"].coefficient == tuple(entry.value) == (0.3, 0.0, 0.0)
    assert entry.ci95 == spans and note.startswith(f"{DRAG}[1]: these flights give -0.1")
    late = with_effects(PLAIN, command_delay=(0.03,), linear_drag=((0.1, 0.1, 0.1),))
    none = Number(DELAY, "s", [-0.001], [(-0.002, 0.0)])
    vehicle, numbers, (note,) = with_entries(late, [none])
    assert set(vehicle.effects) == {"linear_drag"} and numbers == []
    assert note.endswith("the file has none")
    assert with_entries(late, [none._replace(ci95=[None])])[0] == late


@pytest.mark.parametrize(("half", "identified"), [(0.008, True), (0.009, False)])
def test_a_delay_is_no_better_known_than_the_lag_however_well_their_sum_is(half, identified):
    """The widest interval is +-12 ms: a sum within 8 ms minus a lag within 8 ms has 11.3 ms."""
    covariance = np.diag([half**2, half**2]) / 1.96**2
    unknowns = tuple(lag_unknowns(0.03, 0.04))
    fitted = Fitted(unknowns, np.array([0.05, 0.03]), np.full(2, half), covariance)
    (delay,) = [entry for entry in loop_entries(PLAIN, fitted) if entry.key == DELAY]
    assert (delay.ci95 != [None]) == identified == (not delay.follows)
    # The file keeps the sum.
    assert with_entries(PLAIN, [delay])[0].effects["command_delay"].delay == pytest.approx(0.02)
    negative = delay._replace(value=[-0.003])
    assert "command_delay" not in with_entries(PLAIN, [negative])[0].effects


def found(*names, left=()):
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 0.1) for name in names)
    none = np.zeros(len(names))
    return Fitted(unknowns, none, none, np.diag(none), tuple(left))


def test_what_one_fit_leaves_and_another_identifies_is_identified():
    fitted = {"torque": found("lag", "late", left=["lag", "late"]), "loop": found("lag")}
    entries = {DELAY: Number(DELAY, "s", [0.0], [None])}
    assert [line.split(":")[0] for line in not_identified(fitted, entries)] == ["command_delay"]


FORCE, TORQUE, LOOP = found("thrust", "drag_x"), found("inertia_x", "late"), found("gain_x")
COMPLETE = {"force": FORCE, "torque": TORQUE, "loop": LOOP}


@pytest.mark.parametrize(
    ("drive", "without", "broken", "line"),
    [
        ("rates", "torque", "", "inertia and torque_coefficient: commanded rates and thrust"),
        ("rotors", "torque", "", "time_constant and command_delay: measured rotor speeds do not"),
        ("rotors", "torque", "rotors", "time_constant and command_delay: .* both measured and"),
        ("pwm", "force", "force", "thrust and drag: .* with both the path"),
        ("pwm", "torque", "torque", "inertia and torque_coefficient: .* with both body rates"),
        ("rates", "loop", "loop", "rate_gain: .* with both body rates and commanded ones"),
        ("pwm", "", "", None),
    ],
)  # fmt: skip
def test_what_has_no_column_or_never_both_is_reported(drive, without, broken, line):
    signals = dict.fromkeys(["voltage", "rotor_speed", "rate_b", "rate_cmd_b"], np.zeros(10))
    flights = [FlightGrid("made", STEP_S * np.arange(10), signals)]
    fitted = {name: fit for name, fit in COMPLETE.items() if name != without}
    lines = not_attempted(flights, PLAIN, drive, fitted, [], [broken])
    if line is None:
        assert lines == []
    else:
        assert any(re.match(line, text) for text in lines), lines


def test_a_firmwares_loop_is_not_fitted():
    firmware = replace(PLAIN, controller=replace(PLAIN.controller, kind="px4"))
    (line,) = not_attempted([], firmware, "rotors", {"force": FORCE, "torque": TORQUE}, [])
    assert line == "the rate loop: settings of a px4 loop are not fitted"


def test_parts_that_do_not_exist_and_nothing_but_parts_to_leave_are_refused(tmp_path):
    for leave, message in ((["wings"], f"allowed: {', '.join(PARTS)}"), (PARTS, "nothing remains")):
        with pytest.raises(ValueError, match=message):
            identify_files([tmp_path], "reference", tmp_path / "v.toml", leave, Console())


def test_numbers_that_no_file_may_hold_are_printed_with_the_refusal(tmp_path, monkeypatch):
    numbers = (Number("motors.thrust", "N", [9.0, -8.0], [(8.0, 10.0), None]),)
    weak = replace(PLAIN, motors=MotorMap((9.0, -8.0), 16.0))
    result = Identified(weak, numbers, ("the rest",), "pwm", {}, ("one",))
    monkeypatch.setattr(run, "identify", lambda *_: result)
    write_flight(tmp_path / "one.parquet", known.logs("rates", 0, known.HOVER)[0])
    out = tmp_path / "v.toml"
    with pytest.raises(ValueError, match="must grow with the command") as refused:
        identify_files([tmp_path / "one.parquet"], "reference", out, [], Console())
    assert "motors.thrust[0] = 9: 8 to 10 N\nnot identifiable: the rest" in str(refused.value)
    assert not out.exists()
