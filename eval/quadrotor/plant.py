"""The `Plant`: the constants of a quadrotor and of all effects of its vehicle, as arrays.

A `Plant` is a pytree of numpy or JAX arrays with any leading batch shape, so it can be built from
traced values inside a differentiated function. `eval.quadrotor.stepper` simulates it. This file
also has the equations of the rigid body, with a step like that of MuJoCo's Euler integrator.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import GRAVITY, Array, Constants, as_arrays
from eval.quadrotor.loops import NOMINAL, Loop, loop_of
from eval.quadrotor.mixer import mixer_matrix, unequal_arms
from eval.quadrotor.rotors import delay_weight
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.rotation import cross, exp_rot, to_world

MAX_DELAY = 0.1
"""Longest command delay that can be fitted [s]; the upper bound of the effect `command_delay`."""


class Command(NamedTuple):
    """Collective thrust and body rates (CTBR)."""

    thrust: Array
    """(...,) collective thrust along body z per nominal mass [m/s^2]."""
    rate_b: Array
    """(..., 3) body rates [rad/s]."""

    @property
    def packed(self) -> Array:
        """Thrust and rates as one array (..., 4)."""
        xp = self.rate_b.__array_namespace__()
        return xp.concatenate([self.thrust[..., None], self.rate_b], axis=-1)


def unpack_command(command: Array) -> Command:
    """Return the `Command` for an array (..., 4) of thrust and rates."""
    return Command(command[..., 0], command[..., 1:])


class Motion(NamedTuple):
    """A rigid body's state at its centre of mass."""

    pos_w: Array
    """(..., 3) position [m]."""
    rot_w: Array
    """(..., 3, 3) attitude, body to world."""
    vel_w: Array
    """(..., 3) velocity [m/s]."""
    rate_b: Array
    """(..., 3) body rates [rad/s]."""


class Wrench(NamedTuple):
    """Force and torque on the rigid body, without gravity and its own gyroscopic terms."""

    force_b: Array
    """(..., 3) force on the centre of mass [N]."""
    torque_b: Array
    """(..., 3) torque about the centre of mass [N m]."""


class Nominal(NamedTuple):
    """The nominal constants, which the controller uses."""

    mass: Array
    """Mass [kg]."""
    inertia: Array
    """(3,) principal moments of inertia, body axes [kg m^2]."""
    unmixer: Array
    """(4, 4) matrix from (force along z, torque) to rotor thrusts."""
    thrust_max: Array
    """Largest thrust of one rotor [N]."""
    thrust_coefficient: Array
    """k_T: thrust of a rotor over its squared speed [N/(rad/s)^2]."""
    spin: Array
    """(4,) s_i: +1 for a rotor turning counter-clockwise seen from above, -1 clockwise."""
    unequal_arms: Array | None = None
    """(4,) shares of the rotors in a collective thrust; None if they are equal."""


class Plant(NamedTuple):
    """A vehicle with its effects, prepared for steps of one length."""

    nominal: Nominal
    constants: Constants
    """The true constants, with every effect applied; a simulator uses mass, inertia, gravity_w and
    com_offset_b."""
    effects: dict[str, Any]
    """Values of all effects, as arrays, by name."""
    delay_weight: Array
    """(..., L) weights of the last L commands in the delayed command; L = 0 without a delay."""
    dt: Array
    """Length of a step [s]."""
    loop: Loop | None = None
    """A firmware's rate loop; None for the nominal one."""


def make_plant(
    vehicle: Vehicle,
    dt: float,
    effects: Mapping[str, Any] | None = None,
    max_delay: float | None = None,
) -> Plant:
    """Return the plant of `vehicle` for steps of `dt` [s].

    Args:
        vehicle: the vehicle file, with the nominal values.
        dt: length of a step, 1 / controller.frequency [s].
        effects: values by name that replace `vehicle.effects`; they may be traced JAX arrays, and
            have leading batch axes (one vehicle for each trial).
        max_delay: longest delay for which commands are stored [s]; required for a traced delay,
            otherwise the delay itself.

    Raises:
        ValueError: for an effect that is not in the catalogue.
    """
    effects = dict(vehicle.effects) if effects is None else effects
    values = {EFFECTS.find(name).name: as_arrays(value) for name, value in effects.items()}
    return assemble(*nominal_quadrotor(vehicle), values, dt, max_delay, loop_of(vehicle))


def fit_plant(vehicle: Vehicle, effects: Mapping[str, Any], dt: float | None = None) -> Plant:
    """Return a plant with all effects of the catalogue at once, to fit any of them.

    Effects that neither `vehicle` nor `effects` list are neutral (without influence). `effects`
    replace those of the file and may be traced JAX arrays. A step of `dt` [s] is 1 /
    controller.frequency if not given.
    """
    values = {**all_values(vehicle), **effects}
    return make_plant(vehicle, dt or 1.0 / vehicle.controller.frequency, values, MAX_DELAY)


def nominal_quadrotor(vehicle: Vehicle) -> tuple[Nominal, Constants]:
    """Return the controller's nominal constants, and the constants without any effect."""
    rotors = vehicle.rotors
    constants = Constants(
        mass=np.asarray(vehicle.mass),
        inertia=np.asarray(vehicle.inertia),
        gravity_w=np.array([0.0, 0.0, -GRAVITY]),
        com_offset_b=np.zeros(3),
        rotor_position_b=np.asarray(rotors.position),
        thrust_coefficient=np.full(4, rotors.thrust_coefficient),
        torque_coefficient=np.full(4, rotors.torque_coefficient),
        thrust_axis_b=np.array([0.0, 0.0, 1.0]),
        time_constant=np.asarray(rotors.time_constant),
        # The gains of a firmware's loop are not in 1/s; a factor of 1 on its output is used.
        rate_gain=np.asarray(vehicle.controller.rate_gain)
        if vehicle.controller.kind == NOMINAL
        else np.ones(3),
        delay=np.asarray(0.0),
    )
    unmixer = np.linalg.inv(
        mixer_matrix(
            rotors.position, rotors.spin, rotors.torque_coefficient / rotors.thrust_coefficient
        )
    )
    nominal = Nominal(
        mass=np.asarray(vehicle.mass),
        inertia=np.asarray(vehicle.inertia),
        unmixer=unmixer,
        thrust_max=np.asarray(rotors.thrust_max),
        thrust_coefficient=np.asarray(rotors.thrust_coefficient),
        spin=np.asarray(rotors.spin, dtype=float),
        unequal_arms=unequal_arms(unmixer),
    )
    return nominal, constants


def assemble(
    nominal: Nominal,
    constants: Constants,
    values: Mapping[str, Any],
    dt: float,
    max_delay: float | None = None,
    loop: Loop | None = None,
) -> Plant:
    """Return the plant of a `nominal_quadrotor` with effects; every array may be traced.

    Args:
        nominal: the controller's constants.
        constants: the constants without effects.
        values: values of the effects by name, as arrays.
        dt: length of a step [s].
        max_delay: as for `make_plant`.
        loop: a firmware's rate loop, if the vehicle has one.
    """
    for name, value in in_order(values):
        change = EFFECTS[name].constants
        constants = constants if change is None else change(value, constants)
    if max_delay is None:
        max_delay = float(np.max(constants.delay))
    weight = delay_weight(constants.delay, dt, max_delay)
    return Plant(nominal, constants, dict(values), weight, np.asarray(dt), loop)


def uses_noise(plant: Plant) -> bool:
    """Return whether an effect of `plant` needs random numbers at every step."""
    return any(EFFECTS[name].gust is not None for name in plant.effects)


def uses_rotor_acc(plant: Plant) -> bool:
    """Return whether an effect of `plant` depends on the change of the rotor speeds."""
    return any(EFFECTS[name].rotor_acc for name in plant.effects)


def uses_memory(plant: Plant) -> bool:
    """Return whether an effect of `plant` has a state."""
    return any(EFFECTS[name].start is not None for name in plant.effects)


def in_order(effects: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return (name, values) in the catalogue's order, in which effects act (JAX sorts dicts)."""
    return [(name, effects[name]) for name in EFFECTS if name in effects]


def accelerations(plant: Plant, motion: Motion, wrench: Wrench) -> tuple[Array, Array]:
    """Return the accelerations of the rigid body by the Newton-Euler equations.

    Returns:
        dv/dt in world axes (..., 3) [m/s^2] and dw/dt in body axes (..., 3) [rad/s^2].
    """
    constants = plant.constants
    force_w = to_world(motion.rot_w, wrench.force_b)
    momentum_b = constants.inertia * motion.rate_b
    torque_b = wrench.torque_b - cross(motion.rate_b, momentum_b)
    return force_w / constants.mass[..., None] + constants.gravity_w, torque_b / constants.inertia


def euler_step(plant: Plant, motion: Motion, wrench: Wrench) -> Motion:
    """Return the motion after `plant.dt` under a constant wrench, by `euler_move`."""
    return euler_move(motion, *accelerations(plant, motion, wrench), plant.dt)


def euler_move(motion: Motion, acc_w: Array, turn_b: Array, dt: Array) -> Motion:
    """Return the motion after `dt` (..., 1) [s] under accelerations (semi-implicit Euler, order 1).

    The velocities are stepped first. The new velocities move position and attitude; the attitude
    turns by the exact rotation of the new body rate.
    """
    xp = motion.rot_w.__array_namespace__()
    vel_w = motion.vel_w + dt * acc_w
    rate_b = motion.rate_b + dt * turn_b
    rot_w = xp.matmul(motion.rot_w, exp_rot(dt * rate_b))
    return Motion(motion.pos_w + dt * vel_w, rot_w, vel_w, rate_b)
