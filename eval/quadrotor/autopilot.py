"""From a policy's action to the wrench on the body: one physics step of what flies the vehicle.

The attitude loop gives a new command every `attitude_every` steps; the plant (rate loop, mixer,
rotors, effects) runs at every one. Pure, for numpy and JAX, over N vehicles at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.plant import (
    Command,
    Motion,
    Plant,
    Wrench,
    make_plant,
    plant_step,
    start_memory,
)
from eval.vehicles.vehicle import Controller, Vehicle
from tracks.common.tree_rows import packed, select
from tracks.geometry.scene import Array

ATTITUDE_HZ = 100.0
"""Frequency of the attitude loop and of flight logs [Hz]."""


@dataclass(frozen=True)
class Cockpit:
    """Everything that stays the same while a vehicle flies."""

    plant: Plant
    controller: Controller
    dt: float
    """Length of a physics step [s]."""
    attitude_every: int
    """Physics steps a command of the attitude loop holds."""


class Autopilot(NamedTuple):
    """What the loops of N vehicles remember."""

    memory: Any
    """The plant's (N, ...)."""
    command: Command
    """Held between steps of the attitude loop."""
    heading_w: Array
    """(N, 3) wanted heading, horizontal unit vectors."""


def make_cockpit(vehicle: Vehicle) -> Cockpit:
    """Return what flies `vehicle`, at its rate loop's frequency."""
    dt = 1.0 / vehicle.controller.frequency
    every = max(1, round(vehicle.controller.frequency / ATTITUDE_HZ))
    return Cockpit(make_plant(vehicle, dt), vehicle.controller, dt, every)


def start_autopilot(cockpit: Cockpit, motion: Motion, noise: Array | None = None) -> Autopilot:
    """Return the loops of N vehicles that hovered until now, heading as their body x does.

    Args:
        cockpit: from `make_cockpit`.
        motion: (N, ...) at the start.
        noise: (N, 3) normal draws for the wind at the start, or None.
    """
    xp = motion.pos_w.__array_namespace__()
    n = motion.pos_w.shape[0]
    memory = start_memory(cockpit.plant, (n,), xp, noise)
    hover = Command(xp.full((n,), GRAVITY), xp.zeros((n, 3)))
    return packed(Autopilot(memory, hover, level_heading(motion.rot_w)))


def fly_step(
    cockpit: Cockpit,
    pilot: Autopilot,
    motion: Motion,
    action_b: Array,
    gate_w: Array,
    step: Array,
    noise: Array | None = None,
) -> tuple[Autopilot, Wrench]:
    """Return the loops after a physics step and the wrench to hold during it.

    Args:
        cockpit: from `make_cockpit`.
        pilot: from `start_autopilot` or the step before.
        motion: (N, ...) at the start of the step.
        action_b: (N, 3) the policy's [m/s^2].
        gate_w: (N, 3) centre of the next gate, which the heading follows [m].
        step: (N,) physics steps flown; the attitude loop runs at multiples of `attitude_every`.
        noise: (N, 3) normal draws for random wind, or None.
    """
    due = step % cockpit.attitude_every == 0
    period = cockpit.attitude_every * cockpit.dt
    heading_w = blend_heading(pilot.heading_w, gate_w - motion.pos_w, period)
    force_w = action_to_force(action_b, motion.rot_w)
    command = attitude_command(cockpit.controller, force_w, motion.rot_w, heading_w)
    command = select(due, command, pilot.command)
    heading_w = select(due, heading_w, pilot.heading_w)
    memory, wrench = plant_step(
        cockpit.plant, pilot.memory, motion, command, step * cockpit.dt, noise
    )
    return packed(Autopilot(memory, command, heading_w)), wrench
