"""The differentiable quadrotor of the trainer: B vehicles fly one policy period, with gradients.

The equations are those of the judge, which flies policies in MuJoCo and scores them
(`eval.quadrotor`: attitude, stepper, rigid body). At each of its steps the attitude loop computes
collective thrust and body rates from the action. In the physics steps between them, the plant
(rate loop, mixer, rotors and effects such as drag) computes the force and torque that move the
body. A period has a whole number of attitude steps and physics steps, so a step is a little
shorter or longer than configured. By default there are half as many steps as in the judge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import EFFECTS, as_arrays, neutral
from eval.effects.interface import Values, bound_value
from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading
from eval.quadrotor.plant import Command, Motion, Plant, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, PlantState, hover_state, step
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.train.config import QuadrotorConfig
from suite.train.dynamics.point_mass import attitude, faded
from tracks.geometry.scene import Array

TRIM_AXES = (1.0, 1.0, 0.2)
"""Standard deviations of a constant torque about x, y and z, relative to that about x."""


class QuadrotorParams(NamedTuple):
    """Parameters that are drawn once for each world of a batch."""

    time_step: Array
    """(B,) the policy's period [s]."""
    effects: dict[str, Values]
    """Values (B, ...) of the effects that vary, by name. The other effects have the values of the
    vehicle file."""


class QuadrotorState(NamedTuple):
    """State of the quadrotor at a decision of the policy."""

    pos_w: jax.Array
    """(B, 3) position of the centre of mass [m]."""
    vel_w: jax.Array
    """(B, 3) velocity [m/s]."""
    acc_w: jax.Array
    """(B, 3) mean net acceleration over the last period [m/s^2]."""
    rot_w: jax.Array
    """(B, 3, 3) attitude, body to world."""
    rate_b: jax.Array
    """(B, 3) body rates [rad/s]."""
    heading_w: jax.Array
    """(B, 3) wanted heading, horizontal unit vectors."""
    plant: PlantState
    """(B, ...) rotor speeds and commands that are still delayed."""
    time_s: jax.Array
    """(B,) time since the start of the flight [s]."""


class Substeps(NamedTuple):
    """The steps into which a policy period is divided: attitude steps, each of physics steps."""

    attitude: int
    """Steps of the attitude loop in a period."""
    physics: int
    """Physics steps in each attitude step."""
    dt: float
    """Length of a physics step [s]."""


def whole_steps(steps: float) -> int:
    """Return the nearest whole number, at least 1; a half is rounded down."""
    # The small number makes the result independent of rounding errors in `steps`.
    return max(1, round(steps - 1e-6))


def substeps(config: QuadrotorConfig, period_s: float) -> Substeps:
    """Return the steps nearest to the configured frequencies for a policy period."""
    attitude_steps = whole_steps(period_s * config.attitude_hz)
    physics = whole_steps(period_s * config.physics_hz / attitude_steps)
    return Substeps(attitude_steps, physics, period_s / (attitude_steps * physics))


def truncated_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return draws of a standard normal distribution, clipped to the range from -2 to 2."""
    return np.clip(rng.standard_normal(shape), -2.0, 2.0)


def draw_effects(
    config: QuadrotorConfig, batch: int, rng: np.random.Generator
) -> dict[str, Values]:
    """Return values (B, ...) of the effects that vary, by name, drawn around the vehicle file's."""
    vehicle = config.vehicle

    def mean(name: str) -> Any:
        """Return the vehicle's values of an effect; if it lacks the effect, neutral values."""
        return as_arrays(vehicle.effects.get(name, neutral(EFFECTS[name], vehicle)))

    def uniform(*shape: int) -> np.ndarray:
        """Return draws (B, *shape) from -1 to 1."""
        return rng.uniform(-1.0, 1.0, (batch, *shape))

    mass = mean("mass_offset").offset + vehicle.mass
    drag = mean("linear_drag").coefficient + config.drag_spread * uniform(3)
    delay = mean("command_delay").delay + config.delay_spread_s * uniform()
    wind = rng.standard_normal((batch, 3)) * np.asarray(config.wind_std)
    # The lowest mass that the effect allows: the vehicle's mass plus the smallest offset.
    lightest = vehicle.mass + bound_value(EFFECTS["mass_offset"].parameters[0].low, vehicle)

    def lag(draw: np.ndarray) -> np.ndarray:
        scaled = mean("motor_lag").time_constant * (1 + config.lag_spread * draw)
        return np.maximum(scaled + config.lag_spread_s * draw, 0.0)

    fields: dict[str, tuple[np.ndarray, ...]] = {
        "linear_drag": (np.maximum(drag, 0.0),),
        "constant_wind": (mean("constant_wind").velocity + wind,),
        "motor_lag": (lag(uniform()),),
        "command_delay": (np.clip(delay, 0.0, longest_delay(config)),),
        "mass_offset": (
            np.maximum(mass * (1 + config.mass_std * rng.standard_normal(batch)), lightest)
            - vehicle.mass,
        ),
        "rate_gain": (mean("rate_gain").scale * (1 + config.gain_spread * uniform(3)),),
    }
    # The following effects are left out if they do not vary: each one makes a physics step slower.
    if config.thrust_spread:
        scale = 1 + config.thrust_spread * uniform()
        fields["thrust_scale"] = (mean("thrust_scale").scale * scale,)
    if config.com_std_m:
        offset = config.com_std_m * truncated_normal(rng, batch, 3) * [1.0, 1.0, 0.0]
        fields["com_offset"] = (mean("com_offset").offset + offset,)
    if config.trim_std:
        torque = config.trim_std * truncated_normal(rng, batch, 3) * TRIM_AXES
        fields["torque_trim"] = (mean("torque_trim").torque + torque,)
    return {
        name: EFFECTS[name].values(*(np.asarray(x, np.float32) for x in values))
        for name, values in fields.items()
    }


@dataclass(frozen=True)
class DrawnVehicle:
    """A callable that draws a vehicle at random, as training does for each world."""

    config: QuadrotorConfig
    """The vehicle and its randomisation."""

    def __call__(self, rng: np.random.Generator) -> Vehicle:
        """Return the vehicle with drawn values of its effects."""
        # A batch of one vehicle; its values become plain numbers.
        drawn = {
            name: type(values)(*(np.asarray(value, float)[0].tolist() for value in values))
            for name, values in draw_effects(self.config, 1, rng).items()
        }
        return with_effects(self.config.vehicle, drawn)


def longest_delay(config: QuadrotorConfig) -> float:
    """Return the longest delay of commands in any world [s]."""
    effect = config.vehicle.effects.get("command_delay")
    limit = bound_value(EFFECTS["command_delay"].parameters[0].high, config.vehicle)
    delay = 0.0 if effect is None else float(effect.delay)
    return min(delay + config.delay_spread_s, max(limit, delay))


def plant_of(
    config: QuadrotorConfig, effects: dict[str, Values], dt: float, varies: bool = True
) -> Plant:
    """Return the plants (rate loop, mixer, rotors and effects) of B worlds for steps of `dt` [s].

    `effects` are values (B, ...) by name, which replace those of the vehicle. If the delay of
    commands `varies` among them, the plant stores as many past commands as the longest possible
    delay needs.
    """
    vehicle_effects: dict[str, Any] = dict(config.vehicle.effects)
    longest = longest_delay(config) if varies else None
    return make_plant(config.vehicle, dt, {**vehicle_effects, **effects}, longest)


def start_state(
    plant: Plant, pos_w: jax.Array, vel_w: jax.Array, heading_w: jax.Array
) -> QuadrotorState:
    """Return upright bodies at pos_w with velocity vel_w; their rotors have the speed of hover."""
    batch = pos_w.shape[:1]
    zero = jnp.zeros_like(pos_w)
    return QuadrotorState(
        pos_w=pos_w,
        vel_w=vel_w,
        acc_w=zero,
        rot_w=attitude(zero, heading_w),
        rate_b=zero,
        heading_w=heading_w,
        plant=hover_state(plant, batch, jnp),
        time_s=jnp.zeros(batch, pos_w.dtype),
    )


def fly_period(
    vehicle: Vehicle,
    plant: Plant,
    steps: Substeps,
    body: QuadrotorState,
    action_b: jax.Array,
    heading: Callable[[jax.Array, jax.Array], jax.Array],
    noise: jax.Array | None = None,
    yaw_rate: jax.Array | None = None,
) -> QuadrotorState:
    """Return the bodies one policy period later, without gradient decay.

    Args:
        vehicle: has the attitude loop's settings.
        plant: the plants of B worlds, for steps of `steps.dt`.
        steps: attitude and physics steps of the period.
        body: the present state.
        action_b: (B, 3) wanted net acceleration in body axes [m/s^2], held for the period.
        heading: (heading_w (B, 3), pos_w (B, 3)) -> the wanted heading an attitude step later.
        noise: (attitude, physics, B, 3) normal draws for random wind, or None.
        yaw_rate: (B,) commanded rate about body z [rad/s]; None: the rate that follows the heading.
    """
    controller, dt = vehicle.controller, steps.dt

    def physics_step(
        carry: tuple[PlantState, Motion, jax.Array], draws: jax.Array | None, command: Command
    ) -> tuple[tuple[PlantState, Motion, jax.Array], None]:
        state, motion, time_s = carry
        state, motion, _ = step(plant, state, motion, Inputs(command, noise=draws), time_s)
        return (state, motion, time_s + dt), None

    def attitude_step(carry: Any, draws: jax.Array | None) -> tuple[Any, None]:
        heading_w, state, motion, time_s = carry
        heading_w = jax.lax.stop_gradient(heading(heading_w, motion.pos_w))
        force_w = action_to_force(action_b, motion.rot_w)
        command = attitude_command(controller, force_w, motion.rot_w, heading_w)
        if yaw_rate is not None:
            command = command._replace(rate_b=command.rate_b.at[:, 2].set(yaw_rate))
        inner, _ = jax.lax.scan(
            lambda c, d: physics_step(c, d, command),
            (state, motion, time_s),
            draws,
            length=steps.physics,
            unroll=min(steps.physics, 2),
        )
        return (heading_w, *inner), None

    motion = Motion(body.pos_w, body.rot_w, body.vel_w, body.rate_b)
    start = (body.heading_w, body.plant, motion, body.time_s)
    (heading_w, state, motion, time_s), _ = jax.lax.scan(
        attitude_step, start, noise, length=steps.attitude
    )
    return QuadrotorState(
        pos_w=motion.pos_w,
        vel_w=motion.vel_w,
        acc_w=(motion.vel_w - body.vel_w) / (steps.attitude * steps.physics * dt),
        rot_w=motion.rot_w,
        rate_b=motion.rate_b,
        heading_w=heading_w,
        plant=state,
        time_s=time_s,
    )


def quadrotor_dynamics(
    config: QuadrotorConfig, period_s: float, gradient_decay: float
) -> tuple[Callable[..., QuadrotorState], Callable[..., QuadrotorState]]:
    """Return the functions `start` and `step` of `suite.train.dynamics.interface.Dynamics`.

    `period_s` is the policy period [s], `gradient_decay` the decay rate of the motion's gradients,
    back in time [1/s].
    """
    steps = substeps(config, period_s)
    decay = float(np.exp(-gradient_decay * period_s))
    attitude_step_s = steps.physics * steps.dt

    def start(
        constants: QuadrotorParams, pos_w: jax.Array, vel_w: jax.Array, heading_w: jax.Array
    ) -> QuadrotorState:
        return start_state(plant_of(config, constants.effects, steps.dt), pos_w, vel_w, heading_w)

    # Checkpointing: the steps within a period are computed again in the backward pass. Storing them
    # would take many times the memory of all periods of a rollout.
    @jax.checkpoint
    def step(
        body: QuadrotorState,
        constants: QuadrotorParams,
        action_b: jax.Array,
        target_w: jax.Array,
        keys: jax.Array,
    ) -> QuadrotorState:
        plant = plant_of(config, constants.effects, steps.dt)
        noise = None
        if uses_noise(plant):
            shape = (steps.attitude, steps.physics, 3)
            # 3 separates these draws from others with the same key.
            gusts = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 3), shape))
            noise = jnp.moveaxis(gusts(keys), 0, 2)

        def heading_to_gate(heading_w: jax.Array, pos_w: jax.Array) -> jax.Array:
            return blend_heading(heading_w, target_w - pos_w, attitude_step_s)

        body = body._replace(
            pos_w=faded(body.pos_w, decay),
            vel_w=faded(body.vel_w, decay),
            rot_w=faded(body.rot_w, decay),
            rate_b=faded(body.rate_b, decay),
        )
        return fly_period(config.vehicle, plant, steps, body, action_b, heading_to_gate, noise)

    return start, step
