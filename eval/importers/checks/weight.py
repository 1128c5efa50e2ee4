"""Do the rotor speeds carry the vehicle? Tells revolutions from radians, and eRPM by pole pairs."""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.findings import Finding
from eval.vehicles.vehicle import Vehicle

NEAR = 1.2
"""A factor within this of the measured one explains it, where no other does."""
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
    near = {
        words: abs(np.log(factor / wrong))
        for words, wrong in FACTORS.items()
        if abs(np.log(factor / wrong)) < np.log(NEAR)
    }
    if not near:
        text = f"{figures}: the speeds' unit, the mass or the thrust coefficient is wrong"
        return [Finding("doubt", "rotor speeds", text)]
    words = min(near, key=lambda name: near[name])
    text = f"{figures}: they are {FACTORS[words]:.3g} times too large ({words})"
    if not fix:
        return [Finding("doubt", "rotor speeds", text + "; left as they are")]
    for name in ("motor", "motor_cmd"):
        if name in rows:
            rows[name] = rows[name] / FACTORS[words]
    return [Finding("corrected", "rotor speeds", text)]
