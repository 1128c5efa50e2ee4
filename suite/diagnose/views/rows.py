"""A flight as rows of what acts and what moves, whole or with gaps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from tracks.geometry.scene import Array


class FlightRows(NamedTuple):
    """N rows of one flight; those that miss something are filled and not `good`."""

    time_s: Array
    """(N,) since the flight's first row [s]."""
    pos_w: Array
    """(N, 3) [m]."""
    rot_w: Array
    """(N, 3, 3) body to world."""
    vel_w: Array
    """(N, 3) [m/s]."""
    rate_b: Array
    """(N, 3) [rad/s]."""
    rotor_speed: Array
    """(N, 4) that act then [rad/s]."""
    voltage_drop: Array
    """(N,) battery voltage at the start less now [V]; zeros where there is none."""
    good: Array
    """(N,) bool: nothing is missing."""


def rows_of(log: FlightLog, rotor_speed: np.ndarray) -> FlightRows:
    """Return the rows of `log` under rotors that turn with `rotor_speed` (N, 4) [rad/s]."""
    rot_w = log.rot_w
    parts = (log.pos_w, log.vel_w, log.rate_b, rotor_speed)
    good = np.isfinite(np.concatenate(parts, axis=1)).all(axis=1)
    good &= np.isfinite(rot_w).all(axis=(1, 2))
    drop = np.zeros(len(good))
    if log.voltage is not None and np.isfinite(log.voltage).any():
        known = np.flatnonzero(np.isfinite(log.voltage))
        now = np.interp(log.time_s, log.time_s[known], log.voltage[known])
        drop = now[0] - now
    pos_w, vel_w, rate_b, speed = (np.nan_to_num(part) for part in parts)
    rot_w = np.where(np.isfinite(rot_w), rot_w, np.eye(3))
    since = log.time_s - log.time_s[0]
    return FlightRows(since, pos_w, rot_w, vel_w, rate_b, speed, drop, good)
