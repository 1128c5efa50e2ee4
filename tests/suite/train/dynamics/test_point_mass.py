"""The point mass against an ODE solver and finite differences, and where its gradients stop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from suite.train.dynamics import point_mass
from suite.train.dynamics.point_mass import PointMassParams, PointMassState

ROLL = np.array(Rotation.from_euler("ZYX", [0.7, -0.3, 0.4]).as_matrix())


pytestmark = pytest.mark.usefixtures("float64")


flown = jax.jit(point_mass.step)


def constants(n, **changes):
    """Return parameters of `n` worlds, the same in all."""
    usual = {"lag": 12.0, "drag": (0.3, 0.4, 0.45), "wind_w": (0.5, -1.0, 0.1)}
    usual |= {"time_step": 0.033, "delay": 0.4, **changes}
    return PointMassParams(**{k: np.broadcast_to(v, (n, *np.shape(v))) for k, v in usual.items()})


def some_body(n):
    rng = np.random.default_rng(3)
    pos, vel, thrust, acc = (rng.normal(0, 2, (n, 3)) for _ in range(4))
    heading = np.tile([0.6, 0.8, 0.0], (n, 1))
    rot = np.tile(ROLL, (n, 1, 1))
    commands = rng.normal(0, 3, (n, 2, 3))
    return PointMassState(pos, vel, thrust, acc, rot, heading, commands)


DELAYS = (0.0, 0.4, 1.3, 2.0)
TARGET = np.array([[5.0, 1.0, 2.0], [-3.0, 2.0, 1.0], [4.0, -1.0, 0.0], [-2.0, -2.0, 3.0]])
ACTION = np.array([[1.0, -2.0, 0.5], [3.0, 0.2, -1.0], [-1.0, 1.0, 1.0], [2.0, 0.0, 4.0]])


def held_step(decay, drag=(0.3, 0.4, 0.45)):
    """Return step as a function of what carries gradients, to what carries them."""
    fixed, base = constants(4, drag=drag)._replace(delay=np.array(DELAYS)), some_body(4)

    def f(pos, vel, thrust, acc, commands, action):
        body = base._replace(pos_w=pos, vel_w=vel, thrust_w=thrust, acc_w=acc, commands_w=commands)
        after = point_mass.step(body, fixed, action, TARGET, decay)
        return after.pos_w, after.vel_w, after.thrust_w, after.acc_w, after.commands_w

    start = (base.pos_w, base.vel_w, base.thrust_w, base.acc_w, base.commands_w)
    return jax.jit(f), (*start, ACTION)


def test_gradients_are_those_of_finite_differences_and_decay_fades_position_and_velocity_alone():
    f, args = held_step(0.0)
    check_grads(f, args, order=1, modes=["rev"], atol=1e-6, rtol=1e-6)
    # Zhang et al. 2025: e^(-alpha dt) a step, acceleration and command not faded.
    alpha, dt = 0.916, 0.033
    jacobians = []
    for decay in (0.0, alpha):
        f, args = held_step(decay, drag=(0.0, 0.0, 0.0))
        jacobians.append(jax.jit(jax.jacrev(f, argnums=(0, 1, 3, 5)))(*args))
    whole, faded = jacobians
    fade = np.exp(-alpha * dt)
    for to in (0, 1):  # position and velocity after the step
        for start, factor in enumerate((fade, fade, 1.0, 1.0)):
            np.testing.assert_allclose(faded[to][start], factor * whole[to][start], atol=1e-14)
    assert np.abs(whole[0][1]).max() == pytest.approx(dt)
    values = (held_step(decay, drag=(0.0, 0.0, 0.0))[0](*args) for decay in (0.0, 3.0))
    for plain, decayed in zip(*values, strict=True):
        np.testing.assert_allclose(plain, decayed, atol=1e-12)


def test_attitude_carries_no_gradient():
    fixed, body = constants(4), some_body(4)

    @jax.jit
    def of_rotation(rot_w):
        after = point_mass.step(body._replace(rot_w=rot_w), fixed, jnp.asarray(ACTION), TARGET, 0.0)
        return sum(x.sum() for x in (after.pos_w, after.vel_w, after.thrust_w, after.acc_w))

    @jax.jit
    def to_attitude(action, pos, thrust):
        moved = body._replace(pos_w=pos, thrust_w=thrust)
        after = point_mass.step(moved, fixed, action, TARGET, 0.0)
        return (after.rot_w * jnp.arange(9.0).reshape(3, 3)).sum() + after.heading_w[:, 1].sum()

    assert not np.any(jax.grad(of_rotation)(body.rot_w))
    turned = body.rot_w @ Rotation.from_euler("x", 0.1).as_matrix()
    assert abs(of_rotation(turned) - of_rotation(body.rot_w)) > 1e-3
    inputs = (jnp.asarray(ACTION), body.pos_w, body.thrust_w)
    for gradient in jax.grad(to_attitude, argnums=(0, 1, 2))(*inputs):
        assert not np.any(gradient)
    assert abs(to_attitude(ACTION + 1.0, *inputs[1:]) - to_attitude(*inputs)) > 1e-3


def test_thrust_direction_is_up_and_the_nose_follows_the_heading():
    rng = np.random.default_rng(0)
    thrust = rng.normal(0, 6, (50, 3))
    yaw = rng.uniform(-np.pi, np.pi, 50)
    heading = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
    rot = np.array(point_mass.attitude(jnp.asarray(thrust), jnp.asarray(heading)))
    square = rot @ rot.transpose(0, 2, 1)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-9)
    assert np.all(np.linalg.det(rot) > 0.99)
    up = thrust + [0, 0, 9.81]
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    np.testing.assert_allclose(rot[:, :, 2], up, atol=1e-9)
    np.testing.assert_allclose((rot[:, :, 1] * heading).sum(-1), 0, atol=1e-9)
    assert np.all((rot[:, :, 0] * heading).sum(-1) > 0)


def test_a_fine_rollout_is_the_solution_of_its_differential_equation(monkeypatch):
    """v' = a - R D R^T (v - wind), a' = k (R u - a), with the attitude held at R."""
    held = jnp.asarray(ROLL)
    monkeypatch.setattr(point_mass, "attitude", lambda thrust, _: jnp.broadcast_to(held, (1, 3, 3)))
    lag, drag, wind = 9.0, np.array([0.3, 0.5, 0.2]), np.array([0.5, -1.0, 0.1])
    action, pos, vel = np.array([[2.0, -1.0, 4.0], [1.0, 2.0, 3.0], [3.0, 1.0, -0.5]])

    def air(v):
        return -ROLL @ (drag * (ROLL.T @ (v - wind)))

    def slope(_, state):
        _, v, a = state.reshape(3, 3)
        return np.concatenate([v, a + air(v), lag * (ROLL @ action - a)])

    start = np.concatenate([pos, vel, np.zeros(3)])
    exact = solve_ivp(slope, (0, 1), start, rtol=1e-10, atol=1e-10).y[:, -1].reshape(3, 3)
    errors, step = [], jax.jit(lambda *now: point_mass.step(*now))  # with the attitude held
    for steps in (50, 100):
        fixed = constants(1, time_step=1.0 / steps, lag=lag, drag=drag, wind_w=wind, delay=0.0)
        body = point_mass.start(*(jnp.array([row]) for row in (pos, vel, [1.0, 0, 0])))
        body = body._replace(acc_w=jnp.array([air(vel)]))
        for _ in range(steps):
            body = step(body, fixed, action[None], TARGET[:1], 0.0)
        found = np.array([x[0] for x in (body.pos_w, body.vel_w, body.thrust_w)])
        np.testing.assert_allclose(found[2], exact[2], atol=1e-9)
        errors.append(np.abs(found - exact)[:2].max())
    assert errors[0] < 0.03 and errors[1] < 0.6 * errors[0]


def test_a_delayed_command_is_the_one_of_steps_before_and_a_steady_one_is_followed_exactly():
    body = some_body(1)
    fixed = constants(1)
    first, second = body.commands_w[:, 0], body.commands_w[:, 1]
    commands = {0.0: 0 * first + 1.0, 1.0: first, 1.5: (first + second) / 2, 2.0: second}
    action, keep = jnp.ones((1, 3)) @ jnp.asarray(ROLL), np.exp(-12.0 * 0.033)
    for delay, command in commands.items():
        delayed = fixed._replace(delay=jnp.array([delay]))
        now = flown(body, delayed, action, TARGET[:1], 0.0)
        expected = command * (1 - keep) + body.thrust_w * keep
        np.testing.assert_allclose(now.thrust_w, expected, atol=1e-9)
    fixed = constants(1, drag=(0.0, 0.0, 0.0), delay=0.0)
    body, held = some_body(1), jnp.array(ACTION[:1] @ ROLL.T)
    body = body._replace(thrust_w=held, acc_w=held)
    after = flown(body, fixed, jnp.array(ACTION[:1]), TARGET[:1], 0.0)
    dt = 0.033
    expected = body.pos_w + body.vel_w * dt + 0.5 * held * dt**2
    np.testing.assert_allclose(after.pos_w, expected, atol=1e-12)
    np.testing.assert_allclose(after.vel_w, body.vel_w + held * dt, atol=1e-12)
