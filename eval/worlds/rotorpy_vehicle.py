"""Convert a vehicle file to RotorPy's parameters, and list the differences.

RotorPy's own constants of a vehicle are those of its rotors, body and air (Folk, Paulos and Kumar
2023, "RotorPy: A Python-based Multirotor Simulator with Aerodynamics"). Commands, and when they
act, belong to the autopilot. Its blade flapping has the opposite sign of the
catalogue's, and its drag and lift of a rotor act at the hub and go by the hub's own airspeed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import Vehicle, motor_speed

AIR: Mapping[str, Callable[[Any, float], Mapping[str, float]]] = {
    "quadratic_drag": lambda values, mass: dict(
        zip(("c_Dx", "c_Dy", "c_Dz"), map(float, mass * values.coefficient), strict=True)
    ),
    "rotor_drag": lambda values, mass: {"k_d": float(values.coefficient)},
    "inflow": lambda values, mass: {"k_z": float(values.coefficient)},
    "translational_lift": lambda values, mass: {"k_h": 0.25 * mass * float(values.coefficient)},
    "blade_flapping": lambda values, mass: {"k_flap": -float(values.coefficient)},
}
"""Effect -> RotorPy's parameters, from the effect's values and the true mass [kg]."""
CONSTANTS = ("motor_lag", "thrust_scale", "mass_offset", "com_offset", "inertia_scale")
"""Effects that change constants of RotorPy's model."""
ROTORPY_EFFECTS = (*AIR, *CONSTANTS)
"""Effects that RotorPy's own equations contain."""
OUTSIDE = ("command_delay", "rate_gain", "constant_wind", "gusts")
"""Effects outside RotorPy's vehicle: of the autopilot, and wind, which is an input."""
AT_HOVER = "linear_drag"
"""RotorPy's drag is always proportional to the rotors' speed."""


def rotorpy_parameters(vehicle: Vehicle, shortest_lag_s: float = 0.0) -> dict[str, Any]:
    """Return RotorPy's parameters of a vehicle, without effects that it does not model.

    Args:
        vehicle: what flies.
        shortest_lag_s: the rotors' time constant is no shorter than this; RotorPy divides by it.
    """
    known = (*ROTORPY_EFFECTS, AT_HOVER)
    kept = {name: value for name, value in vehicle.effects.items() if name in known}
    flown = replace(vehicle, effects=kept)
    values = all_values(flown)
    constants = make_plant(flown, 1.0 / flown.controller.frequency).constants
    mass, thrust = float(constants.mass), float(constants.thrust_coefficient[0])
    parameters = {
        "mass": mass,
        **dict(zip(("Ixx", "Iyy", "Izz"), map(float, constants.inertia), strict=True)),
        **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
        "num_rotors": 4,
        "rotor_pos": {f"r{i + 1}": hub for i, hub in enumerate(constants.rotor_position_b)},
        # Its sign is that of the torque on the body, ours that of the rotor's turning.
        "rotor_directions": -np.array(flown.rotors.spin),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": _fastest(flown),
        "k_eta": thrust,
        "k_m": float(constants.torque_coefficient[0]),
        "tau_m": max(float(constants.time_constant), shortest_lag_s),
        "motor_noise_std": 0.0,
        **{key: v for name, of in AIR.items() for key, v in of(values[name], mass).items()},
    }
    if AT_HOVER in kept:
        hover = 4.0 * np.sqrt(mass * GRAVITY / (4.0 * thrust))
        along_x, along_y, along_z = (float(c) for c in mass * values[AT_HOVER].coefficient / hover)
        parameters["k_d"] += 0.5 * (along_x + along_y)
        parameters["k_z"] += along_z
    return parameters


def _fastest(vehicle: Vehicle) -> float:
    """Return the largest rotor speed that the autopilot may command [rad/s].

    Behind a firmware's loop it is what the motors' curve gives at full command.
    """
    most = vehicle.rotors.speed_max
    if vehicle.motors is None or vehicle.controller.settings is None:
        return most
    return max(most, float(motor_speed(vehicle, np.asarray(1.0))))


def as_flown(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle file that describes RotorPy's model of `vehicle` best."""
    known = (*ROTORPY_EFFECTS, *OUTSIDE)
    kept = {name: value for name, value in vehicle.effects.items() if name in known}
    if AT_HOVER in vehicle.effects:
        parameters = rotorpy_parameters(vehicle)
        for name, key in (("rotor_drag", "k_d"), ("inflow", "k_z")):
            kept[name] = EFFECTS[name].values(parameters[key])
    return replace(vehicle, name=f"{vehicle.name}, as RotorPy flies it", effects=kept)


def differences(vehicle: Vehicle, shortest_lag_s: float) -> list[str]:
    """Return a sentence for each deviation of RotorPy's model from `vehicle`.

    The arguments are those of `rotorpy_parameters`.
    """
    found = []
    if AT_HOVER in vehicle.effects:
        found.append(
            f"{AT_HOVER}: RotorPy's drag goes with the rotors' speed (ours: rotor_drag, inflow); "
            "flown as that, with the same force at hover's rotor speed"
        )
        along = np.asarray(vehicle.effects[AT_HOVER].coefficient)
        if along[0] != along[1]:
            found[-1] += ", the mean of x and y along both"
    parts = rotorpy_parameters(vehicle)
    if parts["tau_m"] < shortest_lag_s:
        found.append(
            f"rotors.time_constant: {parts['tau_m']:g} s is shorter than RotorPy's steps can "
            f"follow; flown with {shortest_lag_s:g} s"
        )
    if parts["k_d"] or parts["k_z"]:
        found.append(
            "the rotors' drag acts at each hub, by the hub's own airspeed: it damps turning, and "
            "yaws the body where the rotors turn at different speeds"
        )
    known = (*ROTORPY_EFFECTS, *OUTSIDE, AT_HOVER)
    found += [
        f"{name}: RotorPy does not have it; flown without"
        for name in vehicle.effects
        if name not in known and EFFECTS[name].in_flight
    ]
    return found
