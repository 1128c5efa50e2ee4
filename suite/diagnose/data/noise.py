"""The measurement noise of every channel, from what changes too fast to be an error of a model."""

from __future__ import annotations

import numpy as np

from suite.diagnose.data.windows import CHANNELS, Windows

BLOCK = 20
"""Rows that a cubic is taken off: what is left of a model's error in 0.2 s is none."""
SHORT_BLOCK = 8
DEGREE = 3
LEAST = np.repeat([1e-5, 1e-5, 1e-4, 1e-4, 1e-3, 1e-2], [3, 3, 3, 3, 3, 4])
"""Noise below this is rounding and the model's steps, by channel in its unit."""


def rotor_noise(windows: Windows) -> float:
    """Return the noise of measured rotor speeds that are an input [rad/s], or too large a one.

    A cubic over few rows is taken off the speeds themselves: what the rotors truly do within
    30 ms counts as noise.
    """
    speeds = np.zeros(np.asarray(windows.seen).shape)
    speeds[..., 15:] = windows.row_rotor_speed
    seen = np.zeros(speeds.shape, dtype=bool)
    seen[..., 15:] = np.asarray(windows.seen)[..., 9:10]
    sigma = noise_of(speeds, windows._replace(seen=seen), SHORT_BLOCK)
    return float(np.sqrt((sigma[15:] ** 2).mean()))


def noise_of(residual: np.ndarray, windows: Windows, block: int = BLOCK) -> np.ndarray:
    """Return the standard deviation of the noise of each channel, (19,); NaN where none is seen.

    Args:
        residual: (W, N, 19) measured - simulated.
        windows: of the same rows.
        block: rows that a cubic is taken off.
    """
    sums: list[list[float]] = [[] for _ in range(CHANNELS)]
    freedom: list[list[int]] = [[] for _ in range(CHANNELS)]
    seen = np.asarray(windows.seen)
    for w in range(len(residual)):
        for first in range(0, residual.shape[1] - block + 1, block):
            rows = slice(first, first + block)
            time = np.asarray(windows.row_s)[w, rows]
            whole = seen[w, rows]
            for mask in {column.tobytes() for column in whole.T}:
                chosen = np.frombuffer(mask, dtype=bool)
                if chosen.sum() < DEGREE + 4:
                    continue
                channels = [c for c in range(CHANNELS) if whole[:, c].tobytes() == mask]
                values = residual[w, rows][chosen][:, channels]
                basis = np.linalg.qr(_powers(time[chosen]))[0]
                left = values - basis @ (basis.T @ values)
                for channel, power in zip(channels, (left**2).sum(axis=0), strict=True):
                    sums[channel].append(float(power))
                    freedom[channel].append(int(chosen.sum()) - DEGREE - 1)
    sigma = np.full(CHANNELS, np.nan)
    for c in range(CHANNELS):
        if sums[c]:
            n = np.array(freedom[c])
            # The median of chi-square over n is (1 - 2 / 9n)^3 (Wilson and Hilferty 1931).
            sigma[c] = np.sqrt(np.median(np.array(sums[c]) / n / (1.0 - 2.0 / (9.0 * n)) ** 3))
    return np.maximum(sigma, LEAST)


def _powers(time_s: np.ndarray) -> np.ndarray:
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.vander((time_s - time_s.mean()) / span, DEGREE + 1)
