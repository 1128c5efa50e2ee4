"""Force and torque on the quadrotor's body: of rotors, wind and all effects of the vehicle.

The functions take numpy and JAX arrays of any leading batch shape. A plant holds the constants of a
quadrotor with its effects. The steppers (`eval.quadrotor.stepper`, `eval.quadrotor.continuous`)
call these functions at every step.
"""

from __future__ import annotations

from collections.abc import Mapping

from eval.effects import EFFECTS
from eval.effects.interface import Array, Flow, Gust, Memory
from eval.quadrotor.plant import Motion, Plant, Wrench, in_order
from eval.quadrotor.rotors import RotorStep
from tracks.geometry.rotation import to_local


def with_push(plant: Plant, wrench: Wrench, push_b: Array | None) -> Wrench:
    """Return `wrench` plus a push, if there is one (`eval.quadrotor.stepper.Inputs.push_b`)."""
    if push_b is None:
        return wrench
    return Wrench(
        wrench.force_b + mass_of(plant) * push_b[..., :3],
        wrench.torque_b + plant.constants.inertia * push_b[..., 3:],
    )


def mass_of(plant: Plant) -> Array:
    """Return the true mass as (..., 1), a divisor of vectors (..., 3); for one plant, a scalar.

    XLA rounds a division by a scalar differently from a division by an array with one element.
    """
    mass = plant.constants.mass
    return mass[..., None] if mass.ndim else mass


def wind_and_flow(
    plant: Plant,
    wind: Mapping[str, Array],
    motion: Motion,
    rotors: RotorStep,
    time_s: Array | float,
    noise: Array | None = None,
    voltage_drop: Array | None = None,
) -> tuple[dict[str, Array], Flow]:
    """Return the random winds of this step, and the inputs of the effects' hooks.

    `wind` are those of the previous step, by effect. `noise` (..., 3) are normal random numbers.
    The flight has lasted `time_s` [s], and the battery lost `voltage_drop` [V] in it, (...,) both.
    """
    winds, air_vel_w = winds_on(plant, wind, motion, noise)
    return winds, Flow(
        constants=plant.constants,
        pos_w=motion.pos_w,
        rot_w=motion.rot_w,
        air_vel_b=to_local(motion.rot_w, air_vel_w),
        rate_b=motion.rate_b,
        rotor_speed=rotors.mean,
        spin=plant.nominal.spin,
        time_s=time_s,
        voltage_drop=voltage_drop,
    )


def winds_on(
    plant: Plant, wind: Mapping[str, Array], motion: Motion, noise: Array | None
) -> tuple[dict[str, Array], Array]:
    """Return the random winds of this step and the velocity through the air.

    `wind` are those of the previous step, by effect; `noise` (..., 3) are normal random numbers.

    Returns:
        The winds by effect, and the velocity of the centre of mass relative to the air (..., 3) in
        world axes [m/s].
    """
    air_vel_w, winds = motion.vel_w, dict(wind)
    still = air_vel_w.__array_namespace__().zeros_like(air_vel_w)
    for name, value in in_order(plant.effects):
        wind_of = EFFECTS[name].wind
        if wind_of is not None:
            previous_w = wind.get(name, still)
            wind_w = wind_of(value, Gust(previous_w, air_vel_w, noise, plant.dt))
            air_vel_w = air_vel_w - wind_w
            if name in wind:
                winds[name] = wind_w
    return winds, air_vel_w


def still_thrust(plant: Plant, rotors: RotorStep) -> Array:
    """Return the rotors' thrusts (..., 4) in still air, away from the ground [N]."""
    return plant.constants.thrust_coefficient * rotors.mean_square


def rotor_wrench(plant: Plant, rotors: RotorStep, thrust: Array) -> Wrench:
    """Return the rotors' force and torque on the body for thrusts (..., 4) [N].

    The torque about z comes from the speeds in `rotors`, not from `thrust`.
    """
    constants, arm = plant.constants, plant.constants.rotor_position_b
    force_b = thrust.sum(axis=-1)[..., None] * constants.thrust_axis_b
    about_z = -(plant.nominal.spin * constants.torque_coefficient * rotors.mean_square).sum(axis=-1)
    torque_b = thrust.__array_namespace__().stack(
        [(arm[..., 1] * thrust).sum(axis=-1), -(arm[..., 0] * thrust).sum(axis=-1), about_z],
        axis=-1,
    )
    return Wrench(force_b, torque_b)


def wrench_on(
    plant: Plant, rotors: RotorStep, flow: Flow, carried: Mapping[str, Memory] | None = None
) -> Wrench:
    """Return the force and torque of rotors and effects.

    `carried` are the states of effects by name, as `eval.quadrotor.stepper.PlantState.carried`.

    Raises:
        ValueError: where the state of an effect is missing in `carried`.
    """
    thrust = still_thrust(plant, rotors)
    for name, value in in_order(plant.effects):
        change = EFFECTS[name].thrust
        if change is not None:
            thrust = change(value, with_state(plant, name, flow, carried), thrust)
    force_b, torque_b = rotor_wrench(plant, rotors, thrust)
    for name, value in in_order(plant.effects):
        force_of, torque_of = EFFECTS[name].force, EFFECTS[name].torque
        effect_flow = with_state(plant, name, flow, carried)
        force_b = force_b if force_of is None else force_b + force_of(value, effect_flow)
        torque_b = torque_b if torque_of is None else torque_b + torque_of(value, effect_flow)
    return Wrench(force_b, torque_b)


def with_state(plant: Plant, name: str, flow: Flow, carried: Mapping[str, Memory] | None) -> Flow:
    """Return `flow` with the state of the effect `name`, if the effect has one."""
    if EFFECTS[name].start is None:
        return flow
    if not carried or name not in carried:
        raise ValueError(
            f"effects.{name} has a motion of its own, which is not simulated here; leave it out of "
            "the vehicle, or fly it with eval.quadrotor.stepper, starting at hover_state"
        )
    return flow._replace(memory=carried[name], dt=plant.dt)
