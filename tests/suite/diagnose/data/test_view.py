"""What views are made of: bumps, acting rotors, rows in flight, logs completed or posed."""

import tracemalloc
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.effects.log_faults import apply_log_faults, true_log
from eval.logs.flight_log import FlightLog
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import MotorMap
from suite.diagnose.data.flights import acting_rotors, completed, ready
from suite.diagnose.data.hold_out import parted
from suite.diagnose.data.inertial import posed
from suite.diagnose.data.view import FORCE, SPECIFIC, TORQUE, rows_of, weak_form
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.view_means import ForceModel
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.identify.identify import identify
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.broken_logs import on_the_ground, rows
from tests.support.diagnosis_flights import fly
from tests.support.log_tables import level
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import with_effects

HOVER = float(np.sqrt(VEHICLE.mass * 9.81 / 4.0 / VEHICLE.rotors.thrust_coefficient))
"""Rotor speed of a hover [rad/s]."""
TWO_S, TEN_S = np.arange(0.0, 2.0, 0.01), np.arange(0.0, 10.0, 0.01)


def form_of(time_s, width_s=0.2):
    return weak_form(time_s, np.ones(len(time_s), bool), width_s, 0.1)


def test_views_and_identification_use_the_log_without_the_faults_of_the_vehicle_file():
    (log,) = flights(1, 0, 3.0)
    vehicle = with_effects(
        VEHICLE, lever_arm=((0.05, -0.02, 0.04),), gyro_bias=((0.1, 0.0, -0.05),)
    )
    faulty = replace(log, **apply_log_faults(vehicle.effects, vars(log)))
    assert np.nanstd(faulty.vel_w - log.vel_w) > 0.01
    wanted, found = ready([log], VEHICLE), ready([faulty], vehicle)
    for view in ("force", "torque"):
        leaves = (jax.tree.leaves(one.smoothed[view][0].rows) for one in (wanted, found))
        for expected, series in zip(*leaves, strict=True):
            np.testing.assert_allclose(series, expected, atol=1e-9)
    numbers, others = (
        identify([one], v, leave=("lag", "loop")).numbers
        for one, v in ((log, VEHICLE), (faulty, vehicle))
    )
    assert len(numbers) > 3
    for number, other in zip(numbers, others, strict=True):
        assert number.key == other.key and np.allclose(number.value, other.value, rtol=1e-6)
    # Without an attitude a position on the lever arm is kept.
    lost = replace(faulty, quat_wxyz=np.full_like(log.quat_wxyz, np.nan))
    np.testing.assert_array_equal(true_log(lost, vehicle.effects).pos_w, faulty.pos_w)


def test_a_bump_has_the_mean_acceleration_and_reaches_across_no_hole_or_bad_row():
    time_s = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 400))
    form = form_of(time_s)
    assert len(form.middle_s) > 20
    assert np.allclose(form.change @ (2.5 * time_s - 1.0), 2.5)
    assert np.allclose(form.mean @ np.full(400, -3.0), -3.0)
    time_s, good = np.arange(0.0, 4.0, 0.01), np.arange(400) != 100
    form = form_of(time_s)
    velocity, acceleration = np.sin(3.0 * time_s), 3.0 * np.cos(3.0 * time_s)
    assert np.abs(form.change @ velocity - form.mean @ acceleration).max() < 1e-3
    time_s[300:] += 0.2
    form = weak_form(time_s, good, 0.2, 0.1)
    assert np.abs(form.middle_s[:, None] - [1.0, 3.1]).min() > 0.095
    # A hole that is longer than a bump: none reaches into it from either side.
    time_s = np.concatenate([np.arange(0.0, 1.0, 0.001), np.arange(1.156, 2.0, 0.001)])
    gain = form_of(time_s, 0.1).change.power(2).sum(axis=1)
    assert gain.max() < 1.1 * gain.min()


def test_motor_commands_give_the_speeds_of_the_vehicles_map_with_its_delay_and_lag():
    pwm, volt = np.full((200, 4), 0.6), np.full(200, 3.5)
    vehicle = replace(VEHICLE, motors=MotorMap((0.0, 8.0), 3.7, 1.0))
    rotors = acting_rotors(level(TWO_S, pwm=pwm, voltage=volt), vehicle, THRESHOLDS)
    thrust = 8.0 * (0.6 * 3.5 / 3.7) ** 2
    assert rotors is not None and rotors.each
    assert np.allclose(rotors.speed**2 * vehicle.rotors.thrust_coefficient, thrust)
    with pytest.raises(ValueError, match=r"\[motors\]"):
        ready([level(TWO_S, pwm=pwm)], VEHICLE)
    vehicle = replace(VEHICLE, motors=MotorMap((0.0, 8.0), 3.7, 0.0))
    step = np.where(TWO_S[:, None] < 1.0, 0.3, 0.6) * np.ones(4)
    for delay_s in (0.05, 0.053):  # it ends at a row, or between two
        slow = with_effects(vehicle, motor_lag=(0.1,), command_delay=(delay_s,))
        speed = acting_rotors(level(TWO_S, pwm=step), slow, THRESHOLDS).speed[:, 0]
        since_s = np.maximum(TWO_S - 1.0 - delay_s, 0.0)
        wanted = speed[0] * (1.0 + 1.0 - np.exp(-since_s / 0.1))
        np.testing.assert_allclose(speed, wanted, rtol=1e-6)


def test_a_collective_thrust_gives_the_force_view_only():
    log = level(TWO_S, thrust_cmd=np.full(200, 9.81), rate_cmd_b=np.zeros((200, 3)))
    rotors = acting_rotors(log, VEHICLE, THRESHOLDS)
    assert rotors is not None and not rotors.each and np.allclose(rotors.speed, HOVER)
    assert [view.name for view in ready([log], VEHICLE).views] == ["force"]


def good_rows(log, resting):
    """Return which rows are used where the rotors rest at some of them, and hover at the others."""
    return rows_of(log, VEHICLE, np.where(resting, 0.0, HOVER)[:, None] * np.ones(4)).good


def test_rows_on_the_ground_are_not_used():
    good, margin = good_rows(level(TEN_S), np.abs(TEN_S - 5.0) <= 1.0), THRESHOLDS.ground_margin_s
    assert good[TEN_S < 4.0 - margin - 0.02].all()
    assert not good[(TEN_S > 4.0 - margin + 0.02) & (TEN_S < 6.0 + margin - 0.02)].any()


def test_where_the_speed_is_unknown_a_short_cut_of_the_throttle_is_no_rest_on_the_ground():
    log = level(TEN_S, about={"partial": ["pos", "vel"]})
    resting = (TEN_S < 2.0) | ((TEN_S > 5.0) & (TEN_S < 5.3))
    flown = good_rows(log, resting)
    assert not flown[TEN_S < 2.9].any() and flown[TEN_S > 3.1].all()
    turning = replace(log, rate_b=np.full((1000, 3), 0.5))
    assert good_rows(turning, resting).all()


def test_a_missing_attitude_follows_from_the_path():
    (log,) = flights(1, trim=0.0, duration_s=4.0)
    lost = {name: np.full_like(getattr(log, name), np.nan) for name in ("quat_wxyz", "rate_b")}
    lacks = replace(log, **lost, about={"partial": ["quat", "rate"]})
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
        kept = np.arange(len(pair[0].time_s))[:, None] % every == 0
        slow = [replace(log, vel_w=np.where(kept, log.vel_w, np.nan)) for log in pair]
        return ready(slow, VEHICLE).floor["force"][0]

    # Fewer values of the same noise make a mean acceleration less certain.
    assert 1.0 < floor(3) / floor(1) < 2.5


@pytest.mark.parametrize("ground_s", [(0.0, 0.0), (0.0, 6.0), (30.0, 0.0)])
def test_of_a_single_flight_the_end_of_what_flew_is_held_out(pair, ground_s):
    *parts, (words,), _ = parted(ready([on_the_ground(pair[0], *ground_s)], VEHICLE), [])
    for name in (FORCE.name, TORQUE.name):
        first, last = (part[name][0].form.middle_s for part in parts)
        assert first.max() < last.min()
        share = len(first) / (len(first) + len(last))
        assert share == pytest.approx(THRESHOLDS.lone_fitted_share, abs=0.1)
        since_s = float(words.removesuffix(" s").rpartition(" ")[2])
        assert first.max() - 0.1 < since_s < last.min() + 0.1


def test_a_second_must_be_held_out_or_the_flight_is_refused_or_a_second_view_left_out(pair):
    short, longer = (rows(pair[0], pair[0].time_s < end_s) for end_s in (2.495, 4.995))
    with pytest.raises(ValueError, match="s of usable flight held out, at least 1 s"):
        parted(ready([short], VEHICLE), [])
    without = replace(longer, about={"partial": ["quat", "rate"]})
    fitted, held, _, (note,) = parted(ready([without], VEHICLE), [])
    assert set(fitted) == set(held) == {FORCE.name}
    assert note.startswith("torque: not examined, ") and "held out, at least 1 s" in note


def test_a_log_without_a_stretch_is_left_out_and_slow_ones_are_diagnosed_by_their_force(pair):
    good, other = pair
    bad = replace(other, name="all holes", rotor_speed=np.full_like(other.rotor_speed, np.nan))
    found = ready([bad, good], VEHICLE)
    assert found.logs == (good,)
    assert [len(part) for part in found.smoothed.values()] == [1, 1]
    assert found.notes == ("all holes: no stretch of 0.2 s in flight without a hole",)
    with pytest.raises(ValueError, match="all holes: no stretch"):
        ready([bad], VEHICLE)
    found = ready([rows(log, slice(None, None, 4)) for log in pair], VEHICLE)
    assert found.views == (FORCE,) and set(found.smoothed) == {FORCE.name}
    assert found.notes[0].startswith("torque: not examined, as") and "log faster" in found.notes[0]


def test_a_long_flight_takes_no_memory_by_the_square_of_its_rows():
    time_s = np.sort(np.random.default_rng(1).uniform(0.0, 100.0, 20_000))
    tracemalloc.start()
    form = form_of(time_s)
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

    def about_x(speed):
        torque = speed**2 @ np.asarray(VEHICLE.rotors.position)[:, 1]
        return torque - torque.mean()

    rng = np.random.default_rng(0)
    log = level(np.arange(0.0, 20.0, 0.01))
    swing = np.sin(2.0 * np.pi * 1.5 * log.time_s)
    true = 900.0 + 4.0 * swing[:, None] * [1.0, 1.0, -1.0, -1.0]
    for sigma, least, most in ((0.0, 0.99, 1.01), (6.0, 0.6, 0.95)):
        speed = true + sigma * rng.standard_normal(true.shape)
        (flight,) = ready([replace(log, rotor_speed=speed)], VEHICLE).smoothed["torque"]
        truth, seen = (flight.form.mean @ about_x(part) for part in (true, speed))
        slope = np.sum(truth * seen) / np.sum(seen**2)
        assert least <= flight.reliability[0] <= most
        assert flight.reliability[0] == pytest.approx(slope, abs=0.05)


DRAG = 0.4


def flown(seed=0, end_s=10.0, bias=1.0, speed=1.0, gyro_walk=0.0, acc_noise=0.2):
    """Return a flight from rest under a drag, its velocity and attitude.

    `speed` scales the path; `gyro_walk` is the deviation of a gyro error held for 0.1 s [rad/s].
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, end_s, 0.01)
    phase = 2.0 * np.pi * (np.array([0.21, 0.17, 0.13]) + 0.02 * seed) * time_s[:, None]
    vel_w = speed * np.array([4.0, 3.0, 1.0]) * np.sin(phase) ** 2 * np.tanh(time_s)[:, None]
    force_w = np.gradient(vel_w, time_s, axis=0) + [0.0, 0.0, 9.81] + DRAG * vel_w
    thrust = np.linalg.norm(force_w, axis=1)
    up = force_w / thrust[:, None]
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left, axis=1)[:, None]
    rot = Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=-1))
    turns = (rot[:-1].inv() * rot[1:]).as_rotvec() / 0.01
    rate_b = np.concatenate([turns[:1], 0.5 * (turns[1:] + turns[:-1]), turns[-1:]])
    acc_b = rot.inv().apply(force_w - DRAG * vel_w)
    rate_b = rate_b + bias * 0.005 * rng.normal(size=3) + 0.02 * rng.normal(size=rate_b.shape)
    slow = np.repeat(rng.normal(size=(len(time_s) // 10 + 1, 3)), 10, axis=0)[: len(time_s)]
    rate_b = rate_b + gyro_walk * slow
    acc_b = acc_b + bias * 0.05 * rng.normal(size=3) + acc_noise * rng.normal(size=acc_b.shape)
    each = np.sqrt(VEHICLE.mass * thrust / 4.0 / VEHICLE.rotors.thrust_coefficient)
    lost = np.full((len(time_s), 4), np.nan)
    log = FlightLog(
        f"flight {seed}", time_s, lost[:, :3], lost, lost[:, :3], rate_b, acc_b=acc_b,
        rotor_speed=each[:, None] + rng.normal(size=(len(time_s), 4)),
        about={"partial": ["pos", "quat"]}, velocity_derived=True,
    )  # fmt: skip
    return log, vel_w, rot


@pytest.mark.parametrize("end_s", [10.0, 40.0])
def test_gyro_and_accelerometer_give_the_velocity(end_s):
    log, vel_w, rot = flown(end_s=end_s)
    (found,) = posed([log])
    off = found.vel_w - vel_w
    assert np.sqrt((off**2).mean()) < 0.3
    lean = (rot.as_matrix()[:, :, 2] * found.rot_w[:, :, 2]).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(lean, -1.0, 1.0))).mean() < 2.0
    assert found.pose_slope_b is not None and found.pose_slope_b.shape[:2] == (len(off), 3)


def test_a_flight_may_begin_on_its_side():
    log = flown(end_s=2.0)[0]
    about_y = Rotation.from_euler("y", 90.0, degrees=True)
    turned = {"rate_b": about_y.apply(log.rate_b), "acc_b": about_y.apply(log.acc_b)}
    (found,) = posed([replace(log, **turned)])
    force_w = (found.rot_w[0] @ turned["acc_b"][:10].mean(axis=0)) / 9.81
    assert force_w == pytest.approx([0.0, 0.0, 1.0], abs=0.1)


def test_thrust_and_drag_are_identified_without_a_pose():
    found = identify([flown(seed, 5.0)[0] for seed in range(2)], VEHICLE)
    value = {number.key: number.value for number in found.numbers}
    thrust = VEHICLE.rotors.thrust_coefficient
    assert value["rotors.thrust_coefficient"][0] == pytest.approx(thrust, rel=0.01)
    assert value["effects.linear_drag.coefficient"] == pytest.approx([DRAG] * 3, abs=0.05)
    assert any("heading" in line for line in found.not_identified)


@pytest.mark.slow
def test_a_drag_of_slow_flights_is_identified_where_the_gyro_drifts_and_of_a_hover_not():
    """As in logs whose gyro was sampled too rarely: the tilt drifts by 0.03 rad a second."""

    def intervals(**options):
        found = identify([flown(seed, gyro_walk=0.1, **options)[0] for seed in range(3)], VEHICLE)
        spans = [span for n in found.numbers if "linear_drag" in n.key for span in n.ci95[:2]]
        return [span for span in spans if span is not None]

    spans = intervals(end_s=30.0, speed=0.3, acc_noise=0.05)
    assert spans and all(low < DRAG < high for low, high in spans)
    assert not intervals(end_s=10.0, speed=0.003)


def test_views_are_of_what_a_log_has():
    log = flown()[0]
    assert [view.about for view in ready([log], VEHICLE).views] == [SPECIFIC.about, TORQUE.about]
    assert ready([replace(log, acc_b=None)], VEHICLE).views == (TORQUE,)
    without = replace(log, about={"partial": ["pos", "quat", "rate"]})
    with pytest.raises(ValueError, match="no position and no gyro"):
        completed(without)
    thrust = replace(log, acc_b=None, rotor_speed=None, thrust_cmd=np.full(len(log.time_s), 9.81))
    with pytest.raises(ValueError, match="no accelerometer or no motor"):
        ready([thrust], VEHICLE)


def test_a_rate_loop_faster_than_the_log_does_not_look_like_inertia():
    vehicle = load_vehicle("reference")
    log = fly(vehicle, 0, duration_s=2.5, noise=0.0, motors=True)
    space = make_space(vehicle)
    model, smoothed = ForceModel(vehicle, voltage=False), ready([log], vehicle).smoothed
    data = ViewEvidence(TORQUE, model, smoothed[TORQUE.name]).residuals(space.array("start"))
    share = (data.value * data.residual).sum(axis=0) / (data.value**2).sum(axis=0)
    assert share == pytest.approx([0.0] * 3, abs=0.0015)
    # Rotors without a lag may turn at any speed between two rows.
    quick = replace(vehicle, rotors=replace(vehicle.rotors, time_constant=0.0))
    assert ready([log], vehicle).notes == ()
    assert "every 10 ms do not show the torque" in ready([log], quick).notes[0]
