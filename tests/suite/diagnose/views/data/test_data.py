"""What views are made of: weak accelerations, acting rotors, rows in flight, completed logs."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from eval.vehicles.vehicle import MotorMap
from suite.diagnose.data.flights import acting_rotors, completed, ready
from suite.diagnose.data.hold_out import parted
from suite.diagnose.data.view import FORCE, TORQUE, rows_of, weak_form
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.broken_logs import on_the_ground, rows
from tests.support.log_tables import level
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import with_effects


def hover_speed(vehicle=VEHICLE, share=1.0):
    push = share * vehicle.mass * 9.81 / 4.0
    return float(np.sqrt(push / vehicle.rotors.thrust_coefficient))


def test_a_bump_has_the_mean_acceleration_and_reaches_across_no_hole_or_bad_row():
    rng = np.random.default_rng(0)
    time_s = np.sort(rng.uniform(0.0, 3.0, 400))
    form = weak_form(time_s, np.ones(400, bool), 0.2, 0.1)
    assert len(form.middle_s) > 20
    assert np.allclose(form.change @ (2.5 * time_s - 1.0), 2.5)
    assert np.allclose(form.mean @ np.full(400, -3.0), -3.0)
    even_s = np.arange(0.0, 4.0, 0.01)
    form = weak_form(even_s, np.ones(400, bool), 0.2, 0.1)
    velocity, acceleration = np.sin(3.0 * even_s), 3.0 * np.cos(3.0 * even_s)
    assert np.abs(form.change @ velocity - form.mean @ acceleration).max() < 1e-3
    time_s = np.arange(0.0, 4.0, 0.01)
    good = np.ones(400, bool)
    good[100] = False
    time_s[300:] += 0.2
    form = weak_form(time_s, good, 0.2, 0.1)
    assert np.abs(form.middle_s - 1.0).min() > 0.095
    assert np.abs(form.middle_s - 3.1).min() > 0.095
    # A hole that is longer than a bump: none reaches into it from either side.
    time_s = np.concatenate([np.arange(0.0, 1.0, 0.001), np.arange(1.156, 2.0, 0.001)])
    form = weak_form(time_s, np.ones(len(time_s), bool), 0.1, 0.1)
    gain = form.change.power(2).sum(axis=1)
    assert gain.max() < 1.1 * gain.min()


def test_motor_commands_give_the_speeds_of_the_vehicles_map_with_its_delay_and_lag():
    time_s = np.arange(0.0, 2.0, 0.01)
    pwm, volt = np.full((200, 4), 0.6), np.full(200, 3.5)
    vehicle = replace(VEHICLE, motors=MotorMap((0.0, 8.0), 3.7, 1.0))
    rotors = acting_rotors(level(time_s, pwm=pwm, voltage=volt), vehicle)
    thrust = 8.0 * (0.6 * 3.5 / 3.7) ** 2
    assert rotors is not None and rotors.each
    assert np.allclose(rotors.speed**2 * vehicle.rotors.thrust_coefficient, thrust)
    with pytest.raises(ValueError, match=r"\[motors\]"):
        ready([level(time_s, pwm=pwm)], VEHICLE)
    step = np.where(time_s[:, None] < 1.0, 0.3, 0.6) * np.ones(4)
    log = level(time_s, pwm=step)
    vehicle = replace(VEHICLE, motors=MotorMap((0.0, 8.0), 3.7, 0.0))
    slow = with_effects(vehicle, motor_lag=(0.1,), command_delay=(0.05,))
    lagged = acting_rotors(log, slow)
    speed = lagged.speed[:, 0]
    assert np.ptp(speed[time_s < 1.045]) == 0.0
    after = speed[np.searchsorted(time_s, 1.15 - 1e-9)]
    assert after == pytest.approx(speed[0] + (1 - np.exp(-1)) * (speed[-1] - speed[0]), rel=0.02)


def test_a_collective_thrust_gives_the_force_view_only():
    time_s = np.arange(0.0, 2.0, 0.01)
    log = level(time_s, thrust_cmd=np.full(200, 9.81),
                rate_cmd_b=np.zeros((200, 3)))  # fmt: skip
    rotors = acting_rotors(log, VEHICLE)
    assert rotors is not None and not rotors.each and np.allclose(rotors.speed, hover_speed())
    assert [view.name for view in ready([log], VEHICLE).views] == ["force"]


def test_rows_on_the_ground_are_not_used():
    time_s = np.arange(0.0, 10.0, 0.01)
    on = (time_s < 4.0) | (time_s > 6.0)
    speed = np.where(on, hover_speed(), 0.0)[:, None] * np.ones(4)
    good = np.asarray(rows_of(level(time_s), VEHICLE, speed).good)
    margin = THRESHOLDS.ground_margin_s
    assert good[time_s < 4.0 - margin - 0.02].all()
    assert not good[(time_s > 4.0 - margin + 0.02) & (time_s < 6.0 + margin - 0.02)].any()


def test_a_missing_attitude_follows_from_the_path():
    (log,) = flights(1, trim=0.0, duration_s=4.0)
    lacks = replace(log, quat_wxyz=np.full_like(log.quat_wxyz, np.nan),
                    rate_b=np.full_like(log.rate_b, np.nan),
                    about={"partial": ["quat", "rate"]})  # fmt: skip
    whole = completed(lacks)
    up, leaned = log.rot_w[50:-50, :, 2], whole.rot_w[50:-50, :, 2]
    assert np.degrees(np.arccos(np.clip((up * leaned).sum(1), -1, 1))).mean() < 3.0
    slow = np.where(np.arange(len(log.time_s))[:, None] % 3 == 0, log.quat_wxyz, np.nan)
    turning_b = completed(replace(lacks, quat_wxyz=slow, about={"partial": ["rate"]})).rate_b
    known = np.isfinite(turning_b).all(axis=1)
    assert known.sum() > 0.3 * len(known)
    assert np.abs(turning_b[known] - log.rate_b[known]).mean() < 0.2
    views = ready([lacks], VEHICLE).views
    assert views[0].axes == (2,) and views[1].width_s > TORQUE.width_s
    assert ready([log], VEHICLE, others=[lacks]).views == views, "both sets are judged alike"


@pytest.fixture(scope="module")
def pair():
    return flights(2, 0, 5.0)


def test_the_noise_of_a_slow_signal_is_that_of_its_own_rows(pair):
    def floor(every):
        slow = [
            replace(
                log, vel_w=np.where(np.arange(len(log.time_s))[:, None] % every, np.nan, log.vel_w)
            )
            for log in pair
        ]
        return ready(slow, VEHICLE).floor["force"][0]

    # Fewer values of the same noise make a mean acceleration less certain.
    assert 1.0 < floor(3) / floor(1) < 2.5


def test_where_the_speed_is_unknown_a_short_cut_of_the_throttle_is_no_rest_on_the_ground():
    time_s = np.arange(0.0, 10.0, 0.01)
    speed = np.full((1000, 4), hover_speed())
    speed[(time_s < 2.0) | ((time_s > 5.0) & (time_s < 5.3))] = 0.0
    log = level(time_s, rotor_speed=speed, about={"partial": ["pos", "vel"]})
    flown = rows_of(log, VEHICLE, speed).good
    assert not flown[time_s < 2.9].any() and flown[time_s > 3.1].all()
    turning = replace(log, rate_b=np.full((1000, 3), 0.5))
    assert rows_of(turning, VEHICLE, speed).good.all()


@pytest.mark.parametrize("ground_s", [(0.0, 0.0), (0.0, 6.0), (30.0, 0.0)])
def test_of_a_single_flight_the_end_of_what_flew_is_held_out(pair, ground_s):
    parts = parted(ready([on_the_ground(pair[0], *ground_s)], VEHICLE), [])
    fitted, held, (words,), _ = parts
    for name in (FORCE.name, TORQUE.name):
        first, last = (part[name][0].form.middle_s for part in (fitted, held))
        assert first.max() < last.min()
        share = len(first) / (len(first) + len(last))
        assert share == pytest.approx(THRESHOLDS.lone_fitted_share, abs=0.1)
        since_s = float(words.removesuffix(" s").rpartition(" ")[2])
        assert first.max() - 0.1 < since_s < last.min() + 0.1


def test_a_flight_too_short_to_hold_out_a_second_is_refused(pair):
    short = rows(pair[0], slice(0, round(2.5 / float(np.median(np.diff(pair[0].time_s))))))
    with pytest.raises(ValueError, match="s of usable flight held out, at least 1 s"):
        parted(ready([short], VEHICLE), [])


def test_a_second_view_with_too_little_to_hold_out_is_left_out(pair):
    short = rows(pair[0], slice(0, round(5.0 / float(np.median(np.diff(pair[0].time_s))))))
    without = replace(short, about={"partial": ["quat", "rate"]})
    parts = parted(ready([without], VEHICLE), [])
    assert set(parts.fitted) == set(parts.held) == {FORCE.name}
    (note,) = parts.notes
    assert note.startswith("torque: not examined, ") and "held out, at least 1 s" in note


def test_a_log_without_a_stretch_is_left_out_and_slow_ones_are_diagnosed_by_their_force(pair):
    good, other = pair
    bad = replace(other, name="all holes", rotor_speed=np.full_like(other.rotor_speed, np.nan))
    found = ready([bad, good], VEHICLE)
    assert found.names == (good.name,) and found.kept == (1,)
    assert [len(part) for part in found.smoothed.values()] == [1, 1]
    assert found.notes == ("all holes: no stretch of 0.2 s in flight without a hole",)
    with pytest.raises(ValueError, match="all holes: no stretch"):
        ready([bad], VEHICLE)
    found = ready([rows(log, slice(None, None, 4)) for log in pair], VEHICLE)
    assert found.views == (FORCE,) and set(found.smoothed) == {FORCE.name}
    assert found.notes[0].startswith("torque: not examined, as") and "log faster" in found.notes[0]


def test_a_long_flight_takes_no_memory_by_the_square_of_its_rows():
    time_s = np.sort(np.random.default_rng(1).uniform(0.0, 300.0, 60_000))
    tracemalloc.start()
    form = weak_form(time_s, np.ones(len(time_s), bool), 0.2, 0.1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e8
    some = slice(None, None, 200)
    apart = np.abs(time_s[:, None] - form.middle_s[some])
    np.testing.assert_array_equal(form.middle_row[some], apart.argmin(axis=0))


def test_a_model_is_believed_as_far_as_its_rotors_are_measured():
    """By the share of noise in what its torque changes by; a quiet rotor's is believed whole.

    What a rate loop does between the rows makes it up to 1 % more.
    """
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 20.0, 0.01)
    swing = np.sin(2.0 * np.pi * 1.5 * time_s)
    true = 900.0 + 4.0 * swing[:, None] * [1.0, 1.0, -1.0, -1.0]
    log = level(time_s)
    for sigma, least, most in ((0.0, 0.99, 1.01), (6.0, 0.6, 0.95)):
        speed = true + sigma * rng.standard_normal(true.shape)
        (flight,) = ready([replace(log, rotor_speed=speed)], VEHICLE).smoothed["torque"]
        truth, seen = (flight.form.mean @ _about_x(part) for part in (true, speed))
        slope = np.sum(truth * seen) / np.sum(seen**2)
        assert least <= flight.reliability[0] <= most
        assert flight.reliability[0] == pytest.approx(slope, abs=0.05)


def _about_x(speed):
    torque = speed**2 @ np.asarray(VEHICLE.rotors.position)[:, 1]
    return torque - torque.mean()
