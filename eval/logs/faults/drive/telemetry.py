"""Check the columns of rotor speeds: copies, dropouts, and values that are held between samples."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import Rows

LEAST_ROWS = 100
"""Least rows in flight for these checks."""
TURNING = 0.3
"""Least body rate in flight [rad/s]; on the ground rotors may idle at one speed."""
DROPPED, LEAST_DROPPED = 0.002, 3
"""Least share and number of rows in which a rotor stands still between two in which it turns."""
HELD_S, HELD = 0.035, 0.5
"""Longest mean time between samples that is fine [s], and least share of rows that repeat."""
FIX = "leave rows without a new sample empty, or log the rotor speeds in every row"


def check_telemetry(rows: Rows) -> list[Finding]:
    """Return the finding on rotor speeds that are copied, drop out, or are held; [] for none."""
    if "motor" not in rows:
        return []
    known = np.isfinite(rows["motor"]).all(axis=1)
    if "rate" in rows:
        known &= np.linalg.norm(np.nan_to_num(rows["rate"]), axis=1) > TURNING
    speed, step_s = rows["motor"][known], float(np.median(np.diff(rows["time"])))
    if len(speed) < LEAST_ROWS:
        return []
    changes = np.ptp(speed, axis=0) > 0.0
    for a, b in combinations(range(4), 2):
        if changes[a] and np.array_equal(speed[:, a], speed[:, b]):
            text = f"motors {a + 1} and {b + 1} have the same values: a column was read twice"
            return [_finding(text, 1.0, "the columns of the motors in --map")]
    still = [str(k + 1) for k in range(4) if not changes[k] and speed[0, k] != 0.0]
    if still and changes.any():
        text = f"motors {', '.join(still)} of 4 never change"
        return [_finding(text, float(len(still)), "the columns of the motors in --map")]
    stops = (speed[1:-1] == 0.0) & (speed[:-2] != 0.0) & (speed[2:] != 0.0)
    has_stop = stops.any(axis=1)
    share = float(has_stop.mean())
    if share > DROPPED and has_stop.sum() >= LEAST_DROPPED:
        text = f"{100 * share:.1f} % of the rows have a rotor that stands still for one row"
        return [_finding(text, share, "leave dropouts of the telemetry empty, not 0")]
    repeats = float((speed[1:] == speed[:-1]).all(axis=1).mean())
    every_s = step_s / max(1.0 - repeats, 1e-3)
    if repeats > HELD and every_s > HELD_S:
        text = f"{100 * repeats:.0f} % of the rows repeat the one before: samples are {every_s:.2g}"
        return [_finding(f"{text} s apart", every_s, FIX)]
    return []


def _finding(text: str, size: float, fix: str) -> Finding:
    return Finding("doubt", "rotor speeds", text, "motor_telemetry", size, 0.95, fix)
