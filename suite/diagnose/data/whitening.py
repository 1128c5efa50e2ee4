"""Whitens residuals of windows (1 s stretches of flights) and projects out their start states.

A window's start state is measured with the same noise as its other rows. So it is a nuisance
parameter: what a change of its 12 numbers could explain is removed (projected out) from residuals
and slopes. Errors of the rotor speeds are nuisance parameters, too. If measured speeds are the
model's input, they have errors at knots all along a window, else only at its start. Additional rows
hold a prior on the size of these errors. Start numbers are all these parameters of a window.
Errors of commands (`FlightWindows.input_error`) are projected out in the same way.
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


class Whitening(NamedTuple):
    """What whitens W windows. Each has M whitened rows, F start numbers and E input errors."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    prior: np.ndarray
    """(F + E - 12,) 1 / standard deviation of the errors of rotor speeds and input, which the last
    rows hold."""
    start: np.ndarray
    """(W, M, F + E) orthonormal basis of the changes of the rows by start numbers and errors."""
    upper: np.ndarray
    """(W, F + E, F + E) upper triangular matrix from these to coordinates in that basis."""
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
    # Basis of what start numbers and errors can change, with the rows of the prior.
    slope, spread = nuisance_of(linear, limits)
    prior, size = 1.0 / spread, slope.shape[-1]
    slope = _filtered(slope * weight[..., None], filters).reshape(count, -1, size)
    prior_rows = np.zeros((count, size - STATE, size))
    prior_rows[:, :, STATE:] = np.diag(prior)
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


def nuisance_of(linear: Linearisation, limits: Thresholds) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes along start numbers and input errors, and the size of these errors.

    The last F slopes in `linear` must be those along the start numbers. Returned are (W, N, 19,
    F + E), and the standard deviations (F + E - 12,) of all but the start state.
    """
    starts, error = linear.offset.shape[1], linear.windows.input_error
    slope = linear.slope[..., -starts:]
    spread = np.full(starts - STATE, rotor_spread(linear.windows, limits))
    if error is None:
        return slope, spread
    return np.concatenate([slope, error], axis=-1), np.append(spread, np.ones(error.shape[-1]))


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
    rows, change = project_out(whitening, linear, len(along))
    change = change[:, : linear.offset.shape[1]]
    return Block(
        rows[..., 0],
        rows[..., 1:],
        tuple(along),
        np.asarray(linear.windows.flight),
        np.asarray(linear.windows.start_s),
        change[..., 0],
        change[..., 1:],
    )


def project_out(
    whitening: Whitening, linear: Linearisation, directions: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return whitened residuals and K slopes without what start numbers and errors explain.

    Returned are the remaining rows (W, M, 1 + K), and the change of the start numbers and errors
    (W, F + E, 1 + K) that explains the other part. `directions` is K.
    """
    # Whiten residuals and slopes, and add the rows of the prior: their residuals are the changes of
    # the rotor speeds, their slopes 0.
    values = np.concatenate([linear.residual[..., None], linear.slope[..., :directions]], axis=-1)
    rows = _filtered(values * whitening.weight[..., None], whitening.filters)
    rows = rows.reshape(len(rows), -1, rows.shape[-1])
    prior_rows = np.zeros((len(rows), len(whitening.prior), rows.shape[-1]))
    rotors = linear.offset.shape[1] - STATE
    prior_rows[:, :rotors, 0] = -linear.offset[:, STATE:] * whitening.prior[:rotors]
    rows = np.concatenate([rows, prior_rows], axis=1)
    explained = np.swapaxes(whitening.start, 1, 2) @ rows
    change = np.linalg.solve(whitening.upper, explained)
    return rows - whitening.start @ explained, change


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
