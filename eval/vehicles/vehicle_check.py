"""Check that a vehicle is possible: values in range, independent rotors, and able to hover."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.mixer import mixer_matrix
from eval.vehicles.vehicle import MotorMap, Vehicle, motor_thrust


def check_vehicle(vehicle: Vehicle) -> None:
    """Refuse nominal values that no quadrotor can have, or that cannot hover.

    Raises:
        ValueError: with the key, the value and what is allowed.
    """
    rotors, controller, camera = vehicle.rotors, vehicle.controller, vehicle.camera
    _between("mass", vehicle.mass, 0.0001, 10000.0, "kg")
    _between("inertia", vehicle.inertia, 1e-10, 10000.0, "kg m^2")
    x, y, z = vehicle.inertia
    # A flat body has Jx + Jy = Jz exactly; the factor allows for rounding.
    if 2.0 * max(x, y, z) > (x + y + z) * (1.0 + 1e-12):
        raise ValueError(
            f"inertia = {list(vehicle.inertia)}: impossible for a body; the largest must be at "
            "most the sum of the other two"
        )
    _between("rotors.thrust_coefficient", rotors.thrust_coefficient, 1e-15, 1000.0, "N/(rad/s)^2")
    _between("rotors.torque_coefficient", rotors.torque_coefficient, 1e-18, 1000.0, "N m/(rad/s)^2")
    _between("rotors.speed_max", rotors.speed_max, 1.0, 1000000.0, "rad/s")
    for hub in rotors.position:
        _between("rotors.position", hub, -100.0, 100.0, "m")
    _between("rotors.time_constant", rotors.time_constant, 0.0, 0.5, "s")
    _between("controller.rate_gain", controller.rate_gain, 0.001, 10000.0, "1/s")
    _between("controller.frequency", controller.frequency, 50.0, 10000.0, "Hz")
    _between("controller.attitude_gain", controller.attitude_gain, 0.001, 10000.0, "1/s")
    _between("controller.rate_max", controller.rate_max, 0.001, 200.0, "rad/s")
    _between("body.half_size", vehicle.body.half_size, 0.0001, 100.0, "m")
    _between("camera.pitch_deg", camera.pitch_deg, -90.0, 90.0, "deg")
    _between("camera.fov_deg", camera.fov_deg, 1.0, 170.0, "deg")
    _between("camera.range", camera.range_m, 0.1, 1000.0, "m")
    if vehicle.motors is not None:
        _check_motors(vehicle.motors)
    _check_rotors(vehicle)


def _check_motors(motors: MotorMap) -> None:
    """Refuse `[motors]` whose thrust does not grow with the command."""
    _between("motors.voltage", motors.voltage, 0.5, 1000.0, "V")
    _between("motors.voltage_exponent", motors.voltage_exponent, 0.0, 4.0, "")
    _between("motors.thrust", motors.thrust, -100000.0, 100000.0, "N")
    first, second = motors.thrust
    if first < 0.0 or first + second <= 0.0 or first + 2.0 * second < 0.0:
        raise ValueError(
            f"motors.thrust = {list(motors.thrust)}: t1 u + t2 u^2 must grow with the command u "
            "from 0 to 1; t1 >= 0, t1 + t2 > 0 and t1 + 2 t2 >= 0"
        )


def _check_rotors(vehicle: Vehicle) -> None:
    """Refuse rotors that cannot produce all torques independently, or cannot hover."""
    rotors = vehicle.rotors
    matrix = mixer_matrix(
        rotors.position, rotors.spin, rotors.torque_coefficient / rotors.thrust_coefficient
    )
    # Rows of equal size, so that the rank depends on the layout instead of the units.
    rows = matrix / np.maximum(np.linalg.norm(matrix, axis=1, keepdims=True), 1e-300)
    if np.linalg.matrix_rank(rows, tol=1e-6) < 4:
        raise ValueError(
            f"rotors.position = {[list(hub) for hub in rotors.position]}, rotors.spin = "
            f"{list(rotors.spin)}: these rotors cannot produce roll, pitch and yaw independently; "
            "rotors at opposite corners usually spin in the same direction"
        )
    if sum(rotors.spin):
        raise ValueError(
            f"rotors.spin = {list(rotors.spin)}: two rotors must spin in each direction; "
            "rotors at opposite corners usually spin alike"
        )
    weight = vehicle.mass * GRAVITY
    hover = np.linalg.solve(matrix, [weight, 0.0, 0.0, 0.0])
    if hover.min() <= 1e-6 * weight:  # by rounding, a rotor without thrust has one of either sign
        raise ValueError(
            f"rotors.position = {[list(hub) for hub in rotors.position]}: the origin (centre of "
            "mass) must be between the rotors, so that all of them push up in hover"
        )
    limits = {f"rotors.speed_max = {rotors.speed_max}": rotors.thrust_max}
    if vehicle.motors is not None and vehicle.controller.settings is not None:
        # With a firmware's loop, `[motors]` limits the thrust too.
        full = motor_thrust(vehicle.motors, 1.0)
        limits[f"motors.thrust = {list(vehicle.motors.thrust)}"] = full
    for entry, limit in limits.items():
        if hover.max() >= limit:
            unit = ""
            if hover.max() > 30.0 * limit:
                unit = "; a mass in grams, or a thrust_coefficient per rpm^2, not per (rad/s)^2?"
            raise ValueError(
                f"{entry}: too weak to hover with mass = {vehicle.mass:g} kg{unit}; a rotor gives "
                f"{limit:.3g} N and {hover.max():.3g} N are needed"
            )


def _between(key: str, value: Any, low: float, high: float, unit: str) -> None:
    """Refuse a number, or a component of a vector, that is not from `low` to `high`."""
    if not (np.min(value) >= low and np.max(value) <= high):
        text = list(value) if isinstance(value, tuple) else value
        raise ValueError(f"{key} = {text}: must be from {low:g} to {high:g} {unit}")
