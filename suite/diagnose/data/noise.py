"""Estimates the measurement noise of each channel from the fast part of its residuals.

A model's error is smooth, noise is not. So a polynomial is subtracted from a few consecutive rows
at a time, and the remainder is noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.data.windows import CHANNELS, SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class Linearisation(NamedTuple):
    """Residuals of W windows, and derivatives (slopes) of the simulated values by K numbers."""

    residual: np.ndarray
    """(W, N, 19) measured - simulated; zero where nothing was measured."""
    slope: np.ndarray
    """(W, N, 19, K) derivative of the simulated values; often the last F are by the start numbers,
    of which the first 12 are the start state."""
    offset: np.ndarray
    """(W, F) correction of each window's start numbers with which the residuals were computed."""
    windows: FlightWindows
    """The windows."""


def rotor_noise(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return an upper limit of the noise of measured rotor speeds that are an input [rad/s].

    An input has no residuals, so the polynomial is subtracted from the speeds themselves. True
    changes of the speeds that are too fast for it count as noise; hence an upper limit.
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
    """Return the standard deviation (19,) of each channel's noise in `residual` (W, N, 19).

    NaN where nothing was measured. A channel with too few rows in every window gets the RMS of its
    residuals, which is an upper limit. One polynomial is subtracted from `rows_together` rows of a
    channel, by default `limits.noise_rows`, or from all rows of a window with fewer rows.
    """
    block_rows, degree = rows_together or limits.noise_rows, limits.noise_degree
    power: list[list[float]] = [[] for _ in range(CHANNELS)]
    freedom: list[list[int]] = [[] for _ in range(CHANNELS)]
    valid = np.asarray(windows.valid)
    # For each window, and each set of channels that were measured in the same rows.
    for w in range(len(residual)):
        for mask in {column.tobytes() for column in valid[w].T}:
            channel_rows = np.flatnonzero(np.frombuffer(mask, dtype=bool))
            channels = [c for c in range(CHANNELS) if valid[w, :, c].tobytes() == mask]
            count = min(block_rows, len(channel_rows))
            if count < degree + 4:
                continue
            for begin in range(0, len(channel_rows) - count + 1, count):
                rows = channel_rows[begin : begin + count]
                values = residual[w, rows][:, channels]
                basis = np.linalg.qr(_powers(np.asarray(windows.row_s)[w, rows], degree))[0]
                remainder = values - basis @ (basis.T @ values)
                for channel, energy in zip(channels, (remainder**2).sum(axis=0), strict=True):
                    power[channel].append(float(energy))
                    freedom[channel].append(count - degree - 1)
    sigma = np.full(CHANNELS, np.nan)
    for c in range(CHANNELS):
        if power[c]:
            freedoms = np.array(freedom[c])
            sigma[c] = np.sqrt(typical_variance(np.array(power[c]), freedoms))
        elif valid[..., c].any():
            sigma[c] = np.sqrt((residual[..., c][valid[..., c]] ** 2).mean())
    return at_least(sigma, limits)


def at_least(sigma: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return the noise `sigma` (19,), raised to a lower limit by rounding and the model's steps."""
    return np.maximum(sigma, np.repeat(limits.least_noise, [3, 3, 3, 3, 3, 4]))


def typical_variance(energy: np.ndarray, freedom: np.ndarray | int) -> np.ndarray:
    """Return the variance of noise from sums of squares `energy` (V, ...) with `freedom` each.

    It follows from their median, so that a few bad ones do not matter. The median of chi-square
    with n degrees of freedom, divided by n, is (1 - 2 / 9n)^3 (Wilson and Hilferty 1931).
    """
    return np.median(energy / freedom / (1.0 - 2.0 / (9.0 * freedom)) ** 3, axis=0)


def noise_like(speed: np.ndarray, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return simulated noise (T, R) of the same size as the noise of rotor speeds `speed` (T, R).

    It is zero with too few rows, and NaN where the speed is NaN.
    """
    draw = np.random.default_rng(0).standard_normal(speed.shape)
    noise = np.full(speed.shape, np.nan)
    block, degree = limits.rotor_noise_rows, limits.noise_degree
    basis = np.linalg.qr(_powers(np.arange(block, dtype=float), degree))[0]
    for k, column in enumerate(speed.T):
        rows = np.flatnonzero(np.isfinite(column))
        blocks = column[rows[: len(rows) // block * block]].reshape(-1, block)
        energy, sigma = ((blocks - blocks @ basis @ basis.T) ** 2).sum(axis=1), 0.0
        if len(energy):
            sigma = float(np.sqrt(typical_variance(energy, block - degree - 1)))
        noise[rows, k] = sigma * draw[: len(rows), k]
    return noise


def _powers(time_s: np.ndarray, degree: int) -> np.ndarray:
    """Return the powers (N, degree + 1) of scaled times, the terms of a polynomial."""
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.vander((time_s - time_s.mean()) / span, degree + 1)
