"""Measurement noise of every channel: residuals that change too fast for a model error."""

from __future__ import annotations

import numpy as np

from suite.diagnose.data.windows import CHANNELS, SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def rotor_noise(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return the noise of measured rotor speeds that are an input [rad/s], or too large a one.

    A cubic over few of their own rows is taken off the speeds themselves: what the rotors truly do
    within 30 ms counts as noise.
    """
    rotors = SLICES["rotor speed"]
    speeds = np.zeros(np.asarray(windows.seen).shape)
    speeds[..., rotors] = windows.row_rotor_speed
    seen = np.zeros(speeds.shape, dtype=bool)
    seen[..., rotors] = windows.rotor_seen
    sigma = noise_of(speeds, windows._replace(seen=seen), limits.rotor_noise_rows, limits)
    return float(np.sqrt((sigma[rotors] ** 2).mean()))


def noise_of(
    residual: np.ndarray,
    windows: FlightWindows,
    rows_together: int | None = None,
    limits: Thresholds = THRESHOLDS,
) -> np.ndarray:
    """Return the standard deviation of each channel's noise, (19,) in its unit; NaN where unseen.

    `residual` (W, N, 19) is measured - simulated in `windows`; a polynomial is taken off
    `rows_together` of a channel's own rows at a time, by default `limits.noise_rows`, or off all of
    a window where it has fewer. A channel with too few rows for that in every window is given the
    RMS of its residuals, which no noise exceeds.
    """
    block, degree = rows_together or limits.noise_rows, limits.noise_degree
    power: list[list[float]] = [[] for _ in range(CHANNELS)]
    freedom: list[list[int]] = [[] for _ in range(CHANNELS)]
    seen = np.asarray(windows.seen)
    for w in range(len(residual)):
        for mask in {column.tobytes() for column in seen[w].T}:
            own = np.flatnonzero(np.frombuffer(mask, dtype=bool))
            channels = [c for c in range(CHANNELS) if seen[w, :, c].tobytes() == mask]
            count = min(block, len(own))
            if count < degree + 4:
                continue
            for first in range(0, len(own) - count + 1, count):
                rows = own[first : first + count]
                values = residual[w, rows][:, channels]
                basis = np.linalg.qr(_powers(np.asarray(windows.row_s)[w, rows], degree))[0]
                left = values - basis @ (basis.T @ values)
                for channel, energy in zip(channels, (left**2).sum(axis=0), strict=True):
                    power[channel].append(float(energy))
                    freedom[channel].append(count - degree - 1)
    sigma = np.full(CHANNELS, np.nan)
    for c in range(CHANNELS):
        if power[c]:
            n = np.array(freedom[c])
            sigma[c] = np.sqrt(typical_variance(np.array(power[c]), n))
        elif seen[..., c].any():
            sigma[c] = np.sqrt((residual[..., c][seen[..., c]] ** 2).mean())
    return at_least(sigma, limits)


def at_least(sigma: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return noise `sigma` (19,), at least that of rounding and of the model's steps."""
    return np.maximum(sigma, np.repeat(limits.least_noise, [3, 3, 3, 3, 3, 4]))


def typical_variance(energy: np.ndarray, freedom: np.ndarray | int) -> np.ndarray:
    """Return the variance of noise whose `energy` (V, ...) has so many degrees of freedom.

    It is that of the median, so that a few bad blocks do not decide: the median of chi-square over
    n is (1 - 2 / 9n)^3 (Wilson and Hilferty 1931).
    """
    return np.median(energy / freedom / (1.0 - 2.0 / (9.0 * freedom)) ** 3, axis=0)


def noise_like(speed: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return simulated noise (T, R) of the size of each rotor's `speed` noise; NaN where that is.

    It shows what the real noise does to sums over rows. Noise is the residual of a cubic over a few
    of a rotor's own rows; a rotor with too few rows gets none.
    """
    draw = np.random.default_rng(0).standard_normal(speed.shape)
    out = np.full(speed.shape, np.nan)
    for k, column in enumerate(speed.T):
        own = np.flatnonzero(np.isfinite(column))
        out[own, k] = _rotor_sigma(column[own], limits) * draw[: len(own), k]
    return out


def _rotor_sigma(speed: np.ndarray, limits: Thresholds) -> float:
    block, degree = limits.rotor_noise_rows, limits.noise_degree
    blocks = speed[: len(speed) // block * block].reshape(-1, block)
    if not len(blocks):
        return 0.0
    basis = np.linalg.qr(_powers(np.arange(block, dtype=float), degree))[0]
    left = blocks - blocks @ basis @ basis.T
    return float(np.sqrt(typical_variance((left**2).sum(axis=1), block - degree - 1)))


def _powers(time_s: np.ndarray, degree: int) -> np.ndarray:
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.vander((time_s - time_s.mean()) / span, degree + 1)
