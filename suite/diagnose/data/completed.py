"""What a partial log lacks, from what it has: a quadrotor's path says how it leaned and turned.

Rates are those of the attitude. Where that is lacking as well: thrust is along body z, and in slow
flight nearly all of the force besides gravity, so the body's z axis is that of the path's
acceleration less gravity, and its turning that of this axis (differential flatness; Mellinger and
Kumar 2011). The yaw is taken for none. A force across the thrust cannot be told then, and rates
only as means over a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import interpolate
from tracks.geometry.rotation import rot_to_quat

SMOOTH_S = 0.1
"""Standard deviation of what smooths the path's acceleration [s]."""


def completed(log: FlightLog) -> FlightLog:
    """Return `log` with the attitude from its path and the rates from the attitude, if it has none.

    Raises:
        ValueError: for a log without positions.
    """
    if "pos" in log.partial:
        raise ValueError(f"{log.name}: no position: nothing says how it moved")
    if "quat" in log.partial:
        log = replace(log, quat_wxyz=np.asarray(rot_to_quat(_leaning(log))))
    if "rate" in log.partial:
        log = replace(log, rate_b=_turning(log.time_s, log.rot_w))
    return log


def _leaning(log: FlightLog) -> np.ndarray:
    """Return attitudes (N, 3, 3) whose z axis is along the path's acceleration less gravity."""
    step = float(np.median(np.diff(log.time_s)))
    if not np.isfinite(log.vel_w).any(axis=0).all():
        raise ValueError(f"{log.name}: no velocity and no positions to derive it from")
    vel_w = interpolate(log.time_s, log.time_s, log.vel_w)
    smooth = gaussian_filter1d(vel_w, SMOOTH_S / step, axis=0)
    acc_w = np.gradient(smooth, log.time_s, axis=0) + [0.0, 0.0, GRAVITY]
    up = acc_w / np.linalg.norm(acc_w, axis=1, keepdims=True)
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def _turning(time_s: np.ndarray, rot_w: np.ndarray) -> np.ndarray:
    """Return the body rates (N, 3) of attitudes (N, 3, 3)."""
    slope = np.gradient(rot_w, time_s, axis=0)
    spin = np.swapaxes(rot_w, 1, 2) @ slope
    return np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
