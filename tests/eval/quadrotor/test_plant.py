"""Mixer, rotors and rate loop against hand-worked numbers and an independent integration."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from eval.quadrotor.mixer import mix, mixer_matrix
from eval.quadrotor.plant import Command, Motion, make_plant, plant_step, start_memory
from eval.quadrotor.rigid_body import accelerations, euler_step
from eval.quadrotor.rotors import follow, speed_command
from tests.support.vehicles import PLAIN, at_rest, with_effects, with_lag

MATRIX = mixer_matrix(PLAIN.rotors.position, PLAIN.rotors.spin, 2.2e-8 / 1.6e-6)
UNMIXER = np.linalg.inv(MATRIX)
LIMIT = 7.056


def mixed(force, torque, limit=LIMIT):
    return mix(UNMIXER, limit, np.asarray(float(force)), np.asarray(torque, dtype=float))


def test_mixer_has_rank_four():
    assert np.linalg.matrix_rank(MATRIX) == 4


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


MIX_SLOPE = jax.jit(jax.jacobian(lambda f, t: mix(UNMIXER, LIMIT, f, t), argnums=(0, 1)))


@given(NEWTONS, TORQUES)
def test_mix_has_finite_gradients(force, torque):
    slope = MIX_SLOPE(jax.numpy.asarray(force), jax.numpy.asarray(torque))
    assert all(np.all(np.isfinite(part)) for part in slope)


@pytest.mark.parametrize("time_constant", [0.0, 1e-6, 0.002, 0.03, 5.0])
def test_rotors_follow_exactly(time_constant):
    start, wanted, dt = np.array([1000.0, 500.0, 0.0, 2000.0]), np.full(4, 1500.0), 0.01
    spin = follow(start, wanted, np.asarray(time_constant), dt)
    if time_constant < 1e-5:
        np.testing.assert_allclose(spin.end, wanted)
        np.testing.assert_allclose(spin.mean_square, wanted**2, rtol=1e-3)
        return

    def slopes(_, y):
        return np.concatenate([(wanted - y[:4]) / time_constant, y[:4], y[:4] ** 2])

    begin = np.concatenate([start, np.zeros(8)])
    end = solve_ivp(slopes, (0.0, dt), begin, rtol=1e-11, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(spin.end, end[:4], rtol=1e-8)
    np.testing.assert_allclose(spin.mean, end[4:8] / dt, rtol=1e-8)
    np.testing.assert_allclose(spin.mean_square, end[8:] / dt, rtol=1e-8)


def test_lag_can_be_fitted_from_none():
    speed, wanted = jax.numpy.full(4, 1000.0), jax.numpy.full(4, 1500.0)
    slope = jax.grad(lambda tau: follow(speed, wanted, tau, 0.002).mean_square.sum())(0.0)
    # Thrust comes late: dt mean(Omega^2) loses (Omega_c^2 - Omega^2) tau - (...)^2 tau / 2.
    expected = 4 * (2 * 1500.0 * -500.0 + 0.5 * 500.0**2) / 0.002
    assert slope == pytest.approx(expected, rel=1e-5)


def test_speed_command_inverts_the_thrust_curve():
    np.testing.assert_allclose(speed_command(np.array([1.6, 0.0]), 1.6e-6), [1000.0, 0.0])


def test_hover_holds():
    plant = make_plant(with_effects(with_lag(PLAIN, 0.03), command_delay=(0.03,)), 0.002)
    memory, motion = start_memory(plant, ()), at_rest()
    for k in range(500):
        hover = Command(np.asarray(9.81), np.zeros(3))
        memory, wrench = plant_step(plant, memory, motion, hover, 0.002 * k)
        motion = euler_step(plant, motion, wrench)
    np.testing.assert_allclose(motion.pos_w, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(motion.rot_w, np.eye(3), atol=1e-12)


def test_rate_loop_cancels_the_gyroscopic_torque():
    plant = make_plant(PLAIN, 0.002)
    rate = np.array([2.0, -1.0, 1.5])
    motion = Motion(np.zeros(3), np.eye(3), np.zeros(3), rate)
    command = Command(np.asarray(12.0), rate)
    _, wrench = plant_step(plant, start_memory(plant, ()), motion, command, 0.0)
    _, turn = accelerations(plant, motion, wrench)
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)


def reference_flight(vehicle, command_of, duration, start):
    """Integrate contracts of the nominal quadrotor in continuous time; shares no code with ours.

    State: position, quaternion xyzw, velocity, body rate, rotor speeds.
    """
    hubs, spin = np.array(vehicle.rotors.position), np.array(vehicle.rotors.spin)
    k_t, k_q = vehicle.rotors.thrust_coefficient, vehicle.rotors.torque_coefficient
    inertia, gain = np.diag(vehicle.inertia), np.diag(vehicle.controller.rate_gain)
    allocation = np.array(
        [[1, y, -x, -s * k_q / k_t] for (x, y, _), s in zip(hubs, spin, strict=True)]
    ).T

    def slopes(t, y):
        attitude = Rotation.from_quat(y[3:7])
        velocity, rate, speed = y[7:10], y[10:13], y[13:]
        thrust, wanted_rate = command_of(t)
        torque = inertia @ gain @ (wanted_rate - rate) + np.cross(rate, inertia @ rate)
        asked = np.linalg.solve(allocation, [vehicle.mass * thrust, *torque])
        assert np.all((asked > 0) & (asked < vehicle.rotors.thrust_max))
        push = k_t * speed**2
        twist = np.sum(
            [np.cross(hub, [0, 0, f]) for hub, f in zip(hubs, push, strict=True)], axis=0
        )
        twist = twist + [0, 0, -(spin * k_q * speed**2).sum()]
        turn = np.linalg.solve(inertia, twist - np.cross(rate, inertia @ rate))
        acc = attitude.apply([0, 0, push.sum() / vehicle.mass]) + [0, 0, -9.81]
        x, yq, z, _ = y[3:7]
        spun = 0.5 * np.array(
            [
                y[6] * rate[0] + yq * rate[2] - z * rate[1],
                y[6] * rate[1] + z * rate[0] - x * rate[2],
                y[6] * rate[2] + x * rate[1] - yq * rate[0],
                -x * rate[0] - yq * rate[1] - z * rate[2],
            ]
        )
        follow_up = (np.sqrt(asked / k_t) - speed) / vehicle.rotors.time_constant
        return np.concatenate([velocity, spun, acc, turn, follow_up])

    return solve_ivp(slopes, (0.0, duration), start, rtol=1e-10, atol=1e-10).y[:, -1]


def smooth_command(t):
    return 11.0 + 3.0 * np.sin(9.0 * t), np.array(
        [1.5 * np.sin(7.0 * t), 1.2 * np.cos(6.0 * t) - 1.2, 0.5 * np.sin(4.0 * t)]
    )


def test_flight_converges_to_an_independent_integration_with_order_one():
    vehicle = with_lag(PLAIN, 0.03)
    hover = np.sqrt(0.75 * 9.81 / 4 / 1.6e-6)
    start = np.concatenate([[0, 0, 1], [0, 0, 0, 1], np.zeros(6), np.full(4, hover)])
    truth = reference_flight(vehicle, smooth_command, 0.8, start)
    errors = []
    for dt in (0.004, 0.002, 0.001):
        plant = make_plant(vehicle, dt)
        memory, motion = start_memory(plant, ()), at_rest()
        for k in range(round(0.8 / dt)):
            thrust, rate = smooth_command((k + 0.5) * dt)
            command = Command(np.asarray(thrust), rate)
            memory, wrench = plant_step(plant, memory, motion, command, k * dt)
            motion = euler_step(plant, motion, wrench)
        attitude = Rotation.from_quat(truth[3:7]).as_matrix()
        parts = [
            motion.pos_w - truth[:3], motion.vel_w - truth[7:10], motion.rate_b - truth[10:13],
            (motion.rot_w - attitude).ravel(),
        ]  # fmt: skip
        errors.append(np.linalg.norm(np.concatenate(parts)))
        np.testing.assert_allclose(memory.rotor_speed, truth[13:], rtol=20 * dt)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.01
    assert np.all((orders > 0.8) & (orders < 1.3)), (errors, orders)
