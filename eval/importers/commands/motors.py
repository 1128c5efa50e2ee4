"""The motors of a log in the order of the vehicle file, told by where they are."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from eval.importers.findings import Finding
from eval.vehicles.vehicle import Vehicle

SHIPPED_ORDER = ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
"""Front right, rear right, rear left, front left: the order of the vehicles that are shipped."""
SIDES = ("front right", "rear right", "rear left", "front left")


def order_motors(
    rows: dict[str, np.ndarray],
    motor_side: Sequence[tuple[float, float]] | None,
    vehicle: Vehicle | None,
) -> list[Finding]:
    """Put `motor`, `motor_cmd` and `pwm` of `rows` in the vehicle's order, in place.

    Args:
        rows: see `eval.importers.rows`.
        motor_side: (x forward, y left) of the file's motors 1 to 4; None: the order is the
            vehicle's already.
        vehicle: whose order is wanted; None: that of the shipped vehicles.
    """
    if motor_side is None or not ({"motor", "motor_cmd", "pwm"} & rows.keys()):
        return []
    hubs = SHIPPED_ORDER if vehicle is None else [hub[:2] for hub in vehicle.rotors.position]
    have, wanted = _directions(motor_side), _directions(hubs)
    order = max(permutations(range(4)), key=lambda p: float(np.sum(have[list(p)] * wanted)))
    for name in ("motor", "motor_cmd", "pwm"):
        if name in rows:
            rows[name] = rows[name][:, list(order)]
    numbers = ", ".join(str(k + 1) for k in order)
    whose = "the shipped vehicles" if vehicle is None else f"vehicle {vehicle.name!r}"
    return [Finding("note", "motors", f"put in the order of {whose}: the file's {numbers}")]


def _directions(hubs: Sequence[Sequence[float]]) -> np.ndarray:
    array = np.asarray(hubs, dtype=np.float64)
    return array / np.linalg.norm(array, axis=1, keepdims=True)
