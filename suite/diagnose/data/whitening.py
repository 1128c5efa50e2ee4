"""Whitened residuals of windows, with each window's unknown start state projected out.

A window's start is measured with the same noise as its other rows, so it is a nuisance parameter:
the effect of 12 small changes of it is projected out of residuals and slopes. Errors of the rotor
speeds are nuisance parameters too, with a prior on their size in additional rows: all along a
window where measured speeds are the input, else at its start.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from suite.diagnose.data.colour import Noise, colour_filter
from suite.diagnose.data.noise import rotor_noise
from suite.diagnose.data.windows import KNOTS, SLICES, STATE, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class Linearisation(NamedTuple):
    """Residuals of W windows and their slopes along K directions."""

    residual: np.ndarray
    """(W, N, 19) measured - simulated; zero where nothing was measured."""
    slope: np.ndarray
    """(W, N, 19, K) of the simulated values."""
    offset: np.ndarray
    """(W, F) of what is free in each window, where the residuals were taken."""

    @property
    def start_slope(self) -> np.ndarray:
        """(W, N, 19, 12) along each window's start; for slopes whose last F are what is free."""
        size = self.offset.shape[1]
        return self.slope[..., self.slope.shape[-1] - size :][..., :STATE]


class Whitening(NamedTuple):
    """Whitening of W windows, with F nuisance parameters each."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    prior: np.ndarray
    """(F - 12,) 1 / size of each error of the rotor speeds; they are M's last rows."""
    start: np.ndarray
    """(W, M, F) orthonormal, what the start explains of the whitened rows."""
    upper: np.ndarray
    """(W, F, F) from the start to `start`'s coordinates."""
    slow: np.ndarray
    """(W, 19, N, L) unit slow errors, channel by channel."""
    slow_freedom: np.ndarray
    """(W, 19) expected energy along them where there is noise only, by channel."""
    filters: Mapping[str, np.ndarray]
    """(W, N, N) by group of channels whose noise has a colour: from rows over their noise to
    independent ones."""


def make_whitening(
    linear: Linearisation,
    noise: Noise,
    windows: FlightWindows,
    limits: Thresholds = THRESHOLDS,
) -> Whitening:
    """Return the whitening of `windows` by their noise.

    The last columns of the slopes in `linear` are those along what is free.
    """
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 1.0)
    weight = np.where(windows.seen, 1.0 / sigma, 0.0)
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
    inside = start[:, : rows * channels].reshape(count, rows, channels, size)
    taken = np.moveaxis(inside, 1, 3) @ slow
    slow_freedom = (slow**2).sum(axis=(2, 3)) - (taken**2).sum(axis=(2, 3))
    return Whitening(weight, prior, start, upper, slow, slow_freedom, filters)


def orthonormal(matrix: np.ndarray, singular: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and upper triangular R of `matrix` (..., M, F), M much larger than F.

    Cholesky's factor of the Gram matrix, twice (CholeskyQR2; Yamamoto et al. 2015): products of
    whole matrices, where Householder's way through so tall a matrix is many small steps. Where a
    column has less than `singular` of its own next to the others, Householder's way is taken.
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
    """Return the standard deviation of the free errors of rotor speeds [rad/s].

    They are at the knots where rotor speeds are the input, else at the start.

    White noise of rows is equivalent to errors that are linear between knots 0.1 s apart and
    smaller by the root of the number of rows a knot.
    """
    start = np.asarray(windows.start_rotor_error)
    if start.all():
        return float(np.sqrt((start**2).mean()))
    rows = np.asarray(windows.rotor_seen).sum(axis=1).min(axis=-1).mean()
    noise = rotor_noise(windows, limits)
    return limits.rotor_knot_excess * noise * float(np.sqrt((KNOTS - 1) / max(rows, 1.0)))


def whiten(whitening: Whitening, values: np.ndarray) -> np.ndarray:
    """Return `values` (W, N, 19, K) over their noise, (W, M, K), with zeros in the last rows."""
    count, rows, channels, directions = values.shape
    over = _filtered(values * whitening.weight[..., None], whitening.filters)
    flat = over.reshape(count, rows * channels, directions)
    last = np.zeros((count, len(whitening.prior), directions))
    return np.concatenate([flat, last], axis=1)


def _filtered(over: np.ndarray, filters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return rows over their noise (W, N, 19, K) as independent ones; changes `over`."""
    count, rows, _, directions = over.shape
    for name, one in filters.items():
        part = over[:, :, SLICES[name]]
        width = part.shape[2]
        flat = one @ part.reshape(count, rows, width * directions)
        over[:, :, SLICES[name]] = flat.reshape(count, rows, width, directions)
    return over


def project_out_start(whitening: Whitening, white: np.ndarray) -> np.ndarray:
    """Return `white` (W, M, K) without what the start explains."""
    return white - whitening.start @ (np.swapaxes(whitening.start, 1, 2) @ white)


def slow_energy(whitening: Whitening, residual: np.ndarray) -> np.ndarray:
    """Return the energy of slow errors (W, 19) in a block's `residual` (W, M), by channel.

    What the start explains is out of the residual, so the slow errors need not be freed of it.
    """
    rows = residual[:, : whitening.weight[0].size].reshape(whitening.weight.shape)
    along = (np.swapaxes(rows, 1, 2)[:, :, None] @ whitening.slow)[:, :, 0]
    return (along**2).sum(axis=2)


def whitened_residual(whitening: Whitening, linear: Linearisation) -> np.ndarray:
    """Return the residuals of `linear` over their noise, (W, M, 1)."""
    white = whiten(whitening, linear.residual[..., None])
    if len(whitening.prior):
        white[:, -len(whitening.prior) :, 0] = -linear.offset[:, STATE:] * whitening.prior
    return white
