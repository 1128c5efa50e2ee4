"""The true constants of a vehicle with its effects, and its controller with nominal constants.

The continuous-time engine shares only definitions with the rest of the suite: the documented model
of the nominal quadrotor, and the equations of the catalogue of effects. Its controller, rate loop
and mixer, uses the nominal constants only, as on a real drone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, WINDS

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
CONSTANTS = (
    "motor_lag", "command_delay", "thrust_scale", "mass_offset", "com_offset", "inertia_scale",
    "rate_gain", "weak_motor", "thrust_tilt", "frame_tilt",
)  # fmt: skip
"""Effects that change a constant of the vehicle or its environment."""
LOG_FAULTS = ("lever_arm", "attitude_offset", "gyro_bias", "accelerometer_bias", "clock_offset")
"""Effects that change only the log."""
SUPPORTED = frozenset((*CONSTANTS, *LOG_FAULTS, *THRUSTS, *FORCES, *TORQUES, *WINDS))
"""Effects that have an equation in this engine."""


class NominalConstants(NamedTuple):
    """Constants of the rate loop and the mixer: the nominal values, those in the vehicle file."""

    mass: float
    """Nominal mass [kg]."""
    inertia: np.ndarray
    """(3,) nominal inertia [kg m^2]."""
    rate_gain: np.ndarray
    """(3,) gain K of the rate loop [1/s]. It is the true one: the effect `rate_gain` means that the
    loop has another gain than the vehicle file says."""
    shares: np.ndarray
    """(4, 4) thrust of each rotor (rows) for a unit of collective thrust and of the torques about
    x, y and z (columns)."""
    thrust_max: float
    """Largest thrust of one rotor [N]."""
    thrust_coefficient: float
    """Thrust coefficient k_T of a rotor [N/(rad/s)^2]."""


class Quadrotor(NamedTuple):
    """The true constants of the vehicle that flies."""

    nominal: NominalConstants
    """Constants that the controller uses."""
    mass: float
    """Mass [kg]."""
    inertia: np.ndarray
    """(3,) inertia [kg m^2]."""
    gravity_w: np.ndarray
    """(3,) acceleration of gravity; it is not along -z if the world frame is tilted [m/s^2]."""
    arm: np.ndarray
    """(4, 3) positions of the rotors from the true centre of mass, body axes [m]."""
    spin: np.ndarray
    """(4,) directions of rotation s_i, 1 or -1."""
    thrust_coefficient: np.ndarray
    """(4,) thrust coefficient k_T of each rotor [N/(rad/s)^2]."""
    torque_coefficient: np.ndarray
    """(4,) torque coefficient k_Q of each rotor [N m/(rad/s)^2]."""
    thrust_axis: np.ndarray
    """(3,) unit vector of the total thrust, body axes."""
    time_constant: float
    """Time constant of the rotors [s]; 0 for no lag."""
    delay: float
    """Delay of commands [s]."""
    effects: dict[str, Any]
    """Values of every effect, by name."""


def quadrotor_of(vehicle: Vehicle) -> Quadrotor:
    """Return the constants of `vehicle` with its effects, and those of its controller without.

    Raises:
        ValueError: for an effect without an equation in this engine.
    """
    effects = dict(vehicle.effects)
    for name in effects:
        if name not in SUPPORTED:
            raise ValueError(
                f"effects.{name}: the continuous engine has no equation for it; allowed: "
                f"{', '.join(sorted(SUPPORTED))}"
            )

    def value(effect: str, parameter: str, default: Any) -> Any:
        """Return a parameter of an effect, or the default where the vehicle lacks the effect."""
        raw_value = getattr(effects[effect], parameter) if effect in effects else default
        return np.asarray(raw_value, dtype=float)

    rotors, controller = vehicle.rotors, vehicle.controller
    hubs, spin = np.array(rotors.position, dtype=float), np.array(rotors.spin, dtype=float)
    motor_scale = value("weak_motor", "scale", np.ones(4))
    yaw_per_thrust = -spin * rotors.torque_coefficient / rotors.thrust_coefficient
    thrust_scale = float(value("thrust_scale", "scale", 1.0))
    nominal = NominalConstants(
        mass=vehicle.mass,
        inertia=np.array(vehicle.inertia),
        rate_gain=np.array(controller.rate_gain) * value("rate_gain", "scale", np.ones(3)),
        shares=np.linalg.inv(np.array([np.ones(4), hubs[:, 1], -hubs[:, 0], yaw_per_thrust])),
        thrust_max=rotors.thrust_coefficient * rotors.speed_max**2,
        thrust_coefficient=rotors.thrust_coefficient,
    )
    return Quadrotor(
        nominal=nominal,
        mass=vehicle.mass + float(value("mass_offset", "offset", 0.0)),
        inertia=nominal.inertia * value("inertia_scale", "scale", np.ones(3)),
        gravity_w=-GRAVITY * tilted_z(value("frame_tilt", "angle", np.zeros(2))),
        arm=hubs - value("com_offset", "offset", np.zeros(3)),
        spin=spin,
        thrust_coefficient=rotors.thrust_coefficient * thrust_scale * motor_scale,
        torque_coefficient=rotors.torque_coefficient * motor_scale,
        thrust_axis=tilted_z(value("thrust_tilt", "angle", np.zeros(2))),
        time_constant=float(value("motor_lag", "time_constant", rotors.time_constant)),
        delay=float(value("command_delay", "delay", 0.0)),
        effects=effects,
    )


def tilted_z(angle: np.ndarray) -> np.ndarray:
    """Return Rot(a_x, a_y, 0) e3 (3,): e3 rolled by a_x, then pitched by a_y [rad]."""
    roll, pitch = angle
    rolled = np.array([0.0, -np.sin(roll), np.cos(roll)])
    return np.array([np.sin(pitch) * rolled[2], rolled[1], np.cos(pitch) * rolled[2]])


TINY = 1e-12
"""Thrusts below this are rounding errors [N]."""


def commanded_speeds(
    nominal: NominalConstants, command: np.ndarray, rate_b: np.ndarray
) -> np.ndarray:
    """Return the rotor speeds (N, 4) that the rate loop commands [rad/s].

    Args:
        nominal: constants of the controller.
        command: (N, 4) commanded thrust per nominal mass [m/s^2] and body rates [rad/s].
        rate_b: (N, 3) body rates that the rate loop measured at its last tick [rad/s].
    """
    inertia = nominal.inertia
    x, y, z = inertia
    # rate x (J rate), written out for a diagonal J.
    gyroscopic = np.array([z - y, x - z, y - x]) * rate_b[:, [1, 2, 0]] * rate_b[:, [2, 0, 1]]
    torque_b = inertia * nominal.rate_gain * (command[:, 1:] - rate_b) + gyroscopic
    thrust = allocate_thrust(nominal, nominal.mass * command[:, 0], torque_b)
    return np.sqrt(thrust / nominal.thrust_coefficient)


def allocate_thrust(
    nominal: NominalConstants, collective: np.ndarray, torque_b: np.ndarray
) -> np.ndarray:
    """Return the thrust of each rotor (N, 4) [N].

    If a rotor would leave the range from 0 to f_max, three steps limit the thrusts. Roll and pitch
    are scaled by one factor until their spread over the rotors is f_max, and with unequal arms
    until a collective thrust is feasible. The collective thrust is set to the nearest feasible
    value. Yaw is scaled to the range that remains.

    Args:
        nominal: constants of the controller.
        collective: (N,) commanded sum of the thrusts [N].
        torque_b: (N, 3) commanded torque, body axes [N m].
    """
    share, limit = nominal.shares[:, 0], nominal.thrust_max
    tilt_thrust = torque_b[:, :2] @ nominal.shares[:, 1:3].T
    yaw_thrust = torque_b[:, 2:] * nominal.shares[:, 3]
    unlimited = collective[:, None] * share + tilt_thrust + yaw_thrust
    saturated = np.any((unlimited < 0.0) | (unlimited > limit), axis=1)
    if not saturated.any():
        return unlimited
    spread = tilt_thrust.max(axis=1) - tilt_thrust.min(axis=1)
    factor = np.minimum(1.0, limit / np.maximum(spread, TINY))
    if np.ptp(share) > TINY:
        needed = -tilt_thrust / share
        span = needed.max(axis=1, keepdims=True) - needed
        factor = np.minimum(factor, (limit / share / np.maximum(span, TINY)).min(axis=1))
    tilt_thrust = tilt_thrust * factor[:, None]
    least = (-tilt_thrust / share).max(axis=1)
    most = ((limit - tilt_thrust) / share).min(axis=1)
    without_yaw = np.minimum(np.maximum(collective, least), most)[:, None] * share + tilt_thrust
    room = np.where(yaw_thrust > 0.0, limit - without_yaw, without_yaw)
    has_yaw = np.abs(yaw_thrust) > TINY
    ratio = np.where(
        has_yaw, np.maximum(room, 0.0) / np.where(has_yaw, np.abs(yaw_thrust), 1.0), 1.0
    )
    limited = without_yaw + np.minimum(ratio.min(axis=1, keepdims=True), 1.0) * yaw_thrust
    return np.where(saturated[:, None], np.clip(limited, 0.0, limit), unlimited)
