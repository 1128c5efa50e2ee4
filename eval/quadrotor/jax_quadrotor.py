"""The differentiable quadrotor: plant and rigid body rolled out in JAX.

A rollout can be compiled, mapped over flights and differentiated with respect to the state it
starts from, its commands, and the values of every effect of its plant, delay and lag included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from eval.effects import all_values
from eval.quadrotor.plant import (
    Command,
    Memory,
    Motion,
    Plant,
    make_plant,
    plant_step,
    start_memory,
)
from eval.quadrotor.rigid_body import euler_step
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.scene import Array

MAX_DELAY = 0.1
"""Room for a command delay that is fitted [s]; the upper bound of `command_delay`."""


class Rollout(NamedTuple):
    """A flown stretch of T steps."""

    motion: Motion
    """(T + 1, ...): the start and the state after each step."""
    rotor_speed: Array
    """(T + 1, ..., 4) [rad/s]."""
    memory: Memory
    """(...) after the last step, to fly on from."""


def fit_plant(vehicle: Vehicle, effects: Mapping[str, Any], dt: float | None = None) -> Plant:
    """Return a plant that holds every effect of the catalogue at once.

    Args:
        vehicle: its nominal values, and the effects that it has already.
        effects: values to use in their place, by name; may be traced.
        dt: length of a step [s]; 1 / controller.frequency if not given.
    """
    values = {**all_values(vehicle), **effects}
    return make_plant(vehicle, dt or 1.0 / vehicle.controller.frequency, values, MAX_DELAY)


def rollout(
    plant: Plant,
    motion: Motion,
    commands: Command,
    memory: Memory | None = None,
    start_s: Array | float = 0.0,
    noise: Array | None = None,
    voltage_drop: Array | None = None,
) -> Rollout:
    """Fly `commands` from `motion`, one a step of `plant.dt`.

    Args:
        plant: from `make_plant` or `fit_plant`.
        motion: (...) at the start.
        commands: (T, ...) held during each step; see `hold`.
        memory: (...) at the start; rotors and commands of a hover if not given.
        start_s: time since the start of the flight at the first step [s].
        noise: (T, ..., 3) normal draws for random wind, or None.
        voltage_drop: (T, ...) [V], or None.
    """
    motion = Motion(*(jnp.asarray(field) for field in motion))
    if memory is None:
        memory = start_memory(plant, motion.pos_w.shape[:-1], jnp)
    start: Memory = jax.tree.map(jnp.asarray, memory)

    def step(carry: Any, inputs: Any) -> tuple[Any, Any]:
        memory, motion = carry
        index, command, draws, drop = inputs
        time_s = start_s + index * plant.dt
        memory, wrench = plant_step(plant, memory, motion, command, time_s, draws, drop)
        motion = euler_step(plant, motion, wrench)
        return (memory, motion), (motion, memory.rotor_speed)

    steps = jnp.arange(commands.thrust.shape[0])
    (last, _), (motions, speeds) = jax.lax.scan(
        step, (start, motion), (steps, commands, noise, voltage_drop)
    )
    motions, speeds = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]),
        (motion, start.rotor_speed),
        (motions, speeds),
    )
    return Rollout(motions, speeds, last)


def hold(commands: Command, steps: int) -> Command:
    """Return commands (T, ...) each held for `steps` physics steps, (T * steps, ...)."""
    return Command(*(jnp.repeat(jnp.asarray(field), steps, axis=0) for field in commands))
