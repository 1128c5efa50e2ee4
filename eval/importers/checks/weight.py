"""Do the rotor speeds carry the vehicle? Tells revolutions from radians, and eRPM by pole pairs."""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.findings import Finding
from eval.vehicles.vehicle import Vehicle

NEAR, CLEAR = 1.2, 1.1
"""A factor within the first of the measured one may explain it; where just one is within the
second, it does."""
FITS = 1.35
"""Speeds within this factor of what carries the weight are as they should be (thrust: squared)."""
FACTORS = {
    "rpm in place of rad/s": 60.0 / (2.0 * np.pi),
    "revolutions a second in place of rad/s": 1.0 / (2.0 * np.pi),
    **{f"electrical, of {pairs} pole pairs": float(pairs) for pairs in (6, 7, 11, 12, 14)},
}
"""What rotor speeds may be too large by, in words."""


def check_weight(rows: dict[str, np.ndarray], vehicle: Vehicle | None, fix: bool) -> list[Finding]:
    """Hold the rotors' thrust by the vehicle file against its weight; correct under `fix`.

    Over a whole flight the mean of the force along z in the world is the weight.
    """
    if "motor" not in rows:
        return []
    if vehicle is None:
        text = "not checked against the weight; --vehicle makes it possible"
        return [Finding("note", "rotor speeds", text)]
    speed = rows["motor"]
    good = np.isfinite(speed).all(axis=1)
    up = np.ones(len(speed))
    if "quat" in rows:
        w, x, y, z = rows["quat"].T
        up = w**2 - x**2 - y**2 + z**2
        good &= np.isfinite(up)
    thrust = vehicle.rotors.thrust_coefficient * np.sum(speed**2, axis=1)
    lift = float(np.mean((thrust * up)[good])) / (vehicle.mass * GRAVITY)
    if not lift > 0.0:
        return []
    factor = float(np.sqrt(lift))
    figures = f"by {vehicle.name!r} they lift {lift:.3g} times the weight"
    if 1.0 / FITS < factor < FITS:
        return [Finding("ok", "rotor speeds", figures)]
    near = _within(NEAR, factor)
    if not near:
        text = f"{figures}: the speeds' unit, the mass or the thrust coefficient is wrong"
        return [Finding("doubt", "rotor speeds", text)]
    clear = _within(CLEAR, factor)
    if len(clear) != 1:
        text = f"{figures}: they are {factor:.3g} times too large, which may be {' or '.join(near)}"
        return [Finding("doubt", "rotor speeds", text + "; left as they are, scale them yourself")]
    (words,) = clear
    text = f"{figures}: they are {FACTORS[words]:.3g} times too large ({words})"
    if len(near) > 1:
        others = " or ".join(name for name in near if name != words)
        text += f"; if the vehicle file is far off, it may be {others}"
    if not fix:
        return [Finding("doubt", "rotor speeds", text + "; left as they are")]
    for name in ("motor", "motor_cmd"):
        if name in rows:
            rows[name] = rows[name] / FACTORS[words]
    return [Finding("corrected", "rotor speeds", text)]


def _within(limit: float, factor: float) -> list[str]:
    """Return which of `FACTORS` are within the ratio `limit` of the measured `factor`."""
    return [
        words for words, wrong in FACTORS.items() if abs(np.log(factor / wrong)) < np.log(limit)
    ]
