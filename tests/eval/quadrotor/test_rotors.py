"""Rotors' lag against an independent integration, late commands, and the mixer by hand."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from eval.quadrotor.mixer import mix, mixer_matrix, unequal_arms
from eval.quadrotor.plant import nominal_quadrotor
from eval.quadrotor.rotors import acceleration, delay_weight, delayed, follow, whole_steps
from eval.quadrotor.vehicle_file import load_vehicle
from suite.blind.continuous.quadrotor import allocate_thrust
from tests.support.vehicles import PLAIN


@pytest.mark.parametrize("time_constant", [0.0, 1e-6, 0.002, 0.03, 5.0])
def test_rotors_follow_exactly(time_constant):
    start, wanted, dt = np.array([1000.0, 500.0, 0.0, 2000.0]), np.full(4, 1500.0), 0.01
    step = follow(start, wanted, np.asarray(time_constant), dt)
    if time_constant < 1e-5:
        np.testing.assert_allclose(step.end, wanted)
        np.testing.assert_allclose(step.mean_square, wanted**2, rtol=1e-3)
        return

    def slopes(_, y):
        return np.concatenate([(wanted - y[:4]) / time_constant, y[:4], y[:4] ** 2])

    begin = np.concatenate([start, np.zeros(8)])
    end = solve_ivp(slopes, (0.0, dt), begin, rtol=1e-11, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(step.end, end[:4], rtol=1e-8)
    np.testing.assert_allclose(step.mean, end[4:8] / dt, rtol=1e-8)
    np.testing.assert_allclose(step.mean_square, end[8:] / dt, rtol=1e-8)


def test_lag_can_be_fitted_from_none():
    speed, wanted = (jax.numpy.asarray(np.full(4, rate)) for rate in (1000.0, 1500.0))
    slope = jax.jit(jax.grad(lambda tau: follow(speed, wanted, tau, 0.002).mean_square.sum()))(0.0)
    # Thrust comes late: dt mean(Omega^2) loses (Omega_c^2 - Omega^2) tau - (...)^2 tau / 2.
    expected = 4 * (2 * 1500.0 * -500.0 + 0.5 * 500.0**2) / 0.002
    assert slope == pytest.approx(expected, rel=1e-5)


def test_the_mean_acceleration_is_what_the_speed_changed_by():
    """Also of a step of no length, where it is (command - speed) / time constant."""
    start, command, lag = np.full(4, 900.0), np.array([1000.0, 900.0, 800.0, 950.0]), 0.03
    rotors = follow(start, command, np.asarray(lag), np.asarray(0.002))
    found = acceleration(start, rotors, command, np.asarray(lag), np.asarray(0.002))
    np.testing.assert_allclose(found, (rotors.end - start) / 0.002, rtol=1e-3)
    none = follow(start, command, np.asarray(lag), np.asarray(1e-9))
    found = acceleration(start, none, command, np.asarray(lag), np.asarray(1e-9))
    np.testing.assert_allclose(found, (command - start) / lag, rtol=1e-4)
    at_once = follow(start, command, np.asarray(0.0), np.asarray(0.002))
    found = acceleration(start, at_once, command, np.asarray(0.0), np.asarray(0.002))
    np.testing.assert_allclose(found, (command - start) / 0.002)


DT = 0.002


def test_rounding_makes_no_step():
    assert 0.043 / 0.001 < 43.0
    whole, part = whole_steps(np.array([0.043, 0.0, 0.0005]), 0.001)
    np.testing.assert_array_equal(whole, [43, 0, 0])
    np.testing.assert_allclose(part, [0.0, 0.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.0047, 0.006])
def test_what_acts_is_the_line_through_what_was_given(delay):
    commands = np.random.default_rng(0).standard_normal((3, 12, 4))
    weight = delay_weight(np.asarray(delay), DT, 0.006)
    assert weight.shape == (4,) and weight.sum() == pytest.approx(1.0)
    past = np.repeat(commands[:, :1, :, None], 4, axis=-1)[:, 0]
    for k in range(12):
        past, now = delayed(weight, past, commands[:, k])
        if k >= 4:
            whole, part = divmod(delay / DT + 1e-9, 1.0)
            before = commands[:, k - int(whole)], commands[:, k - int(whole) - 1]
            np.testing.assert_allclose(now, (1 - part) * before[0] + part * before[1], atol=1e-7)


MATRIX = mixer_matrix(PLAIN.rotors.position, PLAIN.rotors.spin, 2.2e-8 / 1.6e-6)
UNMIXER = np.linalg.inv(MATRIX)
LIMIT = 7.056


def mixed(force, torque, limit=LIMIT):
    return mix(UNMIXER, limit, np.asarray(float(force)), np.asarray(torque, dtype=float))


@pytest.mark.parametrize(
    ("force", "torque", "expected"),
    [
        (8.0, [0.0, 0.0, 0.0], [2.0, 2.0, 2.0, 2.0]),
        # Each alone within range: arms 0.1 and 0.075 m, 0.01375 m of yaw torque a newton.
        (8.0, [0.4, 0.0, 0.0], [1.0, 1.0, 3.0, 3.0]),
        (8.0, [0.0, 0.3, 0.0], [1.0, 3.0, 3.0, 1.0]),
        (8.0, [0.0, 0.0, 0.055], [1.0, 3.0, 1.0, 3.0]),
        # Roll needs a collective of at least 10 N.
        (0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 5.0, 5.0]),
        (100.0, [1.0, 0.0, 0.0], [2.056, 2.056, 7.056, 7.056]),
        # Roll and pitch shrink together until their spread is the whole range.
        (0.0, [2.0, 0.0, 0.0], [0.0, 0.0, 7.056, 7.056]),
        (8.0, [4.0, 3.0, 0.0], [0.0, 3.528, 7.056, 3.528]),
        # Yaw gets what is left, here half of it, then nothing.
        (4.0, [0.0, 0.0, 0.11], [0.0, 2.0, 0.0, 2.0]),
        (8.0, [4.0, 3.0, 0.5], [0.0, 3.528, 7.056, 3.528]),
        (0.0, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.0]),
        (100.0, [0.0, 0.0, 0.0], [7.056] * 4),
    ],
)
def test_mix_by_hand(force, torque, expected):
    np.testing.assert_allclose(mixed(force, torque), expected, atol=1e-12)


NEWTONS = st.floats(-10.0, 60.0)
TORQUES = st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3)


@given(NEWTONS, TORQUES)
def test_mix_stays_in_range_and_keeps_directions(force, torque):
    thrust = mixed(force, torque)
    assert np.all((thrust >= 0.0) & (thrust <= LIMIT))
    given = MATRIX @ thrust
    np.testing.assert_allclose(given[1] * torque[1] - given[2] * torque[0], 0.0, atol=1e-9)
    assert given[1] * torque[0] >= -1e-9
    assert abs(given[3]) <= abs(torque[2]) + 1e-9
    exact = UNMIXER @ [force, *torque]
    if np.all((exact >= 0.0) & (exact <= LIMIT)):
        np.testing.assert_allclose(thrust, exact, atol=1e-12)
    # Yaw never costs thrust or tilt: without it they could not have been better.
    without = MATRIX @ mixed(force, [*torque[:2], 0.0])
    np.testing.assert_array_less(np.abs(without[1:3]), np.abs(given[1:3]) + 1e-9)
    assert abs(given[0] - force) <= abs(without[0] - force) + 1e-9


def mixed_by_spread(unmixer, limit, force, torque):
    """Mix for equal arms, where a spread that fits has a collective thrust that fits."""
    per_force, yaw = unmixer[:, 0], torque[:, 2, None] * unmixer[:, 3]
    tilting = torque[:, 0, None] * unmixer[:, 1] + torque[:, 1, None] * unmixer[:, 2]
    exact = force[:, None] * per_force + tilting + yaw
    scaled = tilting * (limit / np.maximum(np.ptp(tilting, axis=1), limit))[:, None]
    ends = (-scaled / per_force).max(1), ((limit - scaled) / per_force).min(1)
    least = np.clip(np.clip(force, *ends)[:, None] * per_force + scaled, 0.0, limit)
    margin, size = np.where(yaw > 0.0, limit - least, least), np.abs(yaw)
    share = np.where(size > np.maximum(margin, 1e-9), margin / np.maximum(size, 1e-30), 1.0)
    limited = np.clip(least + share.min(1)[:, None] * yaw, 0.0, limit)
    return np.where(((exact < 0.0) | (exact > limit)).any(1)[:, None], limited, exact)


@pytest.mark.parametrize("name", ["reference", "racer5", "crazyflie21"])
def test_equal_arms_are_mixed_by_the_spread_to_the_bit(name):
    nominal, _ = nominal_quadrotor(load_vehicle(name))
    rng, limit = np.random.default_rng(0), float(nominal.thrust_max)
    arm_m = np.abs(load_vehicle(name).rotors.position).max()
    force = rng.uniform(-1.0, 6.0, 4000) * limit
    torque = rng.normal(0.0, 1.0, (4000, 3)) * limit * arm_m * [2.0, 2.0, 0.3]
    expected = mixed_by_spread(nominal.unmixer, limit, force, torque)
    args = nominal.unmixer, limit, force, torque, nominal.unequal_arms
    np.testing.assert_array_equal(mix(*args), expected)


@given(NEWTONS, TORQUES)
def test_unequal_arms_give_a_torque_in_the_wanted_direction(force, torque):
    hubs = [[0.06, -0.1, 0.0], [-0.12, -0.1, 0.0], [-0.12, 0.1, 0.0], [0.06, 0.1, 0.0]]
    matrix = mixer_matrix(hubs, PLAIN.rotors.spin, 2.2e-8 / 1.6e-6)
    unmixer = np.linalg.inv(matrix)
    args = unmixer, LIMIT, np.asarray(force), np.asarray(torque), unequal_arms(unmixer)
    thrust = mix(*args)
    assert np.all((thrust >= 0.0) & (thrust <= LIMIT))
    given = matrix @ thrust
    np.testing.assert_allclose(given[1] * torque[1] - given[2] * torque[0], 0.0, atol=1e-9)
    assert abs(given[3]) <= abs(torque[2]) + 1e-9
    traced = jax.jit(mix)(*map(jax.numpy.asarray, args))
    np.testing.assert_allclose(traced, thrust, atol=1e-4)
    apart = SimpleNamespace(shares=unmixer, thrust_max=LIMIT)
    other = allocate_thrust(apart, args[2][None], args[3][None])[0]
    np.testing.assert_allclose(other, thrust, atol=1e-9)


MIX_SLOPE = jax.jit(jax.jacobian(lambda f, t: mix(UNMIXER, LIMIT, f, t), argnums=(0, 1)))


@given(NEWTONS, TORQUES)
def test_mix_has_finite_gradients(force, torque):
    slope = MIX_SLOPE(jax.numpy.asarray(force), jax.numpy.asarray(torque))
    assert all(np.all(np.isfinite(part)) for part in slope)
