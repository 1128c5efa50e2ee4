"""Simulate the quadrotor in continuous time: steps of any length, and updates of the rate loop.

A log gives commands at the times of its rows, and the rate loop runs at another frequency. So steps
end where commands change, and are otherwise as long as accuracy allows. The body moves by the
explicit midpoint rule (order 2; Hairer, Norsett & Wanner 1993, Sec. II.1), with aerodynamic forces
at half a step predicted from the previous step. The rotors' first-order response to commands (lag)
is integrated exactly. For flights that MuJoCo's Euler integrator simulated, the body moves by that
integrator's rule. A plant holds the constants of a quadrotor with its effects.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.effects.interface import Array
from eval.quadrotor import loops
from eval.quadrotor.forces import (
    mass_of,
    rotor_wrench,
    still_thrust,
    wind_and_flow,
    with_push,
    wrench_on,
)
from eval.quadrotor.plant import (
    Command,
    Motion,
    Plant,
    Wrench,
    accelerations,
    euler_move,
    uses_rotor_acc,
)
from eval.quadrotor.rotors import RotorStep, acceleration, follow, steady
from eval.quadrotor.stepper import Inputs, loop_update, prepend_start, wanted_speed
from tracks.geometry.rotation import exp_rot

INTEGRATORS = ("continuous", "euler")
"""How the body moves: by the midpoint rule, or by MuJoCo's semi-implicit Euler rule."""
SHORTEST_S = 1e-9
"""Steps of zero length count as this long [s]; they do not move the body."""


class Steps(NamedTuple):
    """The lengths and loop updates of T steps, arrays (T, ...)."""

    length_s: Array
    """Length of the step [s]; a step of zero length does not move the body."""
    updates: Array
    """Whether the rate loop updates, and the command may change, when the step begins."""
    lead_s: Array
    """Mean delay of the real updates of the loop that this update replaces [s].

    Several updates of a fast loop are merged into one, for which the rates are extrapolated
    linearly by this time.
    """


class Carry(NamedTuple):
    """State of a quadrotor between steps, in addition to its motion."""

    rotor_speed: Array
    """(..., 4) rotor speeds [rad/s]."""
    wanted_speed: Array
    """(..., 4) rotor speeds that the rate loop's last update commanded [rad/s]."""
    turn_b: Array
    """(..., 3) angular acceleration of the last step [rad/s^2]."""
    air: Wrench
    """(..., 3) aerodynamic part of the last step's wrench: total minus rotors in still air."""
    loop: Any = ()
    """State of a firmware's rate loop."""
    since_s: Any = 0.0
    """(...,) time since the last update of a firmware's loop [s]."""


class Flight(NamedTuple):
    """T simulated steps."""

    motion: Motion
    """(T + 1, ...) states: at the start, and after each step."""
    rotor_speed: Array
    """(T + 1, ..., 4) rotor speeds at the same times [rad/s]."""
    acc_b: Array
    """(T, ..., 3) specific force [m/s^2] at the end of each step, or during it (`euler`)."""


def fly(
    plant: Plant,
    motion: Motion,
    steps: Steps,
    inputs: Inputs,
    rotor_speed: Array,
    start_s: Array,
    integrator: str = "continuous",
) -> Flight:
    """Simulate T steps from `motion` in JAX, and return the states after them.

    Args:
        plant: the quadrotor. Its `dt` and `delay_weight` are not used, because the inputs' commands
            are delayed already.
        motion: (...) rigid-body state at the start.
        steps: lengths of the T steps, and where the rate loop updates.
        inputs: (T, ...) inputs of the steps; a command is read where the loop updates.
        rotor_speed: (..., 4) rotor speeds at the start [rad/s].
        start_s: (...,) time of the first step since the start of the flight [s].
        integrator: one of `INTEGRATORS`.
    """
    import jax
    import jax.numpy as jnp

    no_motion = jnp.zeros_like(motion.vel_w)
    no_wrench = Wrench(no_motion, no_motion)
    memory = loops.start(plant.loop, rotor_speed.shape[:-1], jnp)
    start = Carry(rotor_speed, rotor_speed, no_motion, no_wrench, memory)
    if plant.loop is not None:
        start = start._replace(since_s=jnp.zeros(rotor_speed.shape[:-1]))
    # Aerodynamic forces at the start, so that the first step is as accurate as the others.
    first_inputs = jax.tree.map(lambda series: series[0], inputs)._replace(push_b=None)
    rotors = steady(rotor_speed)
    total = _wrench(plant, motion, rotors, first_inputs, start_s)
    start = start._replace(air=_difference(total, _still(plant, rotors)))

    def one_step(carry: Any, row: tuple[Steps, Inputs]) -> tuple[Any, Any]:
        (now, motion, time_s), (span, row_inputs) = carry, row
        now, motion, acc_b = step(plant, now, motion, span, row_inputs, time_s, integrator)
        return (now, motion, time_s + span.length_s), (motion, now.rotor_speed, acc_b)

    _, (motions, speeds, acc_b) = jax.lax.scan(one_step, (start, motion, start_s), (steps, inputs))
    motions, speeds = prepend_start((motion, rotor_speed), (motions, speeds))
    return Flight(motions, speeds, acc_b)


def update_loop(plant: Plant, carry: Carry, span: Steps, command: Command, rate_b: Array) -> Carry:
    """Return `carry` after an update of the rate loop, where the step `span` begins with one.

    `command` (...) is thrust and body rates, `rate_b` (..., 3) the current body rates [rad/s].
    """
    xp = rate_b.__array_namespace__()
    predicted_b = rate_b + span.lead_s[..., None] * carry.turn_b
    if plant.loop is not None:
        return _update_firmware_loop(plant, carry, span, command, predicted_b)
    wanted = wanted_speed(plant, command, predicted_b)
    speed = xp.where(span.updates[..., None], wanted, carry.wanted_speed)
    return carry._replace(wanted_speed=speed)


def _update_firmware_loop(
    plant: Plant, carry: Carry, span: Steps, command: Command, rate_b: Array
) -> Carry:
    """Return `carry` after an update of a firmware's loop.

    Merged updates count as one update after a longer time.
    """
    import jax

    xp = rate_b.__array_namespace__()
    dt = xp.maximum(carry.since_s, plant.dt)
    memory, wanted = loop_update(plant, carry.loop, command, rate_b, dt[..., None])

    def where(new: Array, old: Array) -> Array:
        updates = span.updates.reshape(span.updates.shape + (1,) * (new.ndim - span.updates.ndim))
        return xp.where(updates, new, old)

    return carry._replace(
        wanted_speed=where(wanted, carry.wanted_speed),
        loop=jax.tree.map(where, memory, carry.loop),
        since_s=xp.where(span.updates, 0.0, carry.since_s) + span.length_s,
    )


def turn_rotors(plant: Plant, carry: Carry, span: Steps) -> tuple[Carry, RotorStep]:
    """Return `carry` after the rotors' step `span` towards their commands, and the rotors' step."""
    xp = span.length_s.__array_namespace__()
    length_s = xp.maximum(span.length_s, SHORTEST_S)
    rotors = follow(carry.rotor_speed, carry.wanted_speed, plant.constants.time_constant, length_s)
    return carry._replace(rotor_speed=rotors.end), rotors


def step(
    plant: Plant,
    carry: Carry,
    motion: Motion,
    span: Steps,
    inputs: Inputs,
    time_s: Array,
    integrator: str = "continuous",
) -> tuple[Carry, Motion, Array]:
    """Return carry and motion after one step, and its specific force (..., 3) [m/s^2].

    The arguments are those of `fly`, for one step; `time_s` is the time at its start.
    """
    speed_before, wanted = carry.rotor_speed, None
    length = span.length_s[..., None]
    if inputs.rotor_speed is not None:
        rotors = steady(inputs.rotor_speed)
        carry = carry._replace(rotor_speed=rotors.end)
    else:
        assert inputs.command is not None, "neither a command nor rotor speeds are given"
        carry = update_loop(plant, carry, span, inputs.command, motion.rate_b)
        carry, rotors = turn_rotors(plant, carry, span)
        wanted = carry.wanted_speed
    rotor_acc = None
    if uses_rotor_acc(plant):
        lag = plant.constants.time_constant
        rotor_acc = acceleration(speed_before, rotors, wanted, lag, length)
    if integrator == "euler":
        total = _wrench(plant, motion, rotors, inputs, time_s, rotor_acc)
        acc_w, turn_b = accelerations(plant, motion, total)
        carry = carry._replace(turn_b=turn_b)
        return carry, euler_move(motion, acc_w, turn_b, length), total.force_b / mass_of(plant)
    # Midpoint rule: the state at half a step, from predicted forces, gives the forces of the step.
    thrust = _still(plant, rotors)
    half, air = 0.5 * length, carry.air
    predicted = Wrench(thrust.force_b + air.force_b, thrust.torque_b + air.torque_b)
    middle = _move(motion, *accelerations(plant, motion, predicted), half)
    middle_s = time_s + 0.5 * span.length_s
    total = _wrench(plant, middle, rotors, inputs, middle_s, rotor_acc)
    air = _difference(total, thrust)
    acc_w, turn_b = accelerations(plant, middle, total)
    end = _move(motion, acc_w, turn_b, length)
    # Rotor speeds change within the step; aerodynamic forces hardly change.
    end_thrust = _still(plant, steady(rotors.end))
    acc_b = (end_thrust.force_b + air.force_b) / mass_of(plant)
    return carry._replace(turn_b=turn_b, air=air), end, acc_b


def _still(plant: Plant, rotors: RotorStep) -> Wrench:
    """Return the rotors' force and torque in still air."""
    return rotor_wrench(plant, rotors, still_thrust(plant, rotors))


def _wrench(
    plant: Plant,
    motion: Motion,
    rotors: RotorStep,
    inputs: Inputs,
    time_s: Array,
    rotor_acc: Array | None = None,
) -> Wrench:
    """Return the total force and torque on the body."""
    _, flow = wind_and_flow(plant, {}, motion, rotors, time_s, inputs.noise, inputs.voltage_drop)
    flow = flow._replace(rotor_acc=rotor_acc)
    return with_push(plant, wrench_on(plant, rotors, flow), inputs.push_b)


def _difference(total: Wrench, thrust: Wrench) -> Wrench:
    """Return `total` minus `thrust`."""
    return Wrench(total.force_b - thrust.force_b, total.torque_b - thrust.torque_b)


def _move(motion: Motion, acc_w: Array, turn_b: Array, length: Array) -> Motion:
    """Return the motion after `length` (..., 1) [s] under constant accelerations."""
    rate_b = motion.rate_b + length * turn_b
    rotation = exp_rot(0.5 * length * (motion.rate_b + rate_b))
    xp = rate_b.__array_namespace__()
    return Motion(
        motion.pos_w + length * (motion.vel_w + 0.5 * length * acc_w),
        xp.matmul(motion.rot_w, rotation),
        motion.vel_w + length * acc_w,
        rate_b,
    )
