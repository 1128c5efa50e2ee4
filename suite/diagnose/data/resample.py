"""A log's series at other times, and the rotors' lag behind them."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def interpolate(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return `series` (T, K) at `at_s` (S,), linear between what is finite; 0 where nothing is."""
    columns = []
    for column in series.T:
        good = np.isfinite(column)
        columns.append(np.interp(at_s, time_s[good], column[good]) if good.any() else 0.0 * at_s)
    return np.stack(columns, axis=-1)


def hold(at_s: np.ndarray, time_s: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the last finite row of `series` (T, K) at each of `at_s` (S,); NaN where is none.

    Before the first row that one is held.
    """
    good = np.flatnonzero(np.isfinite(series).all(axis=1))
    if not len(good):
        return np.full((len(at_s), series.shape[1]), np.nan)
    held = np.searchsorted(time_s[good], at_s + 1e-7, side="right") - 1
    return series[good[np.maximum(held, 0)]]


def follow_lag(wanted: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return first-order rotor speeds (S, 4) at the end of each step of `dt` [s].

    They begin as wanted in the first step.
    """
    left = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    return np.asarray(lfilter([1.0 - left], [1.0, -left], wanted, axis=0, zi=left * wanted[:1])[0])
