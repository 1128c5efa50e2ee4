"""What is logged: faults, noise of the stated size and colour, stamps, lost rows."""

import numpy as np
import pytest

from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery
from suite.blind.continuous.engine import fly
from suite.blind.continuous.log import Noise, gauss_markov, log_of_flight, rotate_attitude, state_at
from suite.blind.continuous.quadrotor import quadrotor_of
from suite.blind.continuous.timing import Conditions, jittered_stamps, schedule
from tests.support.vehicles import PLAIN, with_effects

NOISE = Noise(100.0, 0.002, 0.003, 0.02, 0.03, 0.3, 5.0, 0.02, 0.0)
EVEN = Conditions(500.0, 200.0, 0.0, 0.0, 0.0, 0.0, 0.1)


def pilot(seen):
    wave = np.sin(12.0 * seen.time_s)
    command = np.stack([9.81 + wave, 0.6 * np.cos(9.0 * seen.time_s), 0.5 * wave, wave], axis=1)
    return command, command


def fly_at(stamps, **step):
    start = np.zeros((1, 13))
    start[0, POS], start[0, VEL], start[0, QUAT] = [0, 0, 9], [2, 1, 0], [1, 0, 0, 0]
    plan, battery = schedule(stamps, 0.002, 0.0, **step), Battery(16, 0.1, 0.3)
    return fly(quadrotor_of(PLAIN), plan, start, pilot, np.random.default_rng(0), battery)


@pytest.fixture(scope="module")
def flown():
    stamps = jittered_stamps(np.random.default_rng(1), 1, -0.1, 4.1, 200.0, 0.3)
    return fly_at(stamps)


def logged(flown, rng=None, conditions=EVEN, noise=NOISE, **faults):
    effects = with_effects(**faults).effects
    return log_of_flight(flown, 0, 4.0, effects, noise, conditions, rng, "log", {"source": "x"})


def test_without_noise_rows_are_the_states_at_their_stamps(flown):
    log, plan = logged(flown), flown.schedule
    rows = np.flatnonzero((plan.stamp_s[:-1, 0] >= 0.0) & (plan.stamp_s[:-1, 0] < 4.0))
    state = flown.state[plan.block[rows], 0]
    np.testing.assert_array_equal(log.time_s, plan.stamp_s[rows, 0])
    assert log.time_s[0] == 0.0
    for values, part in ((log.pos_w, POS), (log.vel_w, VEL), (log.rate_b, RATE)):
        np.testing.assert_array_equal(values, state[:, part])
    np.testing.assert_array_equal(log.quat_wxyz, state[:, QUAT])
    np.testing.assert_allclose(log.thrust_cmd, 9.81 + np.sin(12.0 * log.time_s))
    np.testing.assert_allclose(log.rate_cmd_b[:, 0], 0.6 * np.cos(9.0 * log.time_s))
    assert dict(log.about) == {"source": "x"} and log.integrator is None


def test_biases_are_added_and_the_flight_is_the_same(flown):
    plain, off = logged(flown), logged(
        flown, gyro_bias=((0.1, -0.2, 0.3),), accelerometer_bias=((1.0, 2.0, -3.0),)
    )  # fmt: skip
    np.testing.assert_allclose(off.rate_b - plain.rate_b, [[0.1, -0.2, 0.3]] * len(plain.time_s))
    np.testing.assert_allclose(off.acc_b - plain.acc_b, [[1.0, 2.0, -3.0]] * len(plain.time_s))
    np.testing.assert_array_equal(off.pos_w, plain.pos_w)


@pytest.mark.parametrize("offset", [0.0173, -0.008])
def test_a_clock_offset_logs_poses_of_another_moment_and_the_rest_of_now(flown, offset):
    plain, late = logged(flown), logged(flown, clock_offset=(offset,))
    # Row t holds the pose of t - offset: a flight with rows there logs the same.
    wanted = state_at(flown, 0, plain.time_s - offset)
    np.testing.assert_array_equal(late.pos_w, wanted[:, POS])
    for name in ("rate_b", "acc_b", "rotor_speed"):
        np.testing.assert_array_equal(getattr(late, name), getattr(plain, name))
    shift = (late.pos_w - plain.pos_w + offset * plain.vel_w)[10:-10]
    acceleration = np.gradient(plain.vel_w, plain.time_s, axis=0)[10:-10]
    np.testing.assert_allclose(shift, 0.5 * offset**2 * acceleration, atol=2e-5)
    np.testing.assert_allclose(
        (late.vel_w - plain.vel_w)[10:-10], -offset * acceleration, atol=5e-3
    )


def test_states_between_the_ends_of_steps_are_those_of_a_finer_flight():
    stamps = np.arange(0.0, 0.201, 0.01)[:, None]
    coarse, fine = (fly_at(stamps, step_s=step_s) for step_s in (1e-3, 1e-4))
    wanted = np.random.default_rng(3).uniform(0.0, 0.2, 200)
    apart = np.abs(state_at(coarse, 0, wanted) - state_at(fine, 0, wanted)).max(axis=0)
    assert apart[POS].max() < 1e-7 and apart[VEL].max() < 3e-5 and apart[QUAT].max() < 3e-5


def test_noise_has_the_density_of_the_table_whatever_the_rate(flown):
    twin = logged(flown)
    draws = [logged(flown, np.random.default_rng(seed)) for seed in range(6)]
    for name, sigma in (
        ("pos_w", 0.002), ("vel_w", 0.03), ("rate_b", 0.02), ("acc_b", 0.3),
        ("rotor_speed", 5.0), ("voltage", 0.02),
    ):  # fmt: skip
        off = np.array([getattr(draw, name) - getattr(twin, name) for draw in draws])
        # 200 rows a second in place of 100.
        assert off.std() == pytest.approx(np.sqrt(2.0) * sigma, rel=0.05), name
    inner = np.abs([(draw.quat_wxyz * twin.quat_wxyz).sum(1) for draw in draws])
    angle = np.sqrt((8.0 * (1.0 - inner)).mean() / 3.0)
    assert angle == pytest.approx(np.sqrt(2.0) * 0.003, rel=0.05)


def test_coloured_noise_is_as_slow_as_stated_and_leaves_the_gyro_white(flown):
    coloured = Conditions(500.0, 200.0, 0.0, 0.0, 0.0, 0.9, 0.05)
    twin = logged(flown)
    draws = [logged(flown, np.random.default_rng(seed), coloured) for seed in range(20)]
    off = np.array([draw.pos_w - twin.pos_w for draw in draws])
    # White 0.1 of 2 x 0.002^2; coloured 0.002^2 x 0.9 / (2 x 0.05 x 100).
    white, slow = 0.1 * 2.0 * 0.002**2, 0.002**2 * 0.9 / 10.0
    assert off.var() == pytest.approx(white + slow, rel=0.05)
    late = (off[:, 10:] * off[:, :-10]).mean()
    assert late == pytest.approx(slow * np.exp(-1.0), rel=0.15), "10 rows are a correlation time"
    gyro = np.array([draw.rate_b - twin.rate_b for draw in draws])
    assert gyro.var() == pytest.approx(2.0 * 0.02**2, rel=0.05)
    assert abs((gyro[:, 1:] * gyro[:, :-1]).mean()) < 0.03 * gyro.var()


def test_rows_are_dropped_with_their_commands_and_stamps_are_off_by_at_most_the_clock(flown):
    conditions = Conditions(500.0, 200.0, 0.3, 1e-4, 0.05, 0.0, 0.1)
    log, all_rows = logged(flown, np.random.default_rng(4), conditions), logged(flown)
    near = np.abs(log.time_s[:, None] - all_rows.time_s).argmin(axis=1)
    off = log.time_s - all_rows.time_s[near]
    assert 0.9e-4 < np.abs(off).max() <= 1e-4
    assert 0.03 < 1.0 - len(near) / len(all_rows.time_s) < 0.07
    np.testing.assert_array_equal(log.thrust_cmd, all_rows.thrust_cmd[near])
    assert (np.diff(log.time_s) > 0.0).all() and np.isfinite(log.pos_w).all()


def test_poses_are_lost_in_stretches_of_three_and_a_channel_that_is_not_measured_is_not_there(
    flown,
):
    lossy = NOISE._replace(lost=0.06)
    log = logged(flown, np.random.default_rng(4), noise=lossy)
    gone = np.isnan(log.pos_w[:, 0])
    np.testing.assert_array_equal(gone, np.isnan(log.quat_wxyz[:, 0]))
    assert 0.03 < gone.mean() < 0.09 and np.isfinite(log.rate_b).all()
    runs = np.diff(np.flatnonzero(np.diff(np.r_[False, gone, False])))[::2]
    assert runs.min() == 3
    log = logged(flown, np.random.default_rng(0), noise=NOISE._replace(vel=0.0, acc=0.0, rotor=0.0))
    assert log.velocity_derived and log.acc_b is None and log.rotor_speed is None


def test_small_turns_are_about_body_axes():
    # From 90 degrees about z, a turn about body x is one about world y.
    quarter = np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    turn = rotate_attitude(quarter, np.array([[0.2, 0.0, 0.0]]))
    w, x, y, z = np.cos(0.1), 0.0, np.sin(0.1), 0.0
    hand = np.sqrt(0.5) * np.array([w - z, x + y, y - x, z + w])
    np.testing.assert_allclose(turn[0], hand, atol=1e-15)


def test_gauss_markov_keeps_its_variance_at_uneven_times():
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.001, 0.02, 60_000))
    series = gauss_markov(rng, time_s, 0.05)
    np.testing.assert_allclose(series.std(axis=0), 1.0, atol=0.04)
    span = np.diff(time_s)
    for some in (span < 0.004, span > 0.016):
        kept = (series[1:] * series[:-1])[some].mean()
        assert kept == pytest.approx(np.exp(-span[some] / 0.05).mean(), abs=0.05)
