"""One physics step of all control loops: from a policy's action to force and torque on the body.

The attitude loop computes a new command every `attitude_every` steps. The plant (rate loop, mixer,
rotors and the vehicle's effects) runs at every step. All functions are pure, take numpy and JAX
arrays, and step N vehicles at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.plant import Command, Motion, Plant, Wrench, make_plant, unpack_command
from eval.quadrotor.stepper import Inputs, PlantState, hover_state, plant_step
from eval.vehicles.vehicle import Controller, Vehicle
from policies.spec import ActionSpec
from tracks.common.masks import make_contiguous, nowhere, select
from tracks.geometry.scene import Array

ATTITUDE_HZ = 100.0
"""Frequency of the attitude loop and of flight logs, rounded to whole physics steps [Hz]."""


@dataclass(frozen=True)
class Autopilot:
    """The control loops and their plant: the constants of a flight."""

    plant: Plant
    controller: Controller
    dt: float
    """Length of a physics step [s]."""
    attitude_every: int
    """Number of physics steps for which a command of the attitude loop is held."""
    action: ActionSpec = field(default_factory=ActionSpec)
    """The policy's kind of action. An acceleration is the input of the attitude loop; thrust and
    body rates are the input of the rate loop; motor commands bypass both."""
    speed_max: float = 0.0
    """Largest commanded speed of a rotor [rad/s]."""


class AutopilotState(NamedTuple):
    """State of N vehicles' loops between steps."""

    plant: PlantState
    """(N, ...) state of rate loop, rotors and effects."""
    command: Command
    """Current output of the attitude loop."""
    heading_w: Array
    """(N, 3) wanted heading, horizontal unit vectors."""


def make_autopilot(vehicle: Vehicle, action: ActionSpec | None = None) -> Autopilot:
    """Return the loops of `vehicle` for a kind of action, at its rate loop's frequency."""
    dt = 1.0 / vehicle.controller.frequency
    every = max(1, round(vehicle.controller.frequency / ATTITUDE_HZ))
    plant, speed_max = make_plant(vehicle, dt), vehicle.rotors.speed_max
    return Autopilot(plant, vehicle.controller, dt, every, action or ActionSpec(), speed_max)


def start_autopilot(
    autopilot: Autopilot, motion: Motion, noise: Array | None = None
) -> AutopilotState:
    """Return the state of N vehicles that hovered until now, with headings along their x axes.

    `motion` (N, ...) is the rigid-body state; `noise` (N, 3) are normal random numbers for the
    wind.
    """
    xp = motion.pos_w.__array_namespace__()
    n = motion.pos_w.shape[0]
    plant = hover_state(autopilot.plant, (n,), xp, noise)
    hover = Command(xp.full((n,), GRAVITY), xp.zeros((n, 3)))
    if autopilot.action.kind == "motors":
        # The command delay then stores rotor speeds instead of thrust and rates.
        past = xp.zeros_like(plant.past_commands) + plant.rotor_speed[..., None]
        plant = plant._replace(past_commands=past)
    return make_contiguous(AutopilotState(plant, hover, level_heading(motion.rot_w)))


def autopilot_step(
    autopilot: Autopilot,
    state: AutopilotState,
    motion: Motion,
    action_b: Array,
    gate_w: Array,
    step: Array,
    noise: Array | None = None,
) -> tuple[AutopilotState, Wrench]:
    """Return the state after a physics step, and the force and torque to hold during it.

    Args:
        autopilot: from `make_autopilot`.
        state: from `start_autopilot` or the step before.
        motion: (N, ...) rigid-body state at the start of the step.
        action_b: (N, size) the policy's action in SI units, within its limits.
        gate_w: (N, 3) centre of the next gate, towards which the heading turns [m].
        step: (N,) number of the physics step; the attitude loop runs at multiples of
            `attitude_every`.
        noise: (N, 3) normal random numbers for random wind, or None.
    """
    state = attitude_step(autopilot, state, motion, action_b, gate_w, step)
    inputs = Inputs(state.command, noise=noise, speed_cmd=motor_speed_command(autopilot, action_b))
    plant, wrench = plant_step(autopilot.plant, state.plant, motion, inputs, step * autopilot.dt)
    return make_contiguous(state._replace(plant=plant)), wrench


def attitude_step(
    autopilot: Autopilot,
    state: AutopilotState,
    motion: Motion,
    action_b: Array,
    gate_w: Array,
    step: Array,
) -> AutopilotState:
    """Return the state after a step of the attitude loop; between its steps the command is held.

    The arguments are those of `autopilot_step`; the plant's state is unchanged. An action of thrust
    and body rates becomes the command at every step. For motor commands the command is NaN.
    """
    if autopilot.action.kind == "ctbr":
        return state._replace(command=unpack_command(action_b))
    if autopilot.action.kind == "motors":
        return state._replace(command=unpack_command(action_b * float("nan")))
    due = step % autopilot.attitude_every == 0
    if nowhere(due):
        return state  # at most steps the command is held
    period = autopilot.attitude_every * autopilot.dt
    heading_w = blend_heading(state.heading_w, gate_w - motion.pos_w, period)
    force_w = action_to_force(action_b, motion.rot_w)
    command = attitude_command(autopilot.controller, force_w, motion.rot_w, heading_w)
    command = select(due, command, state.command)
    return AutopilotState(state.plant, command, select(due, heading_w, state.heading_w))


def has_new_command(
    autopilot: Autopilot, before: AutopilotState, after: AutopilotState, step: Array
) -> Array:
    """Return whether a physics step may begin with a new command (N,), for rows of flight logs.

    The attitude loop computes commands at its own steps. A policy of kind `ctbr` may change thrust
    and body rates at any step. `before` and `after` are the states around `attitude_step`.
    """
    due = step % autopilot.attitude_every == 0
    if autopilot.action.kind != "ctbr":
        return due
    return due | (after.command.packed != before.command.packed).any(-1)


def motor_speed_command(autopilot: Autopilot, action: Array) -> Array | None:
    """Return the rotor speeds (N, 4) of motor commands [rad/s]; None for other actions."""
    if autopilot.action.kind != "motors":
        return None
    xp = action.__array_namespace__()
    return autopilot.speed_max * (action if autopilot.action.motors == "speed" else xp.sqrt(action))
