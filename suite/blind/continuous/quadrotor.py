"""The true constants of a vehicle with its effects, and its controller with nominal constants.

Only definitions are shared with the suite: the nominal quadrotor's five steps and the catalogue's
equations. No function of the catalogue is called. The controller computes torque from body rates,
and rotor speeds within their range from torque.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, WINDS

GRAVITY = 9.81
"""[m/s^2]."""
CONSTANTS = (
    "motor_lag", "command_delay", "thrust_scale", "mass_offset", "com_offset", "inertia_scale",
    "rate_gain", "weak_motor", "thrust_tilt", "frame_tilt",
)  # fmt: skip
"""Effects that change a constant of the vehicle or its environment."""
OF_LOGS = ("gyro_bias", "accelerometer_bias", "clock_offset")
"""Effects that change only the log."""


class Believed(NamedTuple):
    """Constants of the rate loop and the mixer: the vehicle file's nominal values."""

    mass: float
    """[kg]."""
    inertia: np.ndarray
    """(3,) [kg m^2]."""
    rate_gain: np.ndarray
    """(3,) true K, since the catalogue's `rate_gain` is an error of the loop [1/s]."""
    shares: np.ndarray
    """(4, 4) thrust of each rotor for a unit of (collective, torque about x, y, z)."""
    thrust_max: float
    """Of one rotor [N]."""
    thrust_coefficient: float
    """k_T [N/(rad/s)^2]."""
    period_s: float
    """Of the rate loop [s]."""


class Quadrotor(NamedTuple):
    """The true constants."""

    believed: Believed
    mass: float
    """[kg]."""
    inertia: np.ndarray
    """(3,) [kg m^2]."""
    gravity_w: np.ndarray
    """(3,) [m/s^2]."""
    arm: np.ndarray
    """(4, 3) rotors from the true centre of mass, body axes [m]."""
    spin: np.ndarray
    """(4,) s_i."""
    thrust_coefficient: np.ndarray
    """(4,) [N/(rad/s)^2]."""
    torque_coefficient: np.ndarray
    """(4,) [N m/(rad/s)^2]."""
    thrust_axis: np.ndarray
    """(3,) along which the total thrust pushes, body axes."""
    time_constant: float
    """Time constant of the rotors [s]; 0 for no lag."""
    delay: float
    """Delay of commands [s]."""
    effects: dict[str, Any]
    """Values of every effect, by name."""


def quadrotor_of(vehicle: Vehicle) -> Quadrotor:
    """Return the true vehicle and its controller from the numbers of `vehicle`.

    Raises:
        ValueError: for an effect without an equation in this engine.
    """
    effects = dict(vehicle.effects)
    known = {*CONSTANTS, *OF_LOGS, *THRUSTS, *FORCES, *TORQUES, *WINDS}
    for name in effects:
        if name not in known:
            raise ValueError(
                f"effects.{name}: the continuous engine has no equation for it; allowed: "
                f"{', '.join(sorted(known))}"
            )

    def value(effect: str, parameter: str, absent: Any) -> Any:
        given = getattr(effects[effect], parameter) if effect in effects else absent
        return np.asarray(given, dtype=float)

    rotors, controller = vehicle.rotors, vehicle.controller
    hubs, spin = np.array(rotors.position, dtype=float), np.array(rotors.spin, dtype=float)
    weak = value("weak_motor", "scale", np.ones(4))
    twist = -spin * rotors.torque_coefficient / rotors.thrust_coefficient
    lift = rotors.thrust_coefficient * float(value("thrust_scale", "scale", 1.0))
    believed = Believed(
        mass=vehicle.mass,
        inertia=np.array(vehicle.inertia),
        rate_gain=np.array(controller.rate_gain) * value("rate_gain", "scale", np.ones(3)),
        shares=np.linalg.inv(np.array([np.ones(4), hubs[:, 1], -hubs[:, 0], twist])),
        thrust_max=rotors.thrust_coefficient * rotors.speed_max**2,
        thrust_coefficient=rotors.thrust_coefficient,
        period_s=1.0 / controller.frequency,
    )
    return Quadrotor(
        believed=believed,
        mass=vehicle.mass + float(value("mass_offset", "offset", 0.0)),
        inertia=believed.inertia * value("inertia_scale", "scale", np.ones(3)),
        gravity_w=-GRAVITY * leaning_z(value("frame_tilt", "angle", np.zeros(2))),
        arm=hubs - value("com_offset", "offset", np.zeros(3)),
        spin=spin,
        thrust_coefficient=lift * weak,
        torque_coefficient=rotors.torque_coefficient * weak,
        thrust_axis=leaning_z(value("thrust_tilt", "angle", np.zeros(2))),
        time_constant=float(value("motor_lag", "time_constant", rotors.time_constant)),
        delay=float(value("command_delay", "delay", 0.0)),
        effects=effects,
    )


def leaning_z(angle: np.ndarray) -> np.ndarray:
    """Return Rot(a_x, a_y, 0) e3 (3,): e3 rolled by a_x, then pitched by a_y [rad]."""
    roll, pitch = angle
    rolled = np.array([0.0, -np.sin(roll), np.cos(roll)])
    return np.array([np.sin(pitch) * rolled[2], rolled[1], np.cos(pitch) * rolled[2]])


TINY = 1e-12
"""Smaller thrusts are rounding errors [N]."""


def wanted_speeds(believed: Believed, command: np.ndarray, rate_b: np.ndarray) -> np.ndarray:
    """Return the rotor speeds (N, 4) that the rate loop commands [rad/s].

    Args:
        believed: the controller's constants.
        command: (N, 4) thrust per nominal mass [m/s^2], body rates [rad/s].
        rate_b: (N, 3) measured by the loop [rad/s].
    """
    inertia = believed.inertia
    x, y, z = inertia
    # rate x (J rate), written out for a diagonal J.
    turning = np.array([z - y, x - z, y - x]) * rate_b[:, [1, 2, 0]] * rate_b[:, [2, 0, 1]]
    torque_b = inertia * believed.rate_gain * (command[:, 1:] - rate_b) + turning
    thrust = allotted(believed, believed.mass * command[:, 0], torque_b)
    return np.sqrt(thrust / believed.thrust_coefficient)


def allotted(believed: Believed, collective: np.ndarray, torque_b: np.ndarray) -> np.ndarray:
    """Return each rotor's thrust (N, 4) for a collective (N,) [N] and a torque (N, 3) [N m].

    If a rotor would exceed [0, f_max], roll and pitch are scaled by one factor until their spread
    is f_max, the collective is set to the nearest feasible value, and yaw is scaled to the
    remaining range.
    """
    lift, most = believed.shares[:, 0], believed.thrust_max
    tilt = torque_b[:, :2] @ believed.shares[:, 1:3].T
    yaw = torque_b[:, 2:] * believed.shares[:, 3]
    free = collective[:, None] * lift + tilt + yaw
    beyond = np.any((free < 0.0) | (free > most), axis=1)
    if not beyond.any():
        return free
    spread = tilt.max(axis=1) - tilt.min(axis=1)
    tilt = tilt * np.minimum(1.0, most / np.maximum(spread, TINY))[:, None]
    least_c = (-tilt / lift).max(axis=1)
    most_c = ((most - tilt) / lift).min(axis=1)
    level = np.minimum(np.maximum(collective, least_c), most_c)[:, None] * lift + tilt
    room = np.where(yaw > 0.0, most - level, level)
    moving = np.abs(yaw) > TINY
    ratio = np.where(moving, np.maximum(room, 0.0) / np.where(moving, np.abs(yaw), 1.0), 1.0)
    held = level + np.minimum(ratio.min(axis=1, keepdims=True), 1.0) * yaw
    return np.where(beyond[:, None], np.clip(held, 0.0, most), free)
