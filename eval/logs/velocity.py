"""Velocity from positions with uneven sampling and gaps.

A cubic in time is fitted by least squares to the positions within 50 ms of each row (a
Savitzky-Golay derivative on uneven samples; Savitzky and Golay 1964), and its slope at the row is
the velocity. A cubic follows a change of acceleration, which a quadrotor makes within tens of
milliseconds, and eleven samples at 100 Hz average the noise: for white noise of s [m] in the
position the velocity's is about 29 s [m/s], against 71 s for a central difference.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

HALF_WINDOW_S = 0.05
"""Positions within this time of a row are used [s]; slower logs use the five nearest rows."""
GAP_STEPS = 6.0
"""Rows further away than this many median steps (and the half window) are not used."""
KEPT, KEPT_ROWS = 8, 20_000
"""The last results are kept, of logs with at most so many rows: checks repeat the same fit."""


def velocity_from_position(time_s: np.ndarray, pos_w: np.ndarray) -> np.ndarray:
    """Return the velocity at each row, (T, 3) [m/s].

    Args:
        time_s: (T,) increasing time [s].
        pos_w: (T, 3) position [m]; a row with a NaN gets the fit of its neighbours.

    Returns:
        (T, 3) velocity. Where fewer than four positions are near, the fit has a lower degree;
        where fewer than two are near, the velocity is NaN.
    """
    if len(time_s) > KEPT_ROWS or not time_s.dtype == pos_w.dtype == np.float64:
        return _fit(time_s, pos_w)
    return _kept_fit(time_s.tobytes(), pos_w.tobytes(), pos_w.shape).copy()


@lru_cache(maxsize=KEPT)
def _kept_fit(time_s: bytes, pos_w: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return `_fit` of arrays that are given by their bytes."""
    return _fit(np.frombuffer(time_s), np.frombuffer(pos_w).reshape(shape))


def _fit(time_s: np.ndarray, pos_w: np.ndarray) -> np.ndarray:
    """Return the velocity at each row; see `velocity_from_position`."""
    good = np.flatnonzero(np.isfinite(pos_w).all(axis=1))
    velocity = np.full(pos_w.shape, np.nan)
    if len(good) < 2:
        return velocity
    time, pos = time_s[good], pos_w[good]
    step = float(np.median(np.diff(time)))
    reach = max(HALF_WINDOW_S, GAP_STEPS * step)
    count = int(np.clip(2 * np.floor(HALF_WINDOW_S / step) + 1, 5, 101))
    # Neighbours are found among good rows by index; rows beyond `reach` have zero weight.
    nearest = np.searchsorted(time, time_s)
    first = np.clip(nearest - count // 2, 0, max(len(time) - count, 0))
    moment = np.zeros((7, len(time_s)))
    right = np.zeros((4, 3, len(time_s)))
    used = np.zeros(len(time_s))
    origin = pos[np.clip(nearest, 0, len(time) - 1)].T  # keeps digits where positions are large
    # Sums of the normal equations, in u = time from the row over `reach` (from -1 to 1).
    for offset in range(min(count, len(time))):
        k = first + offset
        u = (time[k] - time_s) / reach
        powers = np.empty_like(moment)
        powers[0] = np.abs(u) <= 1
        for n in range(6):
            powers[n + 1] = powers[n] * u
        moment += powers
        right += powers[:4, None] * (pos[k].T - origin)
        used += powers[0]
    degree = np.minimum(used - 1, 3)
    for n in (1, 2, 3):
        rows = np.flatnonzero(degree == n)
        index = np.arange(n + 1)
        normal = np.moveaxis(moment[index[:, None] + index], -1, 0)[rows]
        coefficient = np.linalg.solve(normal, np.moveaxis(right[: n + 1], -1, 0)[rows])
        velocity[rows] = coefficient[:, 1] / reach
    return velocity
