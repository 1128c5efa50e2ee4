"""Check the columns of rotor speeds: copies, dropouts, values that are held, and their delay.

Rotor speeds cause torques without a delay. So the torques of late speeds fit the gyro at another
time, and better than in any other order of the motors.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from eval.logs.faults.clocks.delay import CLEARLY, late_against
from eval.logs.faults.drive.motors import AS_GIVEN, SURELY, scores_of, torques_of
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import Rows
from eval.logs.faults.relation import shift_rows
from eval.vehicles.vehicle import Vehicle

LEAST_ROWS = 100
"""Least rows in flight for these checks."""
TURNING = 0.3
"""Least body rate in flight [rad/s]; on the ground rotors may idle at one speed."""
DROPPED, LEAST_DROPPED = 0.002, 3
"""Least share and number of rows in which a rotor stands still between two in which it turns."""
HELD_S, HELD = 0.035, 0.5
"""Longest mean time between samples that is fine [s], and least share of rows that repeat."""
LATE_S = 0.015
"""Least delay that is a fault [s]. One of 20 ms makes the inertia seem 6 % larger."""
BETTER = 0.05
"""The least correlation of torque and angular acceleration about roll and pitch, with the delay,
exceeds that of any other order of the motors without a delay by at least this."""
FIX = "leave rows without a new sample empty, or log the rotor speeds in every row"


def check_telemetry(
    rows: Rows, vehicle: Vehicle | None, has_late_gyro: bool = False
) -> list[Finding]:
    """Return the finding on rotor speeds that are copied, drop out, are held or late; [] if none.

    The arms of `vehicle`, or of a usual quadrotor, turn speeds into torques. Their delay is not
    checked against a gyro that is late itself (`has_late_gyro`).
    """
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
    return [] if has_late_gyro else _late(rows, vehicle)


def _late(rows: Rows, vehicle: Vehicle | None) -> list[Finding]:
    """Return the finding on the delay of the rotor speeds against the gyro; [] if it is small."""
    torques = torques_of(rows, "motor", vehicle) if "rate" in rows else ""
    if isinstance(torques, str):
        return []
    mean, turning, mixer = torques
    torque, turning_xy = mean @ mixer[:2].T, turning[:, :2]
    known = np.isfinite(turning_xy).all(axis=1)
    if not known.any() or not np.ptp(turning_xy[known], axis=0).all():
        return []
    each = turning_xy[known].std(axis=0) / np.maximum(np.nanstd(torque, axis=0), 1e-12)
    found = late_against(rows["time"][: len(mean)], turning_xy, torque * each)
    if found is None:
        return []
    # A mean over rows counts from their middle, half a row before that of the change of rate.
    step_s = float(np.median(np.diff(rows["time"])))
    late_s, error_s = found[0] - 0.5 * step_s, found[1]
    if abs(late_s) < max(LATE_S, CLEARLY * error_s):
        return []
    then = scores_of(*_shifted(mean, turning, round(late_s / step_s)), mixer)[AS_GIVEN][:2].min()
    now = {order: one[:2].min() for order, one in scores_of(mean, turning, mixer).items()}
    other = max(score for order, score in now.items() if order != AS_GIVEN)
    if then < max(SURELY, other + BETTER):
        return []
    size = f"{1e3 * abs(late_s):.0f} ms (± {1e3 * error_s:.1f} ms)"
    text = f"they are {size} late against the gyro"
    if late_s < 0.0:
        text = f"they are {size} early against the gyro, as commands are"
    fix = "stamp them with the time of their measurement, or --read motor=drop"
    return [_finding(text, late_s, fix)]


def _shifted(mean: np.ndarray, turning: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return thrusts that are `count` rows late, and torques, at the time of the torques."""
    if count < 0:
        return shift_rows(mean, -count), turning
    return mean, shift_rows(turning, count)


def _finding(text: str, size: float, fix: str) -> Finding:
    return Finding("doubt", "rotor speeds", text, "motor_telemetry", size, 0.95, fix)
