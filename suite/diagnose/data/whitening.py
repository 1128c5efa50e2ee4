"""Whitens residuals of windows (1 s stretches of flights) and projects out their start states.

A window's start state is measured with the same noise as its other rows. So it is a nuisance
parameter: what a change of its 12 numbers could explain is removed (projected out) from residuals
and slopes. Errors of the rotor speeds are nuisance parameters, too. If measured speeds are the
model's input, they have errors at knots all along a window, else only at its start. If the drone
received commands that the log lacks, an unknown thrust and torque at the knots are nuisance
parameters as well. Additional rows hold a prior on the size of these errors. Start numbers are all
these parameters of a window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from suite.diagnose.data.noise import Linearisation, Noise, colour_filter, rotor_noise
from suite.diagnose.data.windows import KNOTS, SLICES, STATE, FlightWindows
from suite.diagnose.estimate.block import Block
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

LEAST_PUSH = 1e-3
"""Lower limit of the error of thrust [m/s^2] and torque [rad/s^2]."""


class Whitening(NamedTuple):
    """What whitens W windows. Each has M whitened rows and F start numbers."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    prior: np.ndarray
    """(W, F - 12) 1 / standard deviation of each error of the inputs, which the last rows hold."""
    start: np.ndarray
    """(W, M, F) orthonormal basis of the changes of the rows by the start numbers."""
    upper: np.ndarray
    """(W, F, F) upper triangular matrix from start numbers to coordinates in that basis."""
    slow: np.ndarray
    """(W, 19, N, L) polynomials of unit length over the rows of each channel (slow errors)."""
    slow_freedom: np.ndarray
    """(W, 19) sum of squares along these polynomials that noise alone gives, by channel."""
    filters: Mapping[str, np.ndarray]
    """Group of channels with autocorrelated noise -> (W, N, N) matrices that make its rows
    independent, after a division by the standard deviation."""


def make_whitening(linear: Linearisation, noise: Noise, limits: Thresholds) -> Whitening:
    """Return the whitening of the windows in `linear` by `noise`.

    The last F slopes in `linear` must be those along the start numbers.
    """
    windows = linear.windows
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 1.0)
    weight = np.where(windows.valid, 1.0 / sigma, 0.0)
    filters = {name: colour_filter(noise, name, windows) for name in noise.coloured}
    count, rows, channels = weight.shape
    size = linear.offset.shape[1]
    # Basis of what the start numbers can change, with the rows of the prior.
    prior = 1.0 / input_spread(windows, size, limits)
    slope = _filtered(linear.slope[..., -size:] * weight[..., None], filters)
    slope = slope.reshape(count, -1, size)
    prior_rows = np.zeros((count, size - STATE, size))
    prior_rows[:, :, STATE:] = prior[:, :, None] * np.eye(size - STATE)
    start, upper = orthonormal(np.concatenate([slope, prior_rows], axis=1), limits.singular)
    upper = upper + 1e-9 * np.eye(size)
    # Slow errors: Legendre polynomials over the window. The part of them that start numbers explain
    # is expected to be absent from the residual.
    time = 2.0 * np.asarray(windows.row_s)[..., None] - 1.0
    degrees = range(limits.slow_degree + 1)
    power = np.concatenate([eval_legendre(degree, time) for degree in degrees], axis=-1)
    slow = np.moveaxis((weight > 0)[..., None] * power[:, :, None], 1, 2)
    slow = slow / np.maximum(np.linalg.norm(slow, axis=2, keepdims=True), 1e-9)
    measured = start[:, : rows * channels].reshape(count, rows, channels, size)
    explained = np.moveaxis(measured, 1, 3) @ slow
    slow_freedom = (slow**2).sum(axis=(2, 3)) - (explained**2).sum(axis=(2, 3))
    return Whitening(weight, prior, start, upper, slow, slow_freedom, filters)


def orthonormal(matrix: np.ndarray, singular: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and upper triangular R of `matrix` (..., M, F), M much larger than F.

    Cholesky's factor of the Gram matrix is used twice (CholeskyQR2; Yamamoto et al. 2015), faster
    than Householder's reflections. These are used where a column has an independent share of less
    than `singular`.
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


def input_spread(windows: FlightWindows, size: int, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return the standard deviations (W, F - 12) of the inputs' errors; `size` is F."""
    spread = np.full((len(windows.flight), size - STATE), rotor_spread(windows, limits))
    if size == STATE + 4 + 4 * KNOTS:
        spread[:, 4:] = np.tile(np.maximum(windows.push_error, LEAST_PUSH), (1, KNOTS))
    return spread


def rotor_spread(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return the standard deviation of the rotor speeds' errors as nuisance parameters [rad/s].

    Errors of measured speeds as the input are linear between knots 0.1 s apart. They are smaller
    than the white noise of the rows by the root of the rows per knot.
    """
    start = np.asarray(windows.start_rotor_error)
    if start.all():
        return float(np.sqrt((start**2).mean()))
    rows = np.asarray(windows.rotor_valid).sum(axis=1).min(axis=-1).mean()
    noise = rotor_noise(windows, limits)
    return limits.rotor_knot_excess * noise * float(np.sqrt((KNOTS - 1) / max(rows, 1.0)))


def block_of(whitening: Whitening, linear: Linearisation, along: Sequence[int]) -> Block:
    """Return the block of `linear`, without the part that start numbers explain.

    `along` are the parameters of its first slopes.
    """
    # Whiten residuals and slopes, and add the rows of the prior: their residuals are the changes of
    # the rotor speeds, their slopes 0.
    values = np.concatenate([linear.residual[..., None], linear.slope[..., : len(along)]], axis=-1)
    rows = _filtered(values * whitening.weight[..., None], whitening.filters)
    rows = rows.reshape(len(rows), -1, rows.shape[-1])
    prior_rows = np.zeros((len(rows), whitening.prior.shape[1], rows.shape[-1]))
    prior_rows[..., 0] = -linear.offset[:, STATE:] * whitening.prior
    rows = np.concatenate([rows, prior_rows], axis=1)
    start_part = np.swapaxes(whitening.start, 1, 2) @ rows
    start_change = np.linalg.solve(whitening.upper, start_part)
    rows = rows - whitening.start @ start_part
    return Block(
        rows[..., 0],
        rows[..., 1:],
        tuple(along),
        np.asarray(linear.windows.flight),
        np.asarray(linear.windows.start_s),
        start_change[..., 0],
        start_change[..., 1:],
    )


def _filtered(scaled: np.ndarray, filters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Make rows `scaled` (W, N, 19, K), over their standard deviation, independent in place."""
    count, rows, _, directions = scaled.shape
    for name, matrix in filters.items():
        group = scaled[:, :, SLICES[name]]
        flat = matrix @ group.reshape(count, rows, group.shape[2] * directions)
        scaled[:, :, SLICES[name]] = flat.reshape(group.shape)
    return scaled


def slow_energy(whitening: Whitening, residual: np.ndarray) -> np.ndarray:
    """Return the energy (W, 19) of slow errors in a block's `residual` (W, M), by channel."""
    rows = residual[:, : whitening.weight[0].size].reshape(whitening.weight.shape)
    amplitude = (np.swapaxes(rows, 1, 2)[:, :, None] @ whitening.slow)[:, :, 0]
    return (amplitude**2).sum(axis=2)
