"""The steppers: physics, parity with MuJoCo and numpy, order, and gradients of every effect."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from eval.effects import EFFECTS, all_values
from eval.quadrotor import continuous
from eval.quadrotor import plant as plants
from eval.quadrotor.continuous import Steps
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Command, Motion, Wrench, accelerations, fit_plant, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, plant_step, rollout, step
from eval.quadrotor.vehicle_file import load_vehicle
from tests.support.vehicles import PLAIN, at_rest, drawn_effects, with_effects, with_lag
from tracks.geometry.rotation import quat_to_rot

pytestmark = pytest.mark.usefixtures("float64")


def aggressive_commands(steps, seed=0):
    """Thrust from 0 to twice gravity and rates to the limit, changed every 40 steps."""
    rng = np.random.default_rng(seed)
    parts = -(-steps // 40)
    thrust = np.repeat(rng.uniform(0.0, 22.0, parts), 40)[:steps]
    rate_b = np.repeat(rng.uniform(-6.0, 6.0, (parts, 3)), 40, axis=0)[:steps]
    return Command(thrust, rate_b)


PART = 50
ROLLOUT = jax.jit(rollout)


def fly(plant, motion, commands, noise=None):
    """Roll out in parts of one length, so that all tests share one compiled model."""
    steps = len(commands.thrust)
    noise = np.zeros((steps, 3)) if noise is None else noise
    state, rows = hover_state(plant, ()), [Motion(*(field[None] for field in motion))]
    for k in range(0, steps, PART):
        inputs = Inputs(commands, noise=noise)
        part = jax.tree.map(lambda field, k=k: field[k : k + PART], inputs)
        flown = jax.tree.map(np.asarray, ROLLOUT(plant, motion, part, state, k * plant.dt))
        state, motion = flown.state, Motion(*(field[-1] for field in flown.motion))
        rows.append(Motion(*(field[1:] for field in flown.motion)))
    return Motion(*(np.concatenate(parts) for parts in zip(*rows, strict=True))), state


def fly_mujoco(vehicle, motion, commands, noise=None):
    """Fly the numpy plant on MuJoCo's own `mj_step`, as a world does."""
    dt = 1.0 / vehicle.controller.frequency
    model = compile_quadrotor(mujoco.MjSpec(), vehicle, dt)
    data = mujoco.MjData(model)
    plant = make_plant(vehicle, dt)
    state = hover_state(plant, ())
    data.qpos[:3], data.qpos[3:] = motion.pos_w, [1.0, 0.0, 0.0, 0.0]
    data.qvel[:3], data.qvel[3:] = motion.vel_w, motion.rate_b
    rows = [np.concatenate([data.qpos, data.qvel])]
    for k in range(len(commands.thrust)):
        rot_w = quat_to_rot(data.qpos[3:].copy())
        now = Motion(data.qpos[:3].copy(), rot_w, data.qvel[:3].copy(), data.qvel[3:].copy())
        command = Command(np.asarray(commands.thrust[k]), commands.rate_b[k])
        inputs = Inputs(command, noise=None if noise is None else noise[k])
        state, wrench = plant_step(plant, state, now, inputs, k * dt)
        data.qfrc_applied[:3], data.qfrc_applied[3:] = rot_w @ wrench.force_b, wrench.torque_b
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(rows), state


def assert_same_flight(rows, flight, tolerance):
    np.testing.assert_allclose(flight.pos_w, rows[:, :3], atol=tolerance)
    np.testing.assert_allclose(flight.rot_w, quat_to_rot(rows[:, 3:7]), atol=tolerance)
    np.testing.assert_allclose(flight.vel_w, rows[:, 7:10], atol=10 * tolerance)
    np.testing.assert_allclose(flight.rate_b, rows[:, 10:], atol=100 * tolerance)


FAST = Motion(np.array([0.0, 0.0, 2.0]), np.eye(3), np.array([6.0, 1.0, 0.0]), np.zeros(3))


@pytest.mark.parametrize("name", ["reference", "racer5"])
def test_half_a_second_of_aggressive_flight_is_mujocos(name):
    """Also: the model that holds the whole catalogue, unused, is the vehicle's own."""
    vehicle = load_vehicle(name)
    commands = aggressive_commands(250)
    rows, state = fly_mujoco(vehicle, FAST, commands)
    assert np.linalg.norm(rows[:, 10:], axis=1).max() > 5.0
    flight, last = fly(fit_plant(vehicle, {}), FAST, commands)
    # Rounding only, grown over 250 steps: both step the same equations in double precision.
    assert_same_flight(rows, flight, 1e-10)
    np.testing.assert_allclose(last.rotor_speed, state.rotor_speed, rtol=1e-9)


def test_the_whole_catalogue_at_once_flies_like_mujoco():
    vehicle = drawn_effects(np.random.default_rng(8), with_lag(PLAIN, 0.03))
    inertia = make_plant(vehicle, 0.002).constants.inertia
    assert inertia[2] > inertia[0] + inertia[1]  # which MuJoCo's compiler would refuse
    commands, noise = aggressive_commands(250), np.random.default_rng(9).standard_normal((250, 3))
    rows, _ = fly_mujoco(vehicle, FAST, commands, noise)
    flight, _ = fly(fit_plant(PLAIN, vehicle.effects), FAST, commands, noise)
    assert_same_flight(rows, flight, 1e-10)


BASE = with_lag(PLAIN, 0.03)
TRIMMED = {
    # Away from every kink: a delay between steps, wind and sag that act, rotors near the ground.
    "command_delay": (0.0113,),
    "linear_drag": ((0.2, 0.2, 0.3),),
    "quadratic_drag": ((0.01, 0.01, 0.02),),
    "constant_wind": ((1.0, -2.0, 0.3),),
    "ground_effect": (1.0, 0.0635),
    "gusts": (0.8, 4.0),
    "slung_load": (0.05, 0.5),
}


@pytest.fixture(scope="module")
def slopes():
    """Gradient of a number made of the whole flight, and that number, with every effect."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        steps = 60
        command = Command(
            jnp.asarray(np.repeat(rng.uniform(8.0, 12.0, steps // 5), 5)),
            jnp.asarray(np.repeat(rng.uniform(-1.5, 1.5, (steps // 5, 3)), 5, axis=0)),
        )
        motion = FAST._replace(pos_w=np.array([0.0, 0.0, 0.15]), rate_b=np.array([0.5, -0.4, 0.3]))
        noise = jnp.asarray(rng.standard_normal((steps, 3)))
        inputs = Inputs(command, noise=noise, voltage_drop=jnp.linspace(0.0, 1.0, steps))
        weight = [jnp.asarray(rng.standard_normal(shape)) for shape in ((3,), (3, 3), (3,), (3,))]

        def score(effects):
            flight = rollout(fit_plant(BASE, effects), motion, inputs)
            parts = zip(flight.motion, weight, strict=True)
            return sum((part * w).sum() for part, w in parts)

        start = jax.tree.map(jnp.asarray, all_values(with_effects(BASE, **TRIMMED)))
        value_and_slope = jax.jit(jax.value_and_grad(score))
        yield start, lambda effects: value_and_slope(effects)[0], value_and_slope(start)[1]


# Faults of a log do not act on the flight, a neutral gust's length and a rotor's radius neither.
IN_FLIGHT = [name for name, effect in EFFECTS.items() if effect.in_flight]


@pytest.mark.parametrize("name", IN_FLIGHT)
def test_gradient_of_every_parameter_is_that_of_finite_differences(slopes, name):
    start, score, gradient = slopes
    rng = np.random.default_rng(4)
    for parameter in EFFECTS[name].parameters:
        value = getattr(start[name], parameter.name)
        direction = jnp.asarray(rng.choice([-1.0, 1.0], np.shape(value)))
        step = 1e-4 * parameter.typical[0]

        def moved(size, value=value, direction=direction, parameter=parameter):
            change = {parameter.name: value + size * direction}
            return score({**start, name: start[name]._replace(**change)})

        expected = (moved(step) - moved(-step)) / (2.0 * step)
        ours = (getattr(gradient[name], parameter.name) * direction).sum()
        if name == "battery_sag":
            # With a voltage the rate does not count once per_volt is given: one-sided.
            expected = (moved(step) - moved(0.0)) / step
        assert np.isfinite(ours)
        assert abs(ours) > 0.0
        np.testing.assert_allclose(ours, expected, rtol=2e-4, atol=1e-7)


def test_measured_rotor_speeds_stand_for_the_command():
    plant, speed = make_plant(PLAIN, 0.002), np.full((40, 4), 1200.0)
    start = hover_state(plant, ())
    held = rollout(plant, FAST, Inputs(aggressive_commands(40), rotor_speed=speed), start)
    bare = rollout(plant, FAST, Inputs(rotor_speed=speed), start)
    np.testing.assert_array_equal(held.rotor_speed[1:], 1200.0)
    np.testing.assert_array_equal(held.motion.pos_w, bare.motion.pos_w)
    np.testing.assert_allclose(held.acc_b[:, 2], 4 * 1.6e-6 * 1200.0**2 / 0.75)


def test_a_push_is_an_acceleration_in_body_axes():
    plant = make_plant(PLAIN, 0.002)
    inputs = Inputs(Command(np.full(50, 9.81), np.zeros((50, 3))))
    push_b = np.tile([1.0, -2.0, 0.5, 0.3, 0.2, -0.1], (50, 1))
    still, start = hover_state(plant, ()), at_rest()
    bare = plant_step(plant, still, start, jax.tree.map(lambda x: x[0], inputs), 0.0)[1]
    now = jax.tree.map(lambda x: x[0], inputs._replace(push_b=push_b))
    pushed = plant_step(plant, still, start, now, 0.0)[1]
    both = zip(accelerations(plant, start, pushed), accelerations(plant, start, bare), strict=True)
    found = np.concatenate([new - old for new, old in both])
    np.testing.assert_allclose(found, push_b[0], atol=1e-12)

    given = rollout(plant, start, inputs._replace(push_b=push_b), still)
    assert given.motion.vel_w[-1, 0] > 0.09


def test_rate_loop_cancels_the_gyroscopic_torque():
    plant = make_plant(PLAIN, 0.002)
    rate = np.array([2.0, -1.0, 1.5])
    motion = Motion(np.zeros(3), np.eye(3), np.zeros(3), rate)
    inputs = Inputs(Command(np.asarray(12.0), rate))
    _, wrench = plant_step(plant, hover_state(plant, ()), motion, inputs, 0.0)
    _, turn = accelerations(plant, motion, wrench)
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)


def reference_flight(vehicle, command_of, duration, start):
    """Integrate contracts of the nominal quadrotor in continuous time; shares no code with ours.

    State: position, quaternion xyzw, velocity, body rate, rotor speeds.
    """
    hubs, spin = np.array(vehicle.rotors.position), np.array(vehicle.rotors.spin)
    k_t, k_q = vehicle.rotors.thrust_coefficient, vehicle.rotors.torque_coefficient
    inertia, gain = np.diag(vehicle.inertia), np.diag(vehicle.controller.rate_gain)
    x, y, _ = hubs.T
    allocation = np.array([np.ones(4), y, -x, -spin * k_q / k_t])

    def slopes(t, state):
        attitude, vector, scalar = Rotation.from_quat(state[3:7]), state[3:6], state[6]
        velocity, rate, speed = state[7:10], state[10:13], state[13:]
        thrust, wanted_rate = command_of(t)
        torque = inertia @ gain @ (wanted_rate - rate) + np.cross(rate, inertia @ rate)
        asked = np.linalg.solve(allocation, [vehicle.mass * thrust, *torque])
        assert np.all((asked > 0) & (asked < vehicle.rotors.thrust_max))
        push = k_t * speed**2
        twist = np.cross(hubs, push[:, None] * [0, 0, 1]).sum(axis=0)
        twist = twist + [0, 0, -(spin * k_q * speed**2).sum()]
        turn = np.linalg.solve(inertia, twist - np.cross(rate, inertia @ rate))
        acc = attitude.apply([0, 0, push.sum() / vehicle.mass]) + [0, 0, -9.81]
        spun = 0.5 * np.append(scalar * rate + np.cross(vector, rate), -vector @ rate)
        follow_up = (np.sqrt(asked / k_t) - speed) / vehicle.rotors.time_constant
        return np.concatenate([velocity, spun, acc, turn, follow_up])

    return solve_ivp(slopes, (0.0, duration), start, rtol=1e-10, atol=1e-10).y[:, -1]


def smooth_command(t):
    rate = [1.5 * np.sin(7.0 * t), 1.2 * np.cos(6.0 * t) - 1.2, 0.5 * np.sin(4.0 * t)]
    return 11.0 + 3.0 * np.sin(9.0 * t), np.array(rate)


@pytest.mark.extended
def test_flight_converges_to_an_independent_integration_with_order_one():
    vehicle = with_lag(PLAIN, 0.03)
    hover = np.sqrt(0.75 * 9.81 / 4 / 1.6e-6)
    start = np.concatenate([[0, 0, 1], [0, 0, 0, 1], np.zeros(6), np.full(4, hover)])
    truth = reference_flight(vehicle, smooth_command, 0.8, start)
    errors = []
    for dt in (0.004, 0.002, 0.001):
        plant = make_plant(vehicle, dt)
        state, motion = hover_state(plant, ()), at_rest()
        for k in range(round(0.8 / dt)):
            thrust, rate = smooth_command((k + 0.5) * dt)
            inputs = Inputs(Command(np.asarray(thrust), rate))
            state, motion, _ = step(plant, state, motion, inputs, k * dt)
        attitude = Rotation.from_quat(truth[3:7]).as_matrix()
        parts = [
            motion.pos_w - truth[:3], motion.vel_w - truth[7:10], motion.rate_b - truth[10:13],
            (motion.rot_w - attitude).ravel(),
        ]  # fmt: skip
        errors.append(np.linalg.norm(np.concatenate(parts)))
        np.testing.assert_allclose(state.rotor_speed, truth[13:], rtol=20 * dt)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.01
    assert np.all((orders > 0.8) & (orders < 1.3)), (errors, orders)


def test_tumbling_keeps_angular_momentum_and_energy_to_first_order():
    inertia = np.array(PLAIN.inertia)
    start = at_rest()._replace(rate_b=np.array([3.0, 8.0, 1.0]))
    drifts = []
    for dt in (0.002, 0.001):
        plant, motion = make_plant(PLAIN, dt), start
        for _ in range(round(0.4 / dt)):
            motion = plants.euler_step(plant, motion, Wrench(np.zeros(3), np.zeros(3)))
        before, after_w = inertia * start.rate_b, motion.rot_w @ (inertia * motion.rate_b)
        energy = (inertia * motion.rate_b**2).sum() / (inertia * start.rate_b**2).sum()
        turned = np.linalg.norm(after_w - before) / np.linalg.norm(before)
        drifts.append([turned, abs(energy - 1.0)])
    assert np.max(drifts) < 0.02
    ratio = np.array(drifts[0]) / drifts[1]
    assert np.all((ratio > 1.7) & (ratio < 2.3)), ratio


TRUTH = with_effects(with_lag(PLAIN, 0.03), linear_drag=((0.4, 0.5, 0.2),),
                     angular_damping=((0.5, 0.4, 0.3),))  # fmt: skip
DT = 0.002
ONES = np.ones((1, 3))
MOVING = Motion(0.0 * ONES, np.eye(3)[None], ONES, 0.0 * ONES)
FINEST_S = 0.00025
by_jax = jax.jit(continuous.fly, static_argnums=6)


def flown(length_s, duration_s=0.3):
    """Fly a turn with commands that change every 0.02 s, the loop looking as often.

    Steps of no length fill up what is flown, so that all lengths are one program.
    """
    plant, count = make_plant(TRUTH, DT), round(duration_s / length_s)
    time = np.minimum(np.arange(round(duration_s / FINEST_S)), count) * length_s
    held = np.floor(time / 0.02 + 1e-9) * 0.02
    rate_b = np.stack([3 * np.sin(9 * held), 2 * np.cos(7 * held), 0.5 + 0 * held], axis=-1)
    command = Command((11 + 3 * np.sin(5 * held))[:, None], rate_b[:, None])
    looks = np.abs(time / 0.02 - np.rint(time / 0.02)) < 1e-9
    length = np.diff(time, append=duration_s)
    steps = Steps(*(x[:, None] for x in (length, looks & (length > 0.0), 0 * time)))
    speed = hover_state(plant, (1,)).rotor_speed
    return by_jax(plant, MOVING, steps, Inputs(command), speed, np.zeros(1), "continuous")


def end_of(flight):
    return np.concatenate([np.ravel(field[-1]) for field in flight.motion])


@pytest.mark.extended
def test_half_the_step_is_a_quarter_of_the_error():
    fine = end_of(flown(FINEST_S))
    coarse, half = (np.abs(end_of(flown(h)) - fine).max() for h in (0.004, 0.002))
    assert coarse < 1e-4 and 3.0 < coarse / half < 5.0


def test_euler_steps_are_the_steppers():
    plant = make_plant(TRUTH, DT)
    rng = np.random.default_rng(0)
    thrust, rates = rng.uniform(8, 14, (200, 1)), rng.uniform(-3, 3, (200, 1, 3))
    inputs, state = Inputs(Command(thrust, rates)), hover_state(plant, (1,))
    ones = np.ones((200, 1))
    steps = Steps(DT * ones, ones > 0, 0.0 * ones)
    theirs = jax.jit(rollout)(plant, MOVING, inputs, state)
    ours = by_jax(plant, MOVING, steps, inputs, state.rotor_speed, np.zeros(1), "euler")
    np.testing.assert_allclose(end_of(ours), end_of(theirs), atol=1e-11)
    np.testing.assert_allclose(ours.acc_b, theirs.acc_b, atol=1e-10)


def test_a_step_of_no_length_moves_nothing():
    plant, zero = make_plant(TRUTH, DT), np.zeros((3, 1))
    inputs, start = Inputs(Command(zero + 20.0, np.ones((3, 1, 3)))), MOVING._replace(rate_b=ONES)
    speed, steps = hover_state(plant, (1,)).rotor_speed, Steps(zero, zero > 0, zero)
    flight = by_jax(plant, start, steps, inputs, speed, np.zeros(1), "continuous")
    for field, first in zip(flight.motion, start, strict=True):
        np.testing.assert_array_equal(field[-1], first)
    np.testing.assert_allclose(flight.rotor_speed[-1], speed, rtol=1e-6)
