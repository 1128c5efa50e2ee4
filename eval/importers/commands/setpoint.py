"""Attitude set points as commanded rates, by the attitude loop of the vehicle file."""

from __future__ import annotations

import numpy as np

from eval.importers.findings import Finding
from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.vehicles.vehicle import Vehicle


def rates_wanted(rows: dict[str, np.ndarray], vehicle: Vehicle | None) -> list[Finding]:
    """Replace `cmd_quat` of `rows` by `cmd_rate`, in place, where nothing commanded rates.

    The rate is the attitude gain times the rotation vector from the attitude to the set point,
    within the vehicle's `rate_max`.
    """
    if "cmd_quat" not in rows:
        return []
    wanted = rows.pop("cmd_quat")
    if "cmd_rate" in rows or "quat" not in rows:
        return []
    if vehicle is None:
        text = "are attitudes, and nothing says the attitude loop's gains: left out; give --vehicle"
        return [Finding("doubt", "set points", text)]
    norm = np.linalg.norm(wanted, axis=1, keepdims=True)
    error = rotation_vector(multiply(conjugate(rows["quat"]), wanted / norm))
    limit = np.asarray(vehicle.controller.rate_max)
    gain = np.asarray(vehicle.controller.attitude_gain)
    rows["cmd_rate"] = np.clip(gain * error, -limit, limit)
    text = f"are attitudes; rates by the attitude gains of {vehicle.name!r}, {gain.tolist()} 1/s"
    return [Finding("note", "set points", text)]
