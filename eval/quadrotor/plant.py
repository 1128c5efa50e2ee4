"""The quadrotor without its rigid body: a command goes in, force and torque come out.

One step is the nominal quadrotor (rate loop, mixer, rotors) with every effect of its vehicle.
All functions take numpy or JAX arrays with any leading batch shape; a `Plant` is a pytree of
arrays, so that it can be built inside a differentiated function.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS, find_effect
from eval.effects.interface import GRAVITY, Array, Constants, Flow, Gust, as_arrays
from eval.quadrotor.mixer import mix, mixer_matrix
from eval.quadrotor.rate_loop import rate_torque
from eval.quadrotor.rotors import Spin, follow, speed_command
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.rotation import to_local


class Command(NamedTuple):
    """Collective thrust and body rates (CTBR)."""

    thrust: Array
    """(...,) along body z per nominal mass [m/s^2]."""
    rate_b: Array
    """(..., 3) [rad/s]."""


class Motion(NamedTuple):
    """A rigid body's state at its centre of mass."""

    pos_w: Array
    """(..., 3) [m]."""
    rot_w: Array
    """(..., 3, 3) body to world."""
    vel_w: Array
    """(..., 3) [m/s]."""
    rate_b: Array
    """(..., 3) [rad/s]."""


class Wrench(NamedTuple):
    """What acts on the rigid body besides gravity and its own gyroscopic terms."""

    force_b: Array
    """(..., 3) on the centre of mass [N]."""
    torque_b: Array
    """(..., 3) about the centre of mass [N m]."""


class Memory(NamedTuple):
    """What a plant remembers from step to step."""

    rotor_speed: Array
    """(..., 4) at the start of the step [rad/s]."""
    command: Array
    """(..., 4, L) thrust and rates of the last L steps, newest first; L = 0 without a delay."""
    wind: dict[str, Array]
    """(..., 3) of each effect that makes random wind [m/s]."""


class Nominal(NamedTuple):
    """What the controller believes."""

    mass: Array
    """[kg]."""
    inertia: Array
    """(3,) [kg m^2]."""
    unmixer: Array
    """(4, 4) from (force, torque) to rotor thrusts."""
    thrust_max: Array
    """Of one rotor [N]."""
    thrust_coefficient: Array
    """k_T [N/(rad/s)^2]."""
    spin: Array
    """(4,) s_i."""


class Plant(NamedTuple):
    """A vehicle with its effects, prepared for steps of one length."""

    nominal: Nominal
    constants: Constants
    """The true ones, with every effect that changes one; a world needs mass, inertia, gravity_w
    and com_offset_b."""
    effects: dict[str, Any]
    """Values of all effects, as arrays, by name."""
    delay_weight: Array
    """(..., L) share of each remembered command in the one that acts; L = 0 without a delay."""
    dt: Array
    """Length of a step [s]."""


def make_plant(
    vehicle: Vehicle,
    dt: float,
    effects: Mapping[str, Any] | None = None,
    max_delay: float | None = None,
) -> Plant:
    """Return the plant of `vehicle` for steps of `dt` [s].

    Args:
        vehicle: what it is; its nominal values are constants.
        dt: 1 / controller.frequency.
        effects: values in place of `vehicle.effects`, by name; traced JAX arrays may be among
            them, also with leading batch axes (one vehicle a trial).
        max_delay: room to remember commands [s]; needed where a delay is traced, otherwise
            exactly what the delay needs.

    Raises:
        ValueError: for an effect that is not in the catalogue.
    """
    given = dict(vehicle.effects) if effects is None else effects
    values = {find_effect(name).name: as_arrays(value) for name, value in given.items()}
    return assemble(*nominal_quadrotor(vehicle), values, dt, max_delay)


def nominal_quadrotor(vehicle: Vehicle) -> tuple[Nominal, Constants]:
    """Return what the controller believes of `vehicle`, and its constants without any effect."""
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
        rate_gain=np.asarray(vehicle.controller.rate_gain),
        delay=np.asarray(0.0),
    )
    nominal = Nominal(
        mass=np.asarray(vehicle.mass),
        inertia=np.asarray(vehicle.inertia),
        unmixer=np.linalg.inv(
            mixer_matrix(
                rotors.position, rotors.spin, rotors.torque_coefficient / rotors.thrust_coefficient
            )
        ),
        thrust_max=np.asarray(rotors.thrust_max),
        thrust_coefficient=np.asarray(rotors.thrust_coefficient),
        spin=np.asarray(rotors.spin, dtype=float),
    )
    return nominal, constants


def assemble(
    nominal: Nominal,
    constants: Constants,
    values: Mapping[str, Any],
    dt: float,
    max_delay: float | None = None,
) -> Plant:
    """Return the plant of a nominal quadrotor with effects; every array may be traced.

    Args:
        nominal: from `nominal_quadrotor`.
        constants: the same.
        values: of effects, as arrays, by name.
        dt: length of a step [s].
        max_delay: as `make_plant` has it.
    """
    for name, value in _in_order(values):
        change = EFFECTS[name].constants
        constants = constants if change is None else change(value, constants)
    if max_delay is None:
        max_delay = float(np.max(constants.delay))
    weight = _delay_weight(constants.delay, dt, max_delay)
    return Plant(nominal, constants, dict(values), weight, np.asarray(dt))


def start_memory(
    plant: Plant,
    batch_shape: tuple[int, ...],
    xp: Any = np,
    noise: Array | None = None,
) -> Memory:
    """Return the memory of plants that hovered until now.

    Args:
        plant: the plant.
        batch_shape: leading shape of the states that will be flown.
        xp: numpy or jax.numpy.
        noise: (*batch_shape, 3) normal draws for the random wind at the start; without them it
            starts from none.
    """
    hover = Command(xp.full(batch_shape, GRAVITY), xp.zeros((*batch_shape, 3)))
    speed = wanted_speed(plant, hover, xp.zeros((*batch_shape, 3)))
    packed = xp.concatenate([hover.thrust[..., None], hover.rate_b], axis=-1)
    length = plant.delay_weight.shape[-1]
    command = xp.broadcast_to(packed[..., None], (*batch_shape, 4, length))
    still = xp.zeros((*batch_shape, 3))
    wind = {}
    for name, value in _in_order(plant.effects):
        start = EFFECTS[name].gust
        if start is not None:
            wind[name] = still if noise is None else start(value, noise) + still
    return Memory(speed, command, wind)


def uses_noise(plant: Plant) -> bool:
    """Return whether an effect of `plant` needs normal draws at every step."""
    return any(EFFECTS[name].gust is not None for name in plant.effects)


def plant_step(
    plant: Plant,
    memory: Memory,
    motion: Motion,
    command: Command,
    time_s: Array,
    noise: Array | None = None,
    voltage_drop: Array | None = None,
) -> tuple[Memory, Wrench]:
    """Return the memory after one step of `plant.dt` and the wrench to hold during it.

    Args:
        plant: the plant.
        memory: from `start_memory` or the step before.
        motion: at the start of the step.
        command: held during the step.
        time_s: (...,) since the start of the flight [s].
        noise: (..., 3) normal draws for random wind; without them there is none.
        voltage_drop: (...,) battery voltage at the start of the flight minus now [V].
    """
    memory, command = delayed(plant, memory, command)
    wanted = wanted_speed(plant, command, motion.rate_b)
    spin = follow(memory.rotor_speed, wanted, plant.constants.time_constant, plant.dt)
    memory = memory._replace(rotor_speed=spin.end)
    return spin_step(plant, memory, motion, spin, time_s, noise, voltage_drop)


def delayed(plant: Plant, memory: Memory, command: Command) -> tuple[Memory, Command]:
    """Return the memory that has `command`, and the mean of the command that acts in this step.

    A delay that is no multiple of the step gives the mean of the two commands that share the
    step, so that it can be fitted by gradients.
    """
    if plant.delay_weight.shape[-1] == 0:
        return memory, command
    xp = command.rate_b.__array_namespace__()
    packed = xp.concatenate([command.thrust[..., None], command.rate_b], axis=-1)
    history = xp.concatenate([packed[..., None], memory.command[..., :-1]], axis=-1)
    acting = xp.matmul(history, xp.asarray(plant.delay_weight)[..., :, None])[..., 0]
    return memory._replace(command=history), Command(acting[..., 0], acting[..., 1:])


def wanted_speed(plant: Plant, command: Command, rate_b: Array) -> Array:
    """Return the rotor speeds (..., 4) [rad/s] that the rate loop and the mixer ask for."""
    nominal = plant.nominal
    torque_b = rate_torque(command.rate_b, rate_b, plant.constants.rate_gain, nominal.inertia)
    thrust = mix(nominal.unmixer, nominal.thrust_max, nominal.mass * command.thrust, torque_b)
    return speed_command(thrust, nominal.thrust_coefficient)


def spin_step(
    plant: Plant,
    memory: Memory,
    motion: Motion,
    spin: Spin,
    time_s: Array,
    noise: Array | None = None,
    voltage_drop: Array | None = None,
) -> tuple[Memory, Wrench]:
    """Return memory and wrench for given rotor speeds, as where they were measured.

    The arguments are those of `plant_step`; `spin` stands for the command and `rotors.steady`
    makes one from measured speeds.
    """
    xp = motion.vel_w.__array_namespace__()
    constants = plant.constants
    air_vel_w, winds = motion.vel_w, dict(memory.wind)
    still = xp.zeros_like(air_vel_w)
    for name, value in _in_order(plant.effects):
        blow = EFFECTS[name].wind
        if blow is not None:
            before = memory.wind.get(name, still)
            wind_w = blow(value, Gust(before, air_vel_w, noise, plant.dt))
            air_vel_w = air_vel_w - wind_w
            if name in memory.wind:
                winds[name] = wind_w
    flow = Flow(
        constants=constants,
        pos_w=motion.pos_w,
        rot_w=motion.rot_w,
        air_vel_b=to_local(motion.rot_w, air_vel_w),
        rate_b=motion.rate_b,
        rotor_speed=spin.mean,
        spin=plant.nominal.spin,
        time_s=time_s,
        voltage_drop=voltage_drop,
    )
    thrust = constants.thrust_coefficient * spin.mean_square
    for name, value in _in_order(plant.effects):
        change = EFFECTS[name].thrust
        thrust = thrust if change is None else change(value, flow, thrust)
    force_b = thrust.sum(axis=-1)[..., None] * constants.thrust_axis_b
    arm = constants.rotor_position_b
    about_z = -(flow.spin * constants.torque_coefficient * spin.mean_square).sum(axis=-1)
    torque_b = xp.stack(
        [(arm[..., 1] * thrust).sum(axis=-1), -(arm[..., 0] * thrust).sum(axis=-1), about_z],
        axis=-1,
    )
    for name, value in _in_order(plant.effects):
        push, twist = EFFECTS[name].force, EFFECTS[name].torque
        force_b = force_b if push is None else force_b + push(value, flow)
        torque_b = torque_b if twist is None else torque_b + twist(value, flow)
    return memory._replace(wind=winds), Wrench(force_b, torque_b)


def _in_order(effects: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the effects in the table's order, in which they act; JAX sorts dicts by name."""
    return [(name, effects[name]) for name in EFFECTS if name in effects]


def _delay_weight(delay: Array, dt: float, max_delay: float) -> Array:
    """Return each remembered command's share (..., L): linear between the two nearest steps."""
    xp = delay.__array_namespace__()
    # A delay of 0.03 s is 15 steps of 0.002 s in spite of rounding.
    length = math.ceil(max_delay / dt - 1e-9) + 1 if max_delay > 0.0 else 0
    age = np.arange(length)
    steps = (delay / dt)[..., None]
    whole = xp.floor(steps + 1e-9)
    part = steps - whole
    return xp.where(age == whole, 1.0 - part, 0.0) + xp.where(age == whole + 1.0, part, 0.0)
