"""What flights cannot tell of a vehicle, and what they lack for it, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.data.grid import FlightGrid
from suite.diagnose.identify.fit import Fitted

WHY = {
    "thrust": "thrust: too little of the force along body z is explained",
    "curve": "curvature of the thrust curve: the motor commands hardly change",
    "battery": "voltage_exponent: the voltage hardly changes",
    "drag_x": "drag along body x: too slow, or too little of it",
    "drag_y": "drag along body y: too slow, or too little of it",
    "drag_z": "drag along body z: too slow, or too little of it",
    "inertia_x": "inertia about x: the body hardly rolls, or the rotors' lag may be another",
    "inertia_y": "inertia about y: the body hardly pitches, or the rotors' lag may be another",
    "inertia_z": "inertia about z: the body hardly yaws, or not while it rolls and pitches",
    "yaw": "torque_coefficient: the body hardly yaws",
    "lag": "time_constant of the rotors: nothing fast enough is asked of them",
    "late": "command_delay: nothing fast enough is asked of the motors",
    "gain_x": "rate_gain about x: the body hardly rolls",
    "gain_y": "rate_gain about y: the body hardly pitches",
    "gain_z": "rate_gain about z: the body hardly yaws",
}
"""What was fitted and not told, and what the flights lack for it."""
STILL = "no body rates and no attitude in these logs"


def untold(fitted: Mapping[str, Fitted]) -> list[str]:
    """Return what no fit has told of what was looked for."""
    told = {u.name for found in fitted.values() for u in found.unknowns if found.has(u.name)}
    names = dict.fromkeys(name for found in fitted.values() for name in found.untold)
    return [WHY[name] for name in names if name not in told and name in WHY]


def unasked(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    drive: str,
    fitted: Mapping[str, Fitted],
    leave: Sequence[str],
) -> list[str]:
    """Return what was not even looked for, since the logs have no such columns.

    Args:
        flights: on their grids.
        vehicle: the start.
        drive: what drove the flights.
        fitted: what was fitted, by the fit's name.
        leave: what was not to be fitted.
    """
    lines = []

    def anywhere(*names: str) -> bool:
        return any(flight.has(*names) for flight in flights)

    force = fitted.get("force")
    if force is None:
        if not {"drag", "motors"} <= set(leave):
            lines.append("thrust and drag: these logs have no stretch with a position")
    elif "drag" not in leave and not any(u.name == "drag_x" for u in force.unknowns):
        lines.append(
            "drag along body x and y: without an attitude a force across the thrust looks like "
            "a body that leans"
        )
    if drive == "pwm" and "motors" not in leave and not anywhere("voltage"):
        lines.append("voltage_exponent: these logs have no voltage")
    if "torque" not in fitted and "inertia" not in leave:
        if drive in ("rates", "thrust"):
            lines.append(
                "inertia and torque_coefficient: commanded rates and thrust say nothing of "
                "torques; that needs motor commands, rotor speeds or commanded torques"
            )
        else:
            lines.append(f"inertia and torque_coefficient: {STILL}")
    lags = any(u.name == "late" for found in fitted.values() for u in found.unknowns)
    if not lags and "lag" not in leave:
        lines.append(
            "time_constant and command_delay: measured rotor speeds are past them; that needs "
            "commanded ones (motor_cmd_1 to motor_cmd_4) beside"
            if drive == "rotors"
            else f"time_constant and command_delay: {STILL}"
        )
    if "loop" not in fitted and "loop" not in leave:
        lines.append(
            f"the rate loop: settings of a {vehicle.controller.kind} loop are not fitted"
            if vehicle.controller.kind != "p"
            else "rate_gain: these logs have no commanded body rates"
        )
    return lines
