"""Numbers of a known vehicle come back from its flights, each within its interval."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from suite.diagnose.identify.identify import identify
from suite.diagnose.identify.numbers import numbers_json
from tests.support import identified as known
from tests.support.broken_logs import changed, on_the_ground
from tests.support.diagnosis_flights import fly_all
from tests.support.marks import more
from tests.support.tools import program
from tests.support.vehicles import PLAIN, with_effects

pytestmark = pytest.mark.usefixtures("compiled_quickly")
TRUE = {
    "motors.thrust": known.MOTORS.thrust,
    "motors.voltage_exponent": (known.MOTORS.voltage_exponent,),
    "effects.linear_drag.coefficient": known.DRAG,
    "inertia": known.vehicle().inertia,
    "rotors.thrust_coefficient": (known.vehicle().rotors.thrust_coefficient,),
    "rotors.torque_coefficient": (known.vehicle().rotors.torque_coefficient,),
    "rotors.time_constant": (known.vehicle().rotors.time_constant,),
    "effects.command_delay.delay": (known.DELAY,),
    "effects.thrust_scale.scale": (1.0,),
    "controller.rate_gain": known.vehicle().controller.rate_gain,
}


def pulls(found):
    """Return by how many half-widths each identified number is off, by key and component."""
    off = {}
    for entry in found.numbers:
        true = TRUE[entry.key]
        if entry.key == "motors.thrust":
            # At the nominal voltage of the file.
            per = found.vehicle.motors.voltage / known.MOTORS.voltage
            per **= known.MOTORS.voltage_exponent
            true = (true[0] * per, true[1] * per**2)
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True)):
            if span is not None:
                off[entry.key, k] = (value - true[k]) / (0.5 * (span[1] - span[0]))
    return off


def near_truth(found, most=2.5):
    """Return what is identified, by key and component, all within so many half-widths."""
    off = pulls(found)
    assert np.max(np.abs(list(off.values()))) < most
    return set(off)


@pytest.mark.parametrize(
    ("drive", "least"), [("rates", 9), ("pwm", 7), more("rotors", 9), ("torques", 9)]
)
def test_identified_numbers_are_near_the_truth(drive, least):
    found = known.found(drive)
    assert found.drive == drive and len(near_truth(found)) >= least


@pytest.mark.extended
def test_rotor_speeds_of_another_flight_are_a_warning():
    one, other = known.logs("rotors", 0)[::3]
    rows = np.arange(len(one.time_s)) % len(other.time_s)
    mixed = replace(one, rotor_speed=other.rotor_speed[rows])
    wrong = identify([mixed], known.start(), leave=("drag", "loop"))
    assert "the model explains only" in wrong.notes[0]
    assert "angular acceleration about x" in wrong.notes[0]
    assert not any("explains only" in note for note in known.found("rotors").notes)


@pytest.mark.slow
def test_rotors_that_are_faster_than_the_rows_of_the_log_do_not_look_like_less_inertia():
    """Without a lag the torque falls between two rows, by a tenth here; the loop shows the lag."""
    logs = fly_all([PLAIN] * 3, range(3), duration_s=6.0, noise=0.2, motors=True)
    numbers = {number.key: number for number in identify(logs, PLAIN).numbers}
    twist = numbers["rotors.torque_coefficient"]
    for found, truth in ((numbers["inertia"], PLAIN.inertia), (twist, (2.2e-8,))):
        assert np.allclose(found.value[:2], truth[:2], rtol=0.04)  # about z the flights show little
        for (low, high), true in zip(found.ci95, truth, strict=True):
            assert low < true < high, found.key


@pytest.mark.slow
def test_intervals_of_every_number_hold_the_truth_as_often_as_they_say(root):
    coverage = program(root / "tools" / "coverage.py")
    found = coverage.measure(40, 0, list(coverage.CASES), "")
    assert len(found) > 40
    held = {key: sum(abs(pull) < 1.0 for _, pull, _ in rows) for key, rows in found.items()}
    for key, rows in found.items():
        # No count is unlikely with a coverage of 90 %, over all counts (Bonferroni).
        assert binom.cdf(held[key], len(rows), 0.90) > 0.05 / len(found), (key, held[key])
    assert 0.93 <= sum(held.values()) / sum(map(len, found.values())) <= 0.98


TURNING = ("inertia", "lag")
"""Parts that tests of forces leave: their fits take most of the time."""


@pytest.mark.extended
def test_parts_that_are_left_stay():
    begun = known.start()
    found = identify(known.logs("rates", 0, known.HOVER), begun, leave=(*TURNING, "drag", "loop"))
    assert "linear_drag" not in found.vehicle.effects
    assert found.vehicle.controller == begun.controller


def test_an_inertia_that_is_ten_times_too_large_is_identified():
    begun = known.start()
    begun = replace(begun, inertia=tuple(10.0 * moment for moment in begun.inertia))
    found = identify(known.logs("rotors", 0)[3:], begun, leave=("drag", "motors", "lag", "loop"))
    for moment, true in list(zip(found.vehicle.inertia, TRUE["inertia"], strict=True))[:2]:
        assert moment == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("drive", [more("rotors"), "pwm"])
def test_time_on_the_ground_does_not_count(drive):
    (log, *_), leave = known.logs(drive, 0), (*TURNING, "drag")
    resting = on_the_ground(log, log.duration_s, 3.0)  # for most of the log
    flies = resting.vel_w.any(axis=1)
    resting = changed(resting, pwm=lambda values: values * flies[:, None])
    alone, found = (identify([one], known.start(), leave) for one in (log, resting))
    assert near_truth(found) == near_truth(alone) and not found.notes
    assert found.residual_rms["force"] == pytest.approx(alone.residual_rms["force"], rel=0.2)


def without(logs, *fields):
    """Return the logs without these columns, as partial logs have them."""
    lost = dict.fromkeys(fields, lambda values: np.full_like(values, np.nan))
    return [changed(log, **lost) for log in logs]


WITHOUT_RATES = (
    "drag along body x and y: without",
    "inertia and torque_coefficient: no body rates",
    "time_constant and command_delay: no body rates",
)


@pytest.mark.parametrize(
    ("missing", "lines"),
    [((), ("drag along body x: too slow",)), (("quat_wxyz", "rate_b"), WITHOUT_RATES)],
)
def test_a_hover_identifies_thrust_and_reports_what_it_does_not(missing, lines):
    logs = without(known.logs("pwm", 0, known.HOVER), *missing)
    found = identify(logs, known.start(), leave=() if missing else TURNING)
    assert ("motors.thrust", 0) in near_truth(found, 2.0)
    reported = "\n".join(found.not_identified)
    assert all(line in reported for line in lines)
    assert found.vehicle.effects["linear_drag"].coefficient[:2] == (0.0, 0.0)
    assert found.vehicle.inertia == known.start().inertia


@pytest.mark.slow
def test_what_turns_is_identified_by_the_attitude_without_rates_and_without_positions():
    logs = known.logs("pwm", 0, sensors=replace(known.SENSORS, attitude=0.002))
    found = identify(without(logs, "rate_b"), known.start(), leave=("loop",))
    assert {("inertia", 0), ("inertia", 1)} <= near_truth(found)
    found = identify(without(known.logs("pwm", 0), "pos_w", "vel_w"), known.start())
    assert "rotors.torque_coefficient" in numbers_json(found.numbers)
    assert any(
        line.startswith("thrust and drag: these logs have no") for line in found.not_identified
    )


def cut(logs, name):
    """Return the logs with this column for five rows only."""
    first = {name: lambda values: np.concatenate([values[:5], np.nan * values[5:]])}
    return [changed(log, **first) for log in logs]


def without_voltage(logs):
    return [replace(log, voltage=None) for log in logs]


@pytest.mark.extended
def test_a_file_without_motors_gets_them_and_keeps_its_voltage_for_flights_without_one():
    logs, bare = known.logs("pwm", 0)[:3], replace(known.start(), motors=None)
    begun = identify(logs, bare, leave=TURNING)
    motors = begun.vehicle.motors
    assert motors is not None and motors.voltage_exponent > 0.0
    keys = {key for key, _ in near_truth(identify(logs, begun.vehicle, leave=TURNING))}
    assert keys >= {"motors.thrust", "motors.voltage_exponent"}
    again = identify(without_voltage(logs), begun.vehicle, leave=TURNING)
    assert "motors.thrust" in numbers_json(again.numbers)
    after = again.vehicle.motors
    assert after is not None and after == replace(motors, thrust=after.thrust)
    (line,) = [text for text in again.not_identified if text.startswith("voltage_exponent")]
    assert "assumed to be that at 16.4" in line


def test_what_lag_and_delay_make_together_does_not_pass_for_a_delay():
    found = known.found("pwm")
    assert "effects.command_delay.delay" not in numbers_json(found.numbers)
    # Their sum is identified, and the file has it, however its lag shares it.
    rest = found.vehicle.effects["command_delay"].delay
    total_s = known.vehicle().rotors.time_constant + known.DELAY
    assert found.vehicle.rotors.time_constant + rest == pytest.approx(total_s, abs=0.004)
    assert any(line.startswith("command_delay: only its sum with") for line in found.not_identified)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("drive", "column", "key", "line"),
    [
        ("rates", "rate_cmd_b", "effects.thrust_scale.scale", "rate_gain: these logs have no"),
        ("rotors", "rotor_speed_cmd", "inertia", "time_constant and command_delay: these logs"),
    ],
)
def test_commands_that_stop_early_do_not_identify_what_needs_them(drive, column, key, line):
    found = identify(cut(known.logs(drive, 0)[::3], column), known.start())
    assert key in numbers_json(found.numbers)
    assert any(text.startswith(line) and "with both" in text for text in found.not_identified)


@pytest.mark.extended
def test_a_flight_without_commands_or_voltage_takes_nothing_from_the_others():
    logs = known.logs("pwm", 0)
    alone = numbers_json(identify(logs[:3], known.start(), leave=TURNING).numbers)
    assert set(alone) >= {"motors.thrust", "motors.voltage_exponent"}
    short = identify([*logs[:3], *cut(logs[3:], "pwm")], known.start(), leave=TURNING)
    no_voltage = identify([*logs[:3], *without_voltage(logs[3:])], known.start(), leave=TURNING)
    assert no_voltage.notes[0].startswith("no voltage in flight_3: ")
    for found in (short, no_voltage):
        entries = numbers_json(found.numbers)
        assert set(entries) == set(alone)
        for key, entry in entries.items():
            np.testing.assert_allclose(entry["value"], alone[key]["value"], rtol=1e-3)


@pytest.mark.extended
def test_rotors_that_are_logged_in_turn_identify_all_but_their_lag():
    def in_turn(speed):
        return np.where(np.arange(len(speed))[:, None] % 4 == np.arange(4), speed, np.nan)

    logs = [changed(log, rotor_speed=in_turn) for log in known.logs("rotors", 0)[::3]]
    found = identify(logs, known.start())
    keys = {key for key, _ in near_truth(found)}
    assert keys >= {"rotors.thrust_coefficient", "inertia"}
    assert not {"rotors.time_constant", "effects.command_delay.delay"} & keys
    assert any("all four in every row" in line for line in found.not_identified)
    assert sum("no row has all columns of rotor_speed" in note for note in found.notes) == 2


def test_a_scale_of_the_thrust_that_is_left_alone_counts():
    logs = known.logs("thrust", 0, scale=0.8)
    begun = with_effects(known.start(), thrust_scale=(0.8,))
    found = identify(logs, begun, leave=("motors", *TURNING))
    assert found.vehicle.effects["thrust_scale"].scale == 0.8
    (drag,) = [n for n in found.numbers if n.key == "effects.linear_drag.coefficient"]
    for value, true, span in zip(drag.value, known.DRAG, drag.ci95, strict=True):
        assert span is not None and span[1] - span[0] < 0.1
        assert value == pytest.approx(true, abs=0.03)


def test_flights_that_identify_nothing_are_refused_with_what_they_lack():
    logs = without(known.logs("pwm", 0), "pos_w", "vel_w", "quat_wxyz", "rate_b")
    with pytest.raises(ValueError, match="flight_0, .*: no stretch of a second with positions"):
        identify(logs, known.start())
    with pytest.raises(ValueError, match="without drag nothing is identifiable: thrust and"):
        identify(logs, known.start(), leave=("drag",))
