"""Whitens residuals of windows (1 s stretches of flights) and projects out their start states.

Whitened residuals are in units of independent noise. A window's start state is measured with the
same noise as its other rows, so it is a nuisance parameter: the effect of its 12 numbers is
projected out of residuals and slopes. Errors of the rotor speeds are nuisance parameters too, with
a prior on their size in additional rows: at knots (support points) all along a window where
measured speeds are the model's input, else at its start.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from suite.diagnose.data.colour import Noise, colour_filter
from suite.diagnose.data.noise import rotor_noise
from suite.diagnose.data.windows import (
    KNOTS,
    SLICES,
    STATE,
    FlightWindows,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class Linearisation(NamedTuple):
    """Residuals of W windows and their slopes along K directions."""

    residual: np.ndarray
    """(W, N, 19) measured - simulated; zero where nothing was measured."""
    slope: np.ndarray
    """(W, N, 19, K) of the simulated values. The last F are often along the start numbers."""
    offset: np.ndarray
    """(W, F) correction of each window's start numbers (state and rotor speeds), at which the
    residuals were computed."""

    @property
    def start_slope(self) -> np.ndarray:
        """(W, N, 19, 12) slopes along each window's start state, if the last F are as above."""
        size = self.offset.shape[1]
        return self.slope[..., self.slope.shape[-1] - size :][..., :STATE]


class Whitening(NamedTuple):
    """Whitening of W windows, with M rows and F nuisance parameters (start numbers) each."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    prior: np.ndarray
    """(F - 12,) 1 / standard deviation of each error of the rotor speeds; the last of M rows."""
    start: np.ndarray
    """(W, M, F) orthonormal basis of the rows' changes by the start numbers."""
    upper: np.ndarray
    """(W, F, F) upper triangular, from start numbers to coordinates in that basis."""
    slow: np.ndarray
    """(W, 19, N, L) unit errors that change slowly over a window (polynomials), by channel."""
    slow_freedom: np.ndarray
    """(W, 19) expected energy along them by noise alone, by channel."""
    filters: Mapping[str, np.ndarray]
    """(W, N, N) by group of channels with autocorrelated noise: takes rows over their standard
    deviation to independent ones."""


def make_whitening(
    linear: Linearisation,
    noise: Noise,
    windows: FlightWindows,
    limits: Thresholds = THRESHOLDS,
) -> Whitening:
    """Return the whitening of `windows` by `noise`.

    The last slopes in `linear` must be those along the start numbers.
    """
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 1.0)
    weight = np.where(windows.valid, 1.0 / sigma, 0.0)
    filters = {name: colour_filter(noise, name, windows) for name in noise.coloured}
    count, rows, channels = weight.shape
    size = linear.offset.shape[1]
    prior = np.full(size - STATE, 1.0 / rotor_spread(windows, limits))
    slope = _filtered(linear.slope[..., -size:] * weight[..., None], filters)
    slope = slope.reshape(count, -1, size)
    held = np.zeros((count, size - STATE, size))
    held[:, :, STATE:] = np.diag(prior)
    start, upper = orthonormal(np.concatenate([slope, held], axis=1), limits.singular)
    upper = upper + 1e-9 * np.eye(size)
    time = 2.0 * np.asarray(windows.row_s)[..., None] - 1.0
    degrees = range(limits.slow_degree + 1)
    power = np.concatenate([eval_legendre(degree, time) for degree in degrees], axis=-1)
    slow = np.moveaxis((weight > 0)[..., None] * power[:, :, None], 1, 2)
    slow = slow / np.maximum(np.linalg.norm(slow, axis=2, keepdims=True), 1e-9)
    measured = start[:, : rows * channels].reshape(count, rows, channels, size)
    taken = np.moveaxis(measured, 1, 3) @ slow
    slow_freedom = (slow**2).sum(axis=(2, 3)) - (taken**2).sum(axis=(2, 3))
    return Whitening(weight, prior, start, upper, slow, slow_freedom, filters)


def orthonormal(matrix: np.ndarray, singular: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and upper triangular R of `matrix` (..., M, F), M much larger than F.

    Cholesky's factor of the Gram matrix, twice (CholeskyQR2; Yamamoto et al. 2015): for so tall a
    matrix it is faster than Householder's reflections. These are used where a column is nearly
    dependent on the others, with a remainder of less than `singular`.
    """
    size = np.maximum(np.linalg.norm(matrix, axis=-2, keepdims=True), 1e-300)
    base, upper = matrix / size, np.swapaxes(size, -1, -2) * np.eye(matrix.shape[-1])
    for _ in range(2):
        try:
            lower = np.linalg.cholesky(np.swapaxes(base, -1, -2) @ base)
        except np.linalg.LinAlgError:
            return np.linalg.qr(matrix)
        factor = np.swapaxes(lower, -1, -2)
        if np.einsum("...kk->...k", factor).min() < singular:
            return np.linalg.qr(matrix)
        base, upper = base @ np.linalg.inv(factor), factor @ upper
    return base, upper


def rotor_spread(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return the standard deviation of the rotor speeds' errors as nuisance parameters [rad/s].

    Where measured speeds are the input, white noise of rows is equivalent to errors that are linear
    between knots 0.1 s apart, smaller by the root of the number of rows a knot. Else the errors are
    those at the start.
    """
    start = np.asarray(windows.start_rotor_error)
    if start.all():
        return float(np.sqrt((start**2).mean()))
    rows = np.asarray(windows.rotor_valid).sum(axis=1).min(axis=-1).mean()
    noise = rotor_noise(windows, limits)
    return limits.rotor_knot_excess * noise * float(np.sqrt((KNOTS - 1) / max(rows, 1.0)))


def whiten(whitening: Whitening, values: np.ndarray) -> np.ndarray:
    """Return `values` (W, N, 19, K) in units of noise (W, M, K), zeros in the prior's rows."""
    count, rows, channels, directions = values.shape
    scaled = _filtered(values * whitening.weight[..., None], whitening.filters)
    flat = scaled.reshape(count, rows * channels, directions)
    prior_rows = np.zeros((count, len(whitening.prior), directions))
    return np.concatenate([flat, prior_rows], axis=1)


def _filtered(scaled: np.ndarray, filters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return rows over their standard deviation (W, N, 19, K), made independent in place."""
    count, rows, _, directions = scaled.shape
    for name, matrix in filters.items():
        group = scaled[:, :, SLICES[name]]
        flat = matrix @ group.reshape(count, rows, group.shape[2] * directions)
        scaled[:, :, SLICES[name]] = flat.reshape(group.shape)
    return scaled


def project_out_start(whitening: Whitening, white: np.ndarray) -> np.ndarray:
    """Return the whitened rows `white` (W, M, K) without the part that start numbers explain."""
    return white - whitening.start @ (np.swapaxes(whitening.start, 1, 2) @ white)


def slow_energy(whitening: Whitening, residual: np.ndarray) -> np.ndarray:
    """Return the energy (W, 19) of slow errors in a block's `residual` (W, M), by channel.

    The start numbers are projected out of the residual, and so need not be out of slow errors.
    """
    rows = residual[:, : whitening.weight[0].size].reshape(whitening.weight.shape)
    amplitude = (np.swapaxes(rows, 1, 2)[:, :, None] @ whitening.slow)[:, :, 0]
    return (amplitude**2).sum(axis=2)


def whitened_residual(whitening: Whitening, linear: Linearisation) -> np.ndarray:
    """Return the residuals of `linear` in units of noise, (W, M, 1), with those of the prior."""
    white = whiten(whitening, linear.residual[..., None])
    if len(whitening.prior):
        white[:, -len(whitening.prior) :, 0] = -linear.offset[:, STATE:] * whitening.prior
    return white
