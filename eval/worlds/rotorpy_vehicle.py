"""Convert a vehicle file to the parameters of the simulator RotorPy, and list the differences.

RotorPy's parameters describe rotors, body and air (Folk, Paulos and Kumar 2023, "RotorPy: A
Python-based Multirotor Simulator with Aerodynamics"); the autopilot is this suite's. RotorPy's
blade flapping has the opposite sign of the effect in the suite's catalogue. In RotorPy, the drag
of a rotor acts at the rotor's hub, and depends on the airspeed there, as in the effect `hub_drag`.
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
TO_HUB = ("rotor_drag", "inflow")
"""Effects of the body's airspeed, for which RotorPy has the airspeed of each hub."""
AT_HUB = "hub_drag"
"""Effect with the form of RotorPy's drag of the rotors, `k_d` and `k_z`."""
ROTORPY_EFFECTS = (*AIR, AT_HUB, *CONSTANTS)
"""Effects that RotorPy's own equations contain."""
OUTSIDE = ("command_delay", "rate_gain", "constant_wind", "gusts")
"""Effects that are not part of RotorPy's vehicle: the autopilot has them, and wind is an input."""
AT_HOVER = "linear_drag"
"""Effect that is converted at hover, because RotorPy's drag is proportional to the rotor speed."""


def shortest_lag_s(vehicle: Vehicle) -> float:
    """Return the least time constant of the rotors, one physics step [s].

    RotorPy divides by the time constant, and its integrator is inaccurate for a shorter one.
    """
    return 1.0 / vehicle.controller.frequency


def rotorpy_parameters(vehicle: Vehicle) -> dict[str, Any]:
    """Return RotorPy's parameters of a vehicle, without effects that it does not model."""
    supported = (*ROTORPY_EFFECTS, AT_HOVER)
    effects = {name: value for name, value in vehicle.effects.items() if name in supported}
    modelled = replace(vehicle, effects=effects)
    values = all_values(modelled)
    constants = make_plant(modelled, 1.0 / modelled.controller.frequency).constants
    mass = float(constants.mass)
    parameters: dict[str, Any] = {
        "mass": mass,
        **dict(zip(("Ixx", "Iyy", "Izz"), map(float, constants.inertia), strict=True)),
        **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
        "num_rotors": 4,
        "rotor_pos": {f"r{i + 1}": hub for i, hub in enumerate(constants.rotor_position_b)},
        # RotorPy gives the sign of the torque on the body, the suite that of the rotor's rotation.
        "rotor_directions": -np.array(modelled.rotors.spin),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": _max_rotor_speed(modelled),
        "k_eta": float(constants.thrust_coefficient[0]),
        "k_m": float(constants.torque_coefficient[0]),
        "tau_m": float(constants.time_constant),
        "motor_noise_std": 0.0,
    }
    for name, convert in AIR.items():
        parameters |= convert(values[name], mass)
    parameters["k_d"] += float(values[AT_HUB].in_plane)
    parameters["k_z"] += float(values[AT_HUB].axial)
    if AT_HOVER in effects:
        # RotorPy's drag is a coefficient times the sum of the rotor speeds times the airspeed.
        drag = mass * values[AT_HOVER].coefficient / (4.0 * hover_speed(parameters))
        drag_x, drag_y, drag_z = (float(c) for c in drag)
        parameters["k_d"] += 0.5 * (drag_x + drag_y)
        parameters["k_z"] += drag_z
    return parameters


def _max_rotor_speed(vehicle: Vehicle) -> float:
    """Return the largest rotor speed that the autopilot may command [rad/s].

    With a firmware's rate loop it is the speed that the motors reach at full command.
    """
    speed_max = vehicle.rotors.speed_max
    if vehicle.motors is None or vehicle.controller.settings is None:
        return speed_max
    return max(speed_max, float(motor_speed(vehicle, np.asarray(1.0))))


def hover_speed(parameters: Mapping[str, Any]) -> float:
    """Return the speed of each rotor at hover [rad/s]."""
    return float(np.sqrt(parameters["mass"] * GRAVITY / (4.0 * parameters["k_eta"])))


def as_flown(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle file that describes RotorPy's model of `vehicle` best.

    It is `vehicle` itself if there are no `differences`.
    """
    if not differences(vehicle):
        return vehicle
    supported = (*ROTORPY_EFFECTS, *OUTSIDE)
    effects = {
        name: value
        for name, value in vehicle.effects.items()
        if name not in TO_HUB and (name in supported or not EFFECTS[name].in_flight)
    }
    parameters = rotorpy_parameters(vehicle)
    if parameters["tau_m"] < shortest_lag_s(vehicle):
        effects["motor_lag"] = EFFECTS["motor_lag"].values(shortest_lag_s(vehicle))
    if parameters["k_d"] or parameters["k_z"]:
        effects[AT_HUB] = EFFECTS[AT_HUB].values(parameters["k_d"], parameters["k_z"])
    return replace(vehicle, name=f"{vehicle.name}, as RotorPy flies it", effects=effects)


def differences(vehicle: Vehicle) -> list[str]:
    """Return a sentence for each deviation of RotorPy's model from `vehicle`."""
    deviations = []
    if AT_HOVER in vehicle.effects:
        deviations.append(
            f"{AT_HOVER}: RotorPy's drag is proportional to the rotors' speed (ours: {AT_HUB}); "
            "flown as that, with the same force at hover's rotor speed"
        )
        coefficient = np.asarray(vehicle.effects[AT_HOVER].coefficient)
        if coefficient[0] != coefficient[1]:
            deviations[-1] += ", the mean of x and y along both"
    parameters = rotorpy_parameters(vehicle)
    if parameters["tau_m"] < shortest_lag_s(vehicle):
        deviations.append(
            f"rotors.time_constant: {parameters['tau_m']:g} s is shorter than RotorPy's steps can "
            f"follow; flown with {shortest_lag_s(vehicle):g} s"
        )
    moved = not vehicle.effects.keys().isdisjoint((AT_HOVER, *TO_HUB))
    if moved and (parameters["k_d"] or parameters["k_z"]):
        deviations.append(
            "the rotors' drag acts at each hub and depends on the hub's airspeed: it damps "
            "rotation, and yaws the body where the rotors have different speeds"
        )
    supported = (*ROTORPY_EFFECTS, *OUTSIDE, AT_HOVER)
    deviations += [
        f"{name}: RotorPy does not have it; flown without"
        for name in vehicle.effects
        if name not in supported and EFFECTS[name].in_flight
    ]
    return deviations
