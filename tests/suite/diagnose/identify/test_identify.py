"""Numbers of a known vehicle come back from its flights, each within its interval."""

from dataclasses import replace

import numpy as np
import pytest

from eval.judging.statistics import wilson
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.identify.identify import identify
from suite.diagnose.identify.numbers import numbers_json
from tests.support import identified as known
from tests.support.fleets import Fleet, logs_of
from tests.support.tools import program
from tests.support.vehicles import with_effects

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
    """How many half-widths every identified number is off, by key and component."""
    off = {}
    for entry in found.numbers:
        true = TRUE[entry.key]
        if entry.key == "motors.thrust":
            # At the start's nominal voltage.
            per = (15.0 / known.MOTORS.voltage) ** known.MOTORS.voltage_exponent
            true = (true[0] * per, true[1] * per**2)
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True)):
            if span is not None:
                off[entry.key, k] = (value - true[k]) / (0.5 * (span[1] - span[0]))
    return off


@pytest.mark.parametrize(
    ("drive", "least"), [("rates", 9), ("pwm", 7), ("rotors", 7), ("torques", 6)]
)
def test_what_flights_tell_is_near_the_truth(drive, least):
    found = known.found(drive)
    off = pulls(found)
    assert found.drive == drive
    assert len(off) >= least
    assert np.max(np.abs(list(off.values()))) < 2.5


@pytest.mark.parametrize("noise", [pytest.param(2.0, marks=pytest.mark.slow), 4.0])
def test_noise_of_the_rotor_speeds_makes_no_body_heavier_to_turn(noise):
    """Without a chirp they say little of the inertia: less than its own noise, and then nothing."""
    fleet = Fleet(known.truth(), known.WAYS[:3])
    sensors, rng = replace(known.SENSORS, rotor=noise), np.random.default_rng(0)
    logs = logs_of(fleet, known.recordings(known.WAYS[:3]), "rotors", rng, sensors=sensors)
    (entry,) = [n for n in identify(logs, known.start()).numbers if n.key == "inertia"]
    for value, true, span in zip(entry.value, TRUE["inertia"], entry.ci95, strict=True):
        assert span is None or abs(np.log(value / true)) < 0.2


@pytest.fixture(scope="module")
def coverage(root):
    """`tools/coverage.py`."""
    return program(root / "tools" / "coverage.py")


@pytest.fixture(scope="module")
def fleet(coverage):
    """A vehicle of drawn numbers, and its flights."""
    return coverage.fly_fleet(0, 1)


@pytest.mark.slow
def test_drawn_numbers_come_back_within_their_intervals(coverage, fleet):
    off = []
    for case in coverage.CASES:
        found = coverage.pulls(*fleet, case, np.random.default_rng(0))
        assert len(found) >= 3, case
        off += [pull for pull, _ in found.values()]
    assert np.sqrt(np.mean(np.square(off))) < 0.75
    assert np.max(np.abs(off)) < 2.5


@pytest.mark.slow
def test_intervals_of_every_number_hold_the_truth_as_often_as_they_say(coverage):
    found = coverage.measure(40, 0, list(coverage.CASES), "")
    assert len(found) > 40
    for (case, key), rows in found.items():
        held = sum(abs(pull) < 1.0 for _, pull, _ in rows)
        _, low, high = wilson(held, len(rows))
        assert low <= 0.98 and high >= 0.90, (case, key, held, len(rows))


TURNING = ("inertia", "lag")
"""Left alone where a test is of forces: what turns the body takes most of the time."""


def test_a_hover_tells_thrust_and_says_what_it_cannot():
    found = identify(known.logs("pwm", 0, known.HOVER), known.start(), leave=TURNING)
    estimated = numbers_json(found.numbers)
    assert "motors.thrust" in estimated
    words = " ".join(found.not_identified)
    assert "drag along body x: too slow" in words
    assert found.vehicle.effects["linear_drag"].coefficient[:2] == (0.0, 0.0)


def test_what_is_left_alone_stays():
    begun = known.start()
    found = identify(known.logs("rates", 0), begun, leave=("drag", "loop"))
    assert "linear_drag" not in found.vehicle.effects
    assert found.vehicle.controller == begun.controller


def without(logs, *fields):
    """The logs without these, as a partial log has them."""
    return [
        replace(log, **{name: np.full_like(getattr(log, name), np.nan) for name in fields})
        for log in logs
    ]


def test_without_an_attitude_the_thrust_is_told_and_the_drag_is_said_to_need_one():
    logs = without(known.logs("pwm", 0, known.HOVER), "quat_wxyz")
    found = identify(logs, known.start(), leave=TURNING)
    off = pulls(found)
    assert {key for key, _ in off} >= {"motors.thrust"}
    assert np.max(np.abs(list(off.values()))) < 2.0
    assert any(line.startswith("drag along body x and y: without") for line in found.not_identified)
    assert found.vehicle.effects["linear_drag"].coefficient[:2] == (0.0, 0.0)


def test_without_attitude_and_rates_what_turns_is_listed_as_not_identified():
    logs = without(known.logs("pwm", 0, known.HOVER), "quat_wxyz", "rate_b")
    found = identify(logs, known.start())
    assert "motors.thrust" in numbers_json(found.numbers)
    words = " ".join(found.not_identified)
    assert "inertia and torque_coefficient: no body rates" in words
    assert "time_constant and command_delay: no body rates" in words
    assert found.vehicle.inertia == known.start().inertia


def test_without_rates_the_attitude_tells_the_inertia(coverage, fleet):
    off = coverage.pulls(*fleet, "pwm without rates", np.random.default_rng(0))
    assert "inertia[0]" in off and "inertia[1]" in off


def test_without_positions_the_rates_tell_what_turns():
    found = identify(without(known.logs("pwm", 0), "pos_w", "vel_w"), known.start())
    assert "rotors.torque_coefficient" in numbers_json(found.numbers)
    assert any(
        line.startswith("thrust and drag: these logs have no") for line in found.not_identified
    )


def test_flights_that_hold_nothing_are_refused_with_what_they_lack():
    logs = without(known.logs("pwm", 0), "pos_w", "vel_w", "quat_wxyz", "rate_b")
    with pytest.raises(ValueError, match="flight_0, .*: no stretch of a second with positions"):
        identify(logs, known.start())


def cut(logs, name, rows=5):
    """The logs with this column for so many rows only."""
    found = []
    for log in logs:
        values = np.array(getattr(log, name), dtype=float)
        values[rows:] = np.nan
        found.append(replace(log, **{name: values}))
    return found


def without_voltage(logs):
    return [replace(log, voltage=None) for log in logs]


@pytest.mark.parametrize("first", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_file_from_flights_with_or_without_a_voltage_starts_flights_with_or_without(first):
    with_it = known.logs("pwm", 0)
    bare = replace(known.start(), motors=None)
    begun = identify(with_it if first else without_voltage(with_it), bare)
    motors = begun.vehicle.motors
    assert motors is not None and (motors.voltage_exponent > 0.0) == first
    later = identify(with_it, begun.vehicle)
    assert {key for key, _ in motor_pulls(later)} == {"thrust", "voltage_exponent"}
    assert np.max(np.abs(list(motor_pulls(later).values()))) < 2.5
    again = identify(without_voltage(with_it), begun.vehicle)
    assert "motors.thrust" in numbers_json(again.numbers)
    after = again.vehicle.motors
    assert after is not None and after == replace(motors, thrust=after.thrust)
    (line,) = [text for text in again.not_identified if text.startswith("voltage_exponent")]
    assert ("assumed to be that at 16.4" in line) == first


def motor_pulls(found):
    """How many half-widths the motors are off at the nominal voltage that they have now."""
    motors, off = found.vehicle.motors, {}
    per = (motors.voltage / known.MOTORS.voltage) ** known.MOTORS.voltage_exponent
    first, second = known.MOTORS.thrust
    true = {
        "thrust": (first * per, second * per**2),
        "voltage_exponent": (known.MOTORS.voltage_exponent,),
    }
    for entry in found.numbers:
        table, _, key = entry.key.partition(".")
        for k, span in enumerate(entry.ci95 if table == "motors" else ()):
            off[key, k] = (entry.value[k] - true[key][k]) / (0.5 * (span[1] - span[0]))
    return off


def test_what_lag_and_delay_make_together_does_not_pass_for_a_delay():
    found = known.found("pwm")
    assert "effects.command_delay.delay" not in numbers_json(found.numbers)
    # Their sum is identified, and the file has it, however its lag shares it.
    rest = found.vehicle.effects["command_delay"].delay
    stacked_residuals = known.vehicle().rotors.time_constant + known.DELAY
    assert found.vehicle.rotors.time_constant + rest == pytest.approx(stacked_residuals, abs=0.004)
    assert any(line.startswith("command_delay: only its sum with") for line in found.not_identified)


@pytest.mark.parametrize(
    ("drive", "column", "key", "line"),
    [
        ("rates", "rate_cmd_b", "effects.thrust_scale.scale", "rate_gain: these logs have no"),
        ("rotors", "rotor_speed_cmd", "inertia", "time_constant and command_delay: these logs"),
    ],
)
def test_commands_that_stop_early_do_not_identify_what_needs_them(drive, column, key, line):
    found = identify(cut(known.logs(drive, 0), column), known.start())
    assert key in numbers_json(found.numbers)
    assert any(text.startswith(line) and "with both" in text for text in found.not_identified)


def test_a_flight_whose_commands_stop_early_takes_nothing_from_the_others():
    logs = known.logs("pwm", 0)
    found = numbers_json(identify([*logs[:3], *cut(logs[3:], "pwm")], known.start()).numbers)
    alone = numbers_json(known.found("pwm", 3).numbers)
    assert set(found) == set(alone)
    for key, entry in found.items():
        np.testing.assert_allclose(entry["value"], alone[key]["value"], rtol=1e-3)


def test_rotors_that_are_logged_in_turn_tell_all_but_their_lag():
    logs = []
    for log in known.logs("rotors", 0):
        turn = np.arange(len(log.time_s))[:, None] % 4 == np.arange(4)
        speed = np.asarray(log.rotor_speed)
        logs.append(replace(log, rotor_speed=np.where(turn, speed, np.nan)))
    found = identify(logs, known.start())
    off = pulls(found)
    assert {key for key, _ in off} >= {"rotors.thrust_coefficient", "inertia"}
    assert np.max(np.abs(list(off.values()))) < 2.5
    assert not {"rotors.time_constant", "effects.command_delay.delay"} & {key for key, _ in off}
    assert any("all four in every row" in line for line in found.not_identified)
    assert sum("no row has all columns of rotor_speed" in note for note in found.notes) == 4


@pytest.mark.parametrize(
    "drive", [*(pytest.param(d, marks=pytest.mark.slow) for d in ("rates", "torques")), "thrust"]
)
def test_a_scale_of_the_thrust_that_is_left_alone_counts(drive):
    fleet = Fleet(known.truth(), known.WAYS, scale=0.8)
    rng = np.random.default_rng(0)
    logs = logs_of(fleet, known.recordings(), drive, rng, sensors=known.SENSORS)
    begun = with_effects(known.start(), thrust_scale=(0.8,))
    found = identify(logs, begun, leave=("motors",))
    assert found.vehicle.effects["thrust_scale"].scale == 0.8
    (drag,) = [n for n in found.numbers if n.key == "effects.linear_drag.coefficient"]
    for value, true, span in zip(drag.value, known.DRAG, drag.ci95, strict=True):
        assert span is not None and span[1] - span[0] < 0.1
        assert value == pytest.approx(true, abs=0.03)


def test_a_speed_that_is_too_low_to_hover_is_that_of_the_flights():
    begun = known.start()
    rotors = replace(begun.rotors, thrust_coefficient=3.2e-6, speed_max=1000.0)
    found = identify(known.logs("rotors", 0), replace(begun, rotors=rotors))
    check_vehicle(found.vehicle)
    assert 1100.0 < found.vehicle.rotors.speed_max < known.vehicle().rotors.speed_max
    assert any(note.startswith("rotors.speed_max = ") for note in found.notes)


def test_flights_without_a_voltage_leave_the_motors_to_those_that_have_one():
    logs = known.logs("pwm", 0)
    found = identify([*logs[:3], *without_voltage(logs[3:])], known.start())
    off = pulls(found)
    assert {key for key, _ in off} >= {"motors.thrust", "motors.voltage_exponent"}
    assert np.max(np.abs(list(off.values()))) < 2.5
    (note,) = found.notes
    assert note.startswith("no voltage in flight_3: ")
    alone = numbers_json(known.found("pwm", 3).numbers)
    for key, entry in numbers_json(found.numbers).items():
        np.testing.assert_allclose(entry["value"], alone[key]["value"], rtol=1e-3)


def test_what_cannot_be_compared_is_refused_with_parts_left_alone_as_well():
    logs = without(known.logs("pwm", 0), "pos_w", "vel_w", "quat_wxyz", "rate_b")
    with pytest.raises(ValueError, match="without drag nothing is identifiable: thrust and"):
        identify(logs, known.start(), leave=("drag",))
    others = ("drag", "motors", "inertia", "lag")
    with pytest.raises(ValueError, match="without drag, .*: rate_gain: these logs have no comm"):
        identify(known.logs("pwm", 0), known.start(), leave=others)
