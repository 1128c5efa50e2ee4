"""Estimates each channel's measurement noise from residuals that change too fast for a model.

A polynomial is subtracted from a few consecutive rows at a time; the remainder is noise.
"""

from __future__ import annotations

import numpy as np

from suite.diagnose.data.windows import CHANNELS, SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def rotor_noise(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return an upper limit of the noise of measured rotor speeds that are an input [rad/s].

    There are no residuals, so a cubic over few rows is subtracted from the speeds themselves: their
    true changes within 30 ms count as noise.
    """
    rotors = SLICES["rotor speed"]
    speeds = np.zeros(np.asarray(windows.valid).shape)
    speeds[..., rotors] = windows.row_rotor_speed
    valid = np.zeros(speeds.shape, dtype=bool)
    valid[..., rotors] = windows.rotor_valid
    sigma = noise_of(speeds, windows._replace(valid=valid), limits.rotor_noise_rows, limits)
    return float(np.sqrt((sigma[rotors] ** 2).mean()))


def noise_of(
    residual: np.ndarray,
    windows: FlightWindows,
    rows_together: int | None = None,
    limits: Thresholds = THRESHOLDS,
) -> np.ndarray:
    """Return the standard deviation (19,) of each channel's noise, in its unit.

    NaN where nothing was measured. A channel with too few rows in every window gets the RMS of its
    residuals, which is an upper limit.

    Args:
        residual: (W, N, 19) measured - simulated.
        windows: W stretches of 1 s.
        rows_together: rows of a channel from which one polynomial is subtracted; by default
            `limits.noise_rows`, or all rows of a window where it has fewer.
        limits: degree of the polynomial, and least noise.
    """
    block, degree = rows_together or limits.noise_rows, limits.noise_degree
    power: list[list[float]] = [[] for _ in range(CHANNELS)]
    freedom: list[list[int]] = [[] for _ in range(CHANNELS)]
    valid = np.asarray(windows.valid)
    for w in range(len(residual)):
        for mask in {column.tobytes() for column in valid[w].T}:  # channels with the same rows
            own = np.flatnonzero(np.frombuffer(mask, dtype=bool))
            channels = [c for c in range(CHANNELS) if valid[w, :, c].tobytes() == mask]
            count = min(block, len(own))
            if count < degree + 4:
                continue
            for first in range(0, len(own) - count + 1, count):
                rows = own[first : first + count]
                values = residual[w, rows][:, channels]
                basis = np.linalg.qr(_powers(np.asarray(windows.row_s)[w, rows], degree))[0]
                remainder = values - basis @ (basis.T @ values)
                for channel, energy in zip(channels, (remainder**2).sum(axis=0), strict=True):
                    power[channel].append(float(energy))
                    freedom[channel].append(count - degree - 1)
    sigma = np.full(CHANNELS, np.nan)
    for c in range(CHANNELS):
        if power[c]:
            n = np.array(freedom[c])
            sigma[c] = np.sqrt(typical_variance(np.array(power[c]), n))
        elif valid[..., c].any():
            sigma[c] = np.sqrt((residual[..., c][valid[..., c]] ** 2).mean())
    return at_least(sigma, limits)


def at_least(sigma: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return noise `sigma` (19,), raised to that of rounding and of the model's time steps."""
    return np.maximum(sigma, np.repeat(limits.least_noise, [3, 3, 3, 3, 3, 4]))


def typical_variance(energy: np.ndarray, freedom: np.ndarray | int) -> np.ndarray:
    """Return the variance of noise from the `energy` (V, ...) of blocks with `freedom` each.

    It follows from the median, so that a few bad blocks do not matter: the median of chi-square
    with n degrees of freedom, over n, is (1 - 2 / 9n)^3 (Wilson and Hilferty 1931).
    """
    return np.median(energy / freedom / (1.0 - 2.0 / (9.0 * freedom)) ** 3, axis=0)


def noise_like(speed: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return simulated noise (T, R) of the same size as that in the rotor speeds `speed` (T, R).

    It shows the effect of the real noise on sums over rows. The noise is the remainder of a cubic
    over a few of a rotor's own rows; zero with too few rows, and NaN where the speed is NaN.
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
    remainder = blocks - blocks @ basis @ basis.T
    return float(np.sqrt(typical_variance((remainder**2).sum(axis=1), block - degree - 1)))


def _powers(time_s: np.ndarray, degree: int) -> np.ndarray:
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.vander((time_s - time_s.mean()) / span, degree + 1)
