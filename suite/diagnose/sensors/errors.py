"""Errors of an on-board state estimate in a flight log, compared with the log's reference pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from eval.logs.columns import ESTIMATE, GROUPS, FlightLogError
from eval.logs.flight_log import FlightLog
from suite.diagnose.identify.grid import attitude_on, joined
from tracks.geometry.rotation import to_local

PARTS = {"position": "pos", "velocity": "vel", "attitude": "quat"}
"""Parts of the state, three axes each, and the columns that hold them."""
SLOPE_ROWS = 15
"""The reference is differentiated over so many rows."""
SETTLES_S = 2.0
"""Time left out after the first row and before the last: the vehicle is near the ground [s]."""
LEAST_S = 8.0
"""Least length of a flight, as the errors last for seconds [s]."""


class Errors(NamedTuple):
    """Errors of the estimate in one flight on an even grid; NaN where something is missing."""

    name: str
    step_s: float
    value: np.ndarray
    """(T, 9) estimate - reference: position in the world, velocity and attitude in the body."""
    slope: np.ndarray
    """(T, 9) of the reference over time, in the same axes."""
    vel_b: np.ndarray
    """(T, 3) of the reference [m/s]."""


def errors_of(log: FlightLog, late_s: float = 0.0) -> Errors:
    """Return the errors of the estimate in `log` relative to the reference `late_s` earlier [s].

    Raises:
        FlightLogError: where the log holds no estimate, or no reference for it.
    """
    there = [part for part, group in PARTS.items() if _estimate(log, group) is not None]
    if not there:
        reason = (
            "no on-board estimate: no columns est_pos_x, est_vel_x or est_quat_w. suite import "
            'keeps them where the mapping file has [[pos]] of source = "mocap" and of source = '
            '"estimate", as nanobench has'
        )
        raise FlightLogError(log.name, None, None, reason)
    for group, values in (("pos", log.pos_w), ("quat", log.quat_wxyz)):
        if not np.isfinite(values).any():
            reason = f"no reference for the estimate: {GROUPS[group][0]} is missing in every row"
            raise FlightLogError(log.name, GROUPS[group][0], None, reason)
    step_s = float(np.median(np.diff(log.time_s)))
    grid = np.arange(log.time_s[0], log.time_s[-1] + 0.5 * step_s, step_s)
    grid = grid[(grid >= grid[0] + SETTLES_S) & (grid <= grid[-1] - SETTLES_S)]
    if len(grid) < LEAST_S / step_s:
        reason = (
            f"{log.duration_s:.1f} s of flight; allowed are {LEAST_S + 2 * SETTLES_S:g} s or more"
        )
        raise FlightLogError(log.name, None, None, reason)
    then = grid - late_s
    vel_w = joined(log.time_s, log.vel_w, then)
    rot_w = attitude_on(log.time_s, log.quat_wxyz, then)
    value, nothing = np.full((len(grid), 9), np.nan), np.full((len(grid), 3), np.nan)
    for k, (part, group) in enumerate(PARTS.items()):
        if part not in there:
            continue
        own = _estimate(log, group)
        assert own is not None
        if group == "quat":
            estimate = attitude_on(log.time_s, own, grid)
            off = rotation_between(rot_w, estimate)
        else:
            reference = log.pos_w if group == "pos" else log.vel_w
            off = joined(log.time_s, own, grid) - joined(log.time_s, reference, then)
            off = to_local(rot_w, off) if group == "vel" else off
        value[:, 3 * k : 3 * k + 3] = off
    acc_b = to_local(rot_w, _differentiated(vel_w, step_s))
    rate_b = joined(log.time_s, log.rate_b, then) if np.isfinite(log.rate_b).any() else nothing
    slope = np.concatenate([vel_w, acc_b, rate_b], axis=1)
    return Errors(log.name, step_s, value, slope, to_local(rot_w, vel_w))


def rotation_between(rot_w: np.ndarray, other_w: np.ndarray) -> np.ndarray:
    """Return the vector (T, 3) of the turn from `rot_w` to `other_w`, in the body; NaN is kept."""
    turn = np.matmul(np.swapaxes(rot_w, -1, -2), other_w)
    good = np.isfinite(turn).all(axis=(1, 2))
    out = np.full((len(turn), 3), np.nan)
    if good.any():
        out[good] = Rotation.from_matrix(turn[good]).as_rotvec()
    return out


def _estimate(log: FlightLog, group: str) -> np.ndarray | None:
    """Return the estimate's columns (T, C) of a group where they are all there."""
    columns = [log.extra.get(f"{ESTIMATE}{name}") for name in GROUPS[group]]
    if any(column is None or np.asarray(column).dtype.kind not in "fiu" for column in columns):
        return None
    values = np.stack([np.asarray(column, float) for column in columns], axis=1)
    return values if np.isfinite(values).all(axis=1).sum() > 1 else None


def _differentiated(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the slope (T, C) of a parabola over `SLOPE_ROWS` rows; NaN near holes."""
    if len(values) < SLOPE_ROWS:
        return np.full_like(values, np.nan)
    how = {"deriv": 1, "delta": step_s, "axis": 0, "mode": "nearest"}
    return np.asarray(savgol_filter(values, SLOPE_ROWS, 2, **how))
