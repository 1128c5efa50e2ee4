"""Simulate a quadrotor step by step, for numpy and JAX arrays of any leading batch shape.

`plant_step` computes the force and torque on the body from command, delay, rate loop, mixer, rotors
and effects; a simulator passes them to MuJoCo. A plant holds the constants of a quadrotor with its
effects. `step` also moves the rigid body, like MuJoCo's Euler integrator. `rollout` is many steps
in JAX: the differentiable quadrotor. It can be compiled, mapped over flights, and differentiated
with respect to its start, its inputs and the values of all effects, also those of command delay and
rotor time constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import GRAVITY, Array, Flow, Memory
from eval.quadrotor import loops
from eval.quadrotor.forces import mass_of, wind_and_flow, with_push, with_state, wrench_on
from eval.quadrotor.mixer import mix, rate_torque
from eval.quadrotor.plant import (
    Command,
    Motion,
    Plant,
    Wrench,
    accelerations,
    euler_step,
    in_order,
    unpack_command,
    uses_memory,
    uses_rotor_acc,
)
from eval.quadrotor.rotors import delayed, follow, speed_command, steady


class PlantState(NamedTuple):
    """State of a plant between steps."""

    rotor_speed: Array
    """(..., 4) rotor speeds at the start of the step [rad/s]."""
    past_commands: Array
    """(..., 4, L) thrust and rates of the last L steps, newest first; L = 0 without a delay."""
    wind: dict[str, Array]
    """(..., 3) current wind of each effect with random wind, by name [m/s]."""
    loop: Any = ()
    """State of a firmware's rate loop; empty for the nominal one."""
    carried: dict[str, Memory] = {}
    """State of each effect that has one, such as a slung load, by name."""


class Inputs(NamedTuple):
    """Inputs of a quadrotor during one step; (T, ...) for `rollout`'s T steps."""

    command: Command | None = None
    """Thrust and body rates, constant during the step."""
    rotor_speed: Array | None = None
    """(..., 4) measured rotor speeds, constant during the step, instead of a command [rad/s]."""
    noise: Array | None = None
    """(..., 3) normal random numbers for random wind; None for no random wind."""
    voltage_drop: Array | None = None
    """(...,) battery voltage at the start of the flight minus now [V]."""
    push_b: Array | None = None
    """(..., 6) additional acceleration [m/s^2] and angular acceleration [rad/s^2], body axes."""
    speed_cmd: Array | None = None
    """(..., 4) commanded rotor speeds, instead of a command [rad/s]. The command delay and the
    rotors' response act on them."""


class Rollout(NamedTuple):
    """T simulated steps."""

    motion: Motion
    """(T + 1, ...) states: at the start, and after each step."""
    rotor_speed: Array
    """(T + 1, ..., 4) rotor speeds at the same times [rad/s]."""
    acc_b: Array
    """(T, ..., 3) specific force during each step [m/s^2]."""
    state: PlantState
    """(...) the plant's state after the last step, from which a rollout can continue."""


def hover_state(
    plant: Plant, batch_shape: tuple[int, ...], xp: Any = np, noise: Array | None = None
) -> PlantState:
    """Return the state of plants that hovered until now.

    Without `noise` (*batch_shape, 3), normal random numbers, there is no wind at the start. `xp` is
    numpy or jax.numpy.
    """
    zeros = xp.zeros((*batch_shape, 3))
    hover = Command(xp.full(batch_shape, GRAVITY), zeros)
    past_commands = (*batch_shape, 4, plant.delay_weight.shape[-1])
    wind = {}
    for name, value in in_order(plant.effects):
        start = EFFECTS[name].gust
        if start is not None:
            wind[name] = zeros if noise is None else start(value, noise) + zeros
    speed = wanted_speed(plant, hover, zeros)
    memory = loops.start(plant.loop, batch_shape, xp)
    past_commands = xp.broadcast_to(hover.packed[..., None], past_commands)
    return PlantState(speed, past_commands, wind, memory, _carried_in_hover(plant, speed, zeros))


def _carried_in_hover(plant: Plant, rotor_speed: Array, zeros: Array) -> dict[str, Memory]:
    """Return the states of effects that have one, for plants that hovered until now."""
    carried = {}
    if uses_memory(plant):
        level = Motion(zeros, zeros[..., None] + np.eye(3), zeros, zeros)
        rotors = steady(rotor_speed)
        _, flow = wind_and_flow(plant, {}, level, rotors, zeros[..., 0])
        for name, value in in_order(plant.effects):
            start = EFFECTS[name].start
            if start is not None:
                carried[name] = start(value, flow._replace(dt=plant.dt))
    return carried


def wanted_speed(plant: Plant, command: Command, rate_b: Array) -> Array:
    """Return the rotor speeds (..., 4) [rad/s] that rate loop and mixer command.

    For a firmware's loop, which has a state, they are those of its first update. `command` (...) is
    thrust and body rates, `rate_b` (..., 3) the current body rates [rad/s].
    """
    xp = rate_b.__array_namespace__()
    memory = loops.start(plant.loop, rate_b.shape[:-1], xp)
    return loop_update(plant, memory, command, rate_b, plant.dt)[1]


def loop_update(
    plant: Plant, memory: Any, command: Command, rate_b: Array, dt: Array
) -> tuple[Any, Array]:
    """Return the rate loop's state after an update, and the commanded rotor speeds (..., 4).

    Args:
        plant: the plant.
        memory: state of the loop, as `PlantState.loop`.
        command: (...) thrust and body rates, already delayed.
        rate_b: (..., 3) current body rates [rad/s].
        dt: time since the last update [s], a number or (..., 1).
    """
    nominal = plant.nominal
    if plant.loop is not None:
        force_z, scale = nominal.mass * command.thrust, plant.constants.rate_gain
        memory, thrust = loops.update(
            plant.loop, memory, force_z, command.rate_b, rate_b, dt, scale
        )
        return memory, speed_command(thrust, nominal.thrust_coefficient)
    torque_b = rate_torque(command.rate_b, rate_b, plant.constants.rate_gain, nominal.inertia)
    force_z, unequal = nominal.mass * command.thrust, nominal.unequal_arms
    thrust = mix(nominal.unmixer, nominal.thrust_max, force_z, torque_b, unequal)
    return memory, speed_command(thrust, nominal.thrust_coefficient)


def rotor_command(
    plant: Plant, state: PlantState, command: Any, rate_b: Array, speed_cmd: Array | None = None
) -> tuple[PlantState, Array]:
    """Return the state after an update of the rate loop, and the commanded rotor speeds (..., 4).

    `command` (...) is thrust and body rates; commanded speeds `speed_cmd` (..., 4) [rad/s] bypass
    the rate loop. `rate_b` (..., 3) are current body rates [rad/s].
    """
    if plant.delay_weight.shape[-1] > 0:
        newest = command.packed if speed_cmd is None else speed_cmd
        past, acting = delayed(plant.delay_weight, state.past_commands, newest)
        state, command = state._replace(past_commands=past), unpack_command(acting)
        speed_cmd = None if speed_cmd is None else acting
    if speed_cmd is not None:
        return state, speed_cmd
    memory, wanted = loop_update(plant, state.loop, command, rate_b, plant.dt)
    return state._replace(loop=memory), wanted


def plant_step(
    plant: Plant, state: PlantState, motion: Motion, inputs: Inputs, time_s: Array | float
) -> tuple[PlantState, Wrench]:
    """Return the state after one step of `plant.dt`, and the constant wrench during it.

    Args:
        plant: the plant.
        state: from `hover_state` or the step before.
        motion: rigid-body state at the start of the step.
        inputs: a command or measured rotor speeds, voltage, wind and pushes.
        time_s: (...,) time since the start of the flight [s].
    """
    speed_before = state.rotor_speed
    if inputs.rotor_speed is not None:
        rotors = steady(inputs.rotor_speed)
    else:
        state, wanted = rotor_command(plant, state, inputs.command, motion.rate_b, inputs.speed_cmd)
        rotors = follow(speed_before, wanted, plant.constants.time_constant, plant.dt)
    winds, flow = wind_and_flow(
        plant, state.wind, motion, rotors, time_s, inputs.noise, inputs.voltage_drop
    )
    if uses_rotor_acc(plant):
        flow = flow._replace(rotor_acc=(rotors.end - speed_before) / plant.dt)
    wrench = with_push(plant, wrench_on(plant, rotors, flow, state.carried), inputs.push_b)
    carried = _next_states(plant, state.carried, motion, flow, wrench)
    return state._replace(rotor_speed=rotors.end, wind=winds, carried=carried), wrench


def step(
    plant: Plant, state: PlantState, motion: Motion, inputs: Inputs, time_s: Array | float
) -> tuple[PlantState, Motion, Wrench]:
    """Return the state and the motion of a free body after one step, and the wrench during it.

    The arguments are those of `plant_step`.
    """
    state, wrench = plant_step(plant, state, motion, inputs, time_s)
    return state, euler_step(plant, motion, wrench), wrench


def rollout(
    plant: Plant,
    motion: Motion,
    inputs: Inputs,
    state: PlantState | None = None,
    start_s: Array | float = 0.0,
) -> Rollout:
    """Simulate T steps from `motion` in JAX, and return the states after them.

    Args:
        plant: the plant.
        motion: (...) rigid-body state at the start.
        inputs: (T, ...) inputs of the steps.
        state: (...) plant's state at the start; None: that of a hover.
        start_s: (...,) time since the start of the flight at the first step [s].
    """
    import jax
    import jax.numpy as jnp

    start = hover_state(plant, motion.pos_w.shape[:-1], jnp) if state is None else state
    start, motion = jax.tree.map(jnp.asarray, (start, motion))
    steps = jnp.arange(len(jax.tree.leaves(inputs)[0]))

    def one_step(carry: Any, row: tuple[Array, Inputs]) -> tuple[Any, Any]:
        (state, motion), (index, row_inputs) = carry, row
        state, motion, wrench = step(plant, state, motion, row_inputs, start_s + index * plant.dt)
        return (state, motion), (motion, state.rotor_speed, wrench.force_b / mass_of(plant))

    (last, _), (motions, speeds, acc_b) = jax.lax.scan(one_step, (start, motion), (steps, inputs))
    motions, speeds = prepend_start((motion, start.rotor_speed), (motions, speeds))
    return Rollout(motions, speeds, acc_b, last)


def prepend_start(start: Any, following: Any) -> Any:
    """Return values at the start (...) and T following values as one pytree of (T + 1, ...)."""
    import jax
    import jax.numpy as jnp

    return jax.tree.map(lambda first, then: jnp.concatenate([first[None], then]), start, following)


def _next_states(
    plant: Plant, carried: Mapping[str, Memory], motion: Motion, flow: Flow, wrench: Wrench
) -> dict[str, Memory]:
    """Return the states of effects that have one, after a step under `wrench`."""
    after = {}
    if uses_memory(plant):
        acc_w, _ = accelerations(plant, motion, wrench)
        for name, value in in_order(plant.effects):
            carry = EFFECTS[name].carry
            if carry is not None:
                after[name] = carry(value, with_state(plant, name, flow, carried), acc_w)
    return after
