"""The quadrotor reduced to its loops, for training: few steps a decision, each exact.

Of the judge's quadrotor (`eval.quadrotor`) the attitude loop, the heading and the rotors' lag are
the same functions. What its mixer and four rotors do together is one angular acceleration a that
follows what the rate loop asks for as the rotors' speeds do,

    da/dt = (K (r - w) + z - a) / lag,   dz/dt = K_i (r - w),   dw/dt = a + b,

with the rate w, the wanted rate r and a constant disturbance b: linear, so that a step of any
length is one product with its matrix exponential. The gyroscopic torque is left out, which the rate
loop cancels. The mixer's limits are those of four rotors in an X: roll and pitch first, then the
collective in what room they leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading
from eval.quadrotor.rotors import delay_weight, follow, speed_command
from policies.spec import PolicySpec
from suite.train.dynamics.fleet import FleetConfig, Vehicles, draw_vehicles
from suite.train.dynamics.point_mass import attitude, faded
from suite.train.dynamics.quadrotor import whole_steps
from tracks.geometry.rotation import exp_rot, to_local, to_world
from tracks.geometry.scene import Array

SQUARINGS, TERMS = 8, 6
"""Of the matrix exponential: halvings of the step, and terms of the series for what is left."""


class Gains(NamedTuple):
    """The attitude loop's numbers, (B, 3) each."""

    attitude_gain: Array
    """Body rate per attitude error [1/s]."""
    rate_max: Array
    """[rad/s]."""


class ReducedParams(NamedTuple):
    """What is drawn once per world, prepared for steps of one length."""

    time_step: Array
    """(B,) the policy's period [s]."""
    vehicle: Vehicles
    """(B, ...)."""
    turn: Array
    """(B, 3, 4, 5) from (w, a, z, r, b) to (angle turned, w, a, z) a step later, on each axis."""
    delay_share: Array
    """(B, L) of each remembered command in the one that acts, newest first."""


class ReducedState(NamedTuple):
    """State of the reduced quadrotor at a decision of the policy."""

    pos_w: jax.Array
    """(B, 3) centre of mass [m]."""
    vel_w: jax.Array
    """(B, 3) [m/s]."""
    acc_w: jax.Array
    """(B, 3) mean net acceleration over the last period [m/s^2]."""
    rot_w: jax.Array
    """(B, 3, 3) body to world."""
    heading_w: jax.Array
    """(B, 3) wanted heading, horizontal unit vectors."""
    loop: jax.Array
    """(B, 3, 3) on each axis body rate [rad/s], angular acceleration by the rotors and the
    integrator's share of what is asked for [rad/s^2]."""
    thrust_root: jax.Array
    """(B, 1) root of the collective thrust per nominal mass, which goes as rotor speed does."""
    commands: jax.Array
    """(B, L, 4) the last commands, newest first: thrust [m/s^2] and rates [rad/s]."""

    @property
    def rate_b(self) -> jax.Array:
        """(B, 3) [rad/s]."""
        return self.loop[..., 0]


def steps_of(config: FleetConfig, period_s: float) -> int:
    """Return how many steps a policy period is cut into."""
    return whole_steps(period_s * config.attitude_hz)


def prepare(vehicles: Vehicles, steps: int, longest_delay: float | None = None) -> ReducedParams:
    """Return what is flown of `vehicles` in `steps` steps a policy period (numpy).

    Args:
        vehicles: (B, ...).
        steps: of a policy period.
        longest_delay: room to remember commands, in steps; what the vehicles need if not given.
    """
    dt = vehicles.time_step / steps
    late = vehicles.delay / dt
    room = float(late.max(initial=0.0)) if longest_delay is None else longest_delay
    share = delay_weight(np.minimum(late, room), 1.0, max(room, 1e-6))
    turn = turn_matrix(vehicles.rate_gain, vehicles.integral_gain, vehicles.rotor_lag, dt)

    def single(array: np.ndarray) -> np.ndarray:
        return np.asarray(array, np.float32)

    flown = Vehicles(*map(single, vehicles))
    return ReducedParams(flown.time_step, flown, single(turn), single(share))


def draw_fleet(
    config: FleetConfig, period_s: float, batch: int, rng: np.random.Generator
) -> ReducedParams:
    """Return `batch` quadrotors of the class, ready to fly."""
    steps = steps_of(config, period_s)
    shortest = period_s * (1 - 2.0 * config.time_step_std) / steps
    longest = math.ceil(config.delay_s[1] / shortest)
    return prepare(draw_vehicles(config, period_s, batch, rng), steps, longest)


def turn_matrix(
    rate_gain: np.ndarray, integral_gain: np.ndarray, lag: np.ndarray, dt: np.ndarray
) -> np.ndarray:
    """Return the exact step of the rate loop, (B, 3, 4, 5) as `ReducedParams.turn`.

    Args:
        rate_gain: (B, 3) K [1/s].
        integral_gain: (B, 3) K_i [1/s^2].
        lag: (B,) of the rotors [s].
        dt: (B,) length of the step [s].
    """
    follows = 1.0 / lag[:, None]
    rate = np.zeros((*rate_gain.shape, 6, 6))
    # Rows: d/dt of angle, w, a, z, r, b.
    rate[..., 0, 1] = 1.0
    rate[..., 1, 2], rate[..., 1, 5] = 1.0, 1.0
    rate[..., 2, 1], rate[..., 2, 2] = -rate_gain * follows, -follows
    rate[..., 2, 3], rate[..., 2, 4] = follows, rate_gain * follows
    rate[..., 3, 1], rate[..., 3, 4] = -integral_gain, integral_gain
    part = rate * (dt / 2**SQUARINGS)[:, None, None, None]
    found, power = np.eye(6) + part, part
    for order in range(2, TERMS + 1):
        power = power @ part / order
        found = found + power
    for _ in range(SQUARINGS):
        found = found @ found
    return found[..., :4, 1:]


def start(
    constants: ReducedParams, pos_w: jax.Array, vel_w: jax.Array, heading_w: jax.Array
) -> ReducedState:
    """Return bodies (B, ...) that hovered until now, upright, at vel_w [m/s]."""
    zero = jnp.zeros_like(pos_w)
    batch, length = constants.delay_share.shape
    hover = jnp.asarray([GRAVITY, 0.0, 0.0, 0.0])
    return ReducedState(
        pos_w=pos_w,
        vel_w=vel_w,
        acc_w=zero,
        rot_w=attitude(zero, heading_w),
        heading_w=heading_w,
        loop=jnp.zeros((batch, 3, 3)),
        thrust_root=jnp.full((batch, 1), math.sqrt(GRAVITY)),
        commands=jnp.broadcast_to(hover, (batch, length, 4)),
    )


def fly(
    body: ReducedState,
    constants: ReducedParams,
    action_b: jax.Array,
    target_w: jax.Array,
    dt: Array,
) -> ReducedState:
    """Return the bodies one step of `dt` (B, 1) [s] later; `acc_w` is that of the step."""
    vehicle = constants.vehicle
    heading_w = jax.lax.stop_gradient(
        blend_heading(body.heading_w, target_w - body.pos_w, dt[:, 0])
    )
    force_w = action_to_force(action_b, body.rot_w)
    gains = Gains(vehicle.attitude_gain, vehicle.rate_max)
    asked = attitude_command(gains, force_w, body.rot_w, heading_w)
    commands = jnp.concatenate([asked.packed[:, None], body.commands[:, :-1]], axis=1)
    acting = (constants.delay_share[..., None] * commands).sum(1)

    # What the mixer cannot give is not asked for: a rate nearer to the one there is.
    rate, trim = body.loop[..., 0], body.loop[..., 2]
    gain, limit = vehicle.rate_gain, vehicle.turn_max
    wanted = gain * (acting[:, 1:] - rate) + trim
    # Roll and pitch are scaled together, yaw alone.
    share = jnp.abs(wanted[:, :2] / limit[:, :2]).sum(-1)
    turn = wanted[:, :2] / jnp.maximum(share, 1.0)[:, None]
    yaw = jnp.clip(wanted[:, 2:], -limit[:, 2:], limit[:, 2:])
    wanted = jnp.concatenate([turn, yaw], axis=-1)
    rate_cmd = rate + (wanted - trim) / gain
    level = 0.5 * jnp.minimum(share, 1.0) * vehicle.thrust_max
    thrust = jnp.clip(acting[:, 0], level, vehicle.thrust_max - level)
    root = speed_command(thrust[:, None], 1.0)
    rotors = follow(body.thrust_root, root, vehicle.rotor_lag, dt[:, 0])
    push = vehicle.force_scale[:, None] * rotors.mean_square

    bias = vehicle.trim + vehicle.turn_by_thrust * push
    inputs = jnp.concatenate([body.loop, jnp.stack([rate_cmd, bias], -1)], axis=-1)
    turned = (constants.turn * inputs[..., None, :]).sum(-1)

    air_b = to_local(body.rot_w, body.vel_w - vehicle.wind_w)
    speed = jnp.sqrt((air_b * air_b).sum(-1, keepdims=True) + 1e-6)
    drag_b = (vehicle.drag + vehicle.quadratic * speed) * air_b
    # The thrust points where the body does in the middle of the step.
    half_w = body.rot_w @ exp_rot(0.5 * turned[..., 0])
    along = half_w[..., 2] * push
    acc_w = along - to_world(body.rot_w, drag_b) - jnp.asarray([0.0, 0.0, GRAVITY])
    return ReducedState(
        pos_w=body.pos_w + dt * body.vel_w + 0.5 * dt * dt * acc_w,
        vel_w=body.vel_w + dt * acc_w,
        acc_w=acc_w,
        rot_w=body.rot_w @ exp_rot(turned[..., 0]),
        heading_w=heading_w,
        loop=turned[..., 1:],
        thrust_root=rotors.end,
        commands=commands,
    )


def step(
    body: ReducedState,
    constants: ReducedParams,
    action_b: jax.Array,
    target_w: jax.Array,
    steps: int,
    gradient_decay: float,
) -> ReducedState:
    """Return the bodies one policy period later.

    Args:
        body: now.
        constants: of each world.
        action_b: (B, 3) wanted net acceleration in body axes [m/s^2], held for the period.
        target_w: (B, 3) the gate that the nose turns to [m].
        steps: that the period is cut into.
        gradient_decay: rate at which gradients of the motion fade back in time [1/s].
    """
    period = constants.time_step[:, None]
    left = jnp.exp(-gradient_decay * period)
    body = body._replace(
        pos_w=faded(body.pos_w, left),
        vel_w=faded(body.vel_w, left),
        rot_w=faded(body.rot_w, left[..., None]),
        loop=faded(body.loop, left[..., None]),
    )
    before_w = body.vel_w
    for _ in range(steps):
        body = fly(body, constants, action_b, target_w, period / steps)
    return body._replace(acc_w=(body.vel_w - before_w) / period)


def fleet_dynamics(
    config: FleetConfig, period_s: float, gradient_decay: float
) -> tuple[Callable[..., ReducedState], Callable[..., ReducedState]]:
    """Return start and step as in `suite.train.dynamics.interface.Dynamics`.

    Args:
        config: the fleet.
        period_s: the policy's [s].
        gradient_decay: rate at which gradients of the motion fade back in time [1/s].
    """
    steps = steps_of(config, period_s)

    # Inside a period the forward pass is computed again on the way back instead of kept.
    @jax.checkpoint
    def one(
        body: ReducedState,
        constants: ReducedParams,
        action_b: jax.Array,
        target_w: jax.Array,
        _: jax.Array,
    ) -> ReducedState:
        return step(body, constants, action_b, target_w, steps, gradient_decay)

    return start, one


def state_noise(config: FleetConfig, spec: PolicySpec) -> jax.Array:
    """Return the standard deviation (state_size,) of the noise on each number of the state.

    Velocity, up, gate and the last action, which is known; then the extras of `spec`: a second
    gate, both gates' axes, and how fast to fly, which is known.
    """
    vel, axis, gate = config.vel_noise, config.axis_noise, config.gate_noise_m
    triples = [vel, axis, gate, 0.0]
    triples += [gate] * spec.second_gate + [axis] * (spec.gate_axis + spec.second_axis)
    known = [0.0] * (spec.state_size - 3 * len(triples))
    return jnp.concatenate([jnp.repeat(jnp.asarray(triples), 3), jnp.asarray(known)])


def as_seen(body: ReducedState, age_s: Array) -> ReducedState:
    """Return about what the bodies were `age_s` (B,) [s] ago: what a late sensor sees."""
    age = age_s[:, None]
    return body._replace(
        pos_w=body.pos_w - age * body.vel_w,
        vel_w=body.vel_w - age * body.acc_w,
        rot_w=body.rot_w @ exp_rot(-age * body.rate_b),
    )


def as_sensed(body: ReducedState, constants: ReducedParams, camera: bool) -> ReducedState:
    """Return the bodies as their sensors, or their cameras, show them: late."""
    vehicle = constants.vehicle
    return as_seen(body, vehicle.image_latency if camera else vehicle.state_latency)
