"""Whitened residuals of windows, freed from the unknown state in which each window starts.

A window's start is measured with the same noise as its other rows. It is left free: what 12 small
changes of it can explain is projected out of residuals and slopes, and what stays has the
measurement's own white noise. Where measured rotor speeds are the input, their errors are free as
well, but for rows that say how large they may be. All that the search needs is then a few sums a
window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import eval_legendre

from suite.diagnose.data.noise import noise_of, rotor_noise
from suite.diagnose.data.windows import Windows
from suite.diagnose.fit.model import Linear, Model
from suite.diagnose.fit.rollout import KNOTS, STATE

SLOW = 5
"""Degree of the polynomials in which a model's error of a window would show."""
DONE = 0.05
"""A fit has converged where another round would lower its squared error by less than this."""
SINGULAR = 1e-5
"""A column with less than this of its own beside the others needs Householder's way [1]."""
ROOM = 1.5
"""Errors of rotor speeds may be this much larger, for what happens between the knots."""


class Frame(NamedTuple):
    """How windows are whitened and freed from their starts."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    prior: np.ndarray
    """(F - 12,) 1 / size of each error of the rotor speeds; they are M's last rows."""
    start: np.ndarray
    """(W, M, F) orthonormal, what the start explains of the whitened rows."""
    upper: np.ndarray
    """(W, F, F) from the start to `start`'s coordinates."""
    slow: np.ndarray
    """(W, 12, N, L) unit slow errors of pose, velocity and rates, channel by channel."""
    slow_freedom: np.ndarray
    """(W, 12) expected energy along them where there is noise only, by channel."""
    freedom: np.ndarray
    """(W,) measured numbers less the start's."""


class Sums(NamedTuple):
    """Normal equations of each of W windows along K directions."""

    square: np.ndarray
    """(W, K, K) slope' slope."""
    cross: np.ndarray
    """(W, K) slope' residual."""
    error: np.ndarray
    """(W,) residual' residual."""
    slow: np.ndarray
    """(W, 12) energy of slow errors, by channel of pose, velocity and rates."""


@dataclass(frozen=True)
class State:
    """Where a fit stands."""

    theta: np.ndarray
    """(P,) the vector of all numbers."""
    offset: np.ndarray
    """(W, F) of what is free in each window, from what was measured."""


def make_frame(linear: Linear, sigma: np.ndarray, windows: Windows) -> Frame:
    """Return the frame of `windows` at the slopes of `linear` along what is free (its last)."""
    weight = np.where(windows.seen, 1.0 / np.where(np.isfinite(sigma), sigma, 1.0), 0.0)
    count, rows, channels = weight.shape
    size = linear.offset.shape[1]
    prior = np.full(size - STATE, 1.0 / rotor_spread(windows) if size > STATE else 1.0)
    slope = (linear.slope[..., -size:] * weight[..., None]).reshape(count, -1, size)
    held = np.zeros((count, size - STATE, size))
    held[:, :, STATE:] = np.diag(prior)
    start, upper = orthonormal(np.concatenate([slope, held], axis=1))
    upper = upper + 1e-9 * np.eye(size)
    time = 2.0 * np.asarray(windows.row_s)[..., None] - 1.0
    power = np.concatenate([eval_legendre(degree, time) for degree in range(SLOW + 1)], axis=-1)
    slow = np.moveaxis((weight[..., :12] > 0)[..., None] * power[:, :, None], 1, 2)
    slow = slow / np.maximum(np.linalg.norm(slow, axis=2, keepdims=True), 1e-9)
    inside = start[:, : rows * channels].reshape(count, rows, channels, size)[:, :, :12]
    taken = np.moveaxis(inside, 1, 3) @ slow
    slow_freedom = (slow**2).sum(axis=(2, 3)) - (taken**2).sum(axis=(2, 3))
    freedom = (weight > 0).sum(axis=(1, 2)) - STATE
    return Frame(weight, prior, start, upper, slow, slow_freedom, freedom)


def orthonormal(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and upper triangular R of `matrix` (..., M, F), M much larger than F.

    Cholesky's factor of the Gram matrix, twice (CholeskyQR2; Yamamoto et al. 2015): products of
    whole matrices, where Householder's way through so tall a matrix is many small steps. Columns
    that depend on each other to single precision are left to Householder.
    """
    size = np.maximum(np.linalg.norm(matrix, axis=-2, keepdims=True), 1e-300)
    base, upper = matrix / size, np.swapaxes(size, -1, -2) * np.eye(matrix.shape[-1])
    for _ in range(2):
        try:
            lower = np.linalg.cholesky(np.swapaxes(base, -1, -2) @ base)
        except np.linalg.LinAlgError:
            return np.linalg.qr(matrix)
        factor = np.swapaxes(lower, -1, -2)
        if np.einsum("...kk->...k", factor).min() < SINGULAR:
            return np.linalg.qr(matrix)
        base, upper = base @ np.linalg.inv(factor), factor @ upper
    return base, upper


def rotor_spread(windows: Windows) -> float:
    """Return how far the rotor speeds' error may be off at a knot [rad/s].

    White noise of rows adds up like errors that run straight between knots a tenth of a second
    apart and are smaller by the root of the rows that each stands for.
    """
    rows = np.asarray(windows.seen)[..., 9].sum(axis=1).mean()
    return ROOM * rotor_noise(windows) * float(np.sqrt((KNOTS - 1) / rows))


def whiten(frame: Frame, values: np.ndarray) -> np.ndarray:
    """Return `values` (W, N, 19, K) over their noise, (W, M, K), with zeros in the last rows."""
    flat = (
        (values * frame.weight[..., None]).reshape(len(values), -1, values.shape[3])
        if values.shape[3]
        else np.zeros((len(values), frame.weight[0].size, 0))
    )
    last = np.zeros((len(values), len(frame.prior), values.shape[3]))
    return np.concatenate([flat, last], axis=1)


def free(frame: Frame, white: np.ndarray) -> np.ndarray:
    """Return `white` (W, M, K) without what the start explains."""
    return white - frame.start @ (np.swapaxes(frame.start, 1, 2) @ white)


def white_residual(frame: Frame, linear: Linear) -> np.ndarray:
    """Return the residuals of `linear` over their noise, (W, M)."""
    white = whiten(frame, linear.residual[..., None])
    if len(frame.prior):
        white[:, -len(frame.prior) :, 0] = -linear.offset[:, STATE:] * frame.prior
    return white


def sums_of(frame: Frame, linear: Linear, directions: int) -> Sums:
    """Return the normal equations of `linear` along its first `directions`."""
    residual = free(frame, white_residual(frame, linear))[..., 0]
    slope = free(frame, whiten(frame, linear.slope[..., :directions]))
    turned = np.swapaxes(slope, 1, 2)
    # What the start explains is out of the residual, so the slow errors need not be freed of it.
    rows = residual[:, : frame.weight[0].size].reshape(frame.weight.shape)[..., :12]
    slow = ((np.swapaxes(rows, 1, 2)[:, :, None] @ frame.slow)[:, :, 0] ** 2).sum(axis=2)
    return Sums(
        turned @ slope,
        (turned @ residual[..., None])[..., 0],
        (residual**2).sum(axis=1),
        slow,
    )


def information(linear: Linear, windows: Windows, directions: int) -> np.ndarray:
    """Return what each window tells of each of the first `directions`, (W, K)."""
    frame = make_frame(linear, noise_of(linear.residual, windows), windows)
    sums = sums_of(frame, linear, directions)
    return np.einsum("wkk->wk", sums.square)


def solve(
    square: np.ndarray, cross: np.ndarray, low: np.ndarray, high: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Return the change within [low, high] that lowers the error most, for one set of sums."""
    if not len(cross):
        return np.zeros(0)
    matrix = square * np.outer(scale, scale)
    ridge = 1e-9 * max(float(np.trace(matrix)) / len(matrix), 1e-12)
    factor = np.linalg.cholesky(matrix + ridge * np.eye(len(matrix)))
    right = np.linalg.solve(factor, cross * scale)
    plain = np.linalg.solve(factor.T, right)
    low, high = np.minimum(low / scale, -1e-12), np.maximum(high / scale, 1e-12)
    if np.all((plain >= low) & (plain <= high)):
        return plain * scale
    return lsq_linear(factor.T, right, (low, high)).x * scale


def fit(
    model: Model,
    windows: Windows,
    frame: Frame,
    state: State,
    indices: list[int],
    rounds: int = 3,
    known: Linear | None = None,
) -> tuple[State, Sums]:
    """Fit the numbers at `indices` and every window's start (Gauss-Newton, halved where it fails).

    Args:
        model: of the windows.
        windows: W of them.
        frame: their noise.
        state: where to begin.
        indices: places of the numbers to fit.
        rounds: Gauss-Newton steps at most.
        known: slopes at `state` along all directions, where they are known already.

    Returns:
        The best state, and its sums along `indices`.
    """
    at = np.array(indices, dtype=int)
    low, high, scale = (model.space.array(name)[at] for name in ("low", "high", "step"))

    def look(state: State) -> tuple[Linear, Sums]:
        linear = model.linearise(state.theta, state.offset, windows, indices)
        return linear, sums_of(frame, linear, len(indices))

    def step(state: State, sums: Sums) -> tuple[np.ndarray, float]:
        """Return the change of the numbers and the fall of the error that the slopes promise."""
        square, cross = sums.square.sum(0), sums.cross.sum(0)
        change = solve(square, cross, low - state.theta[at], high - state.theta[at], scale)
        return change, float(2 * cross @ change - change @ square @ change)

    if known is None:
        linear, sums = look(state)
    else:
        linear = known._replace(slope=known.slope[..., at])
        sums = sums_of(frame, linear, len(indices))
    change, promised = step(state, sums)
    for _ in range(rounds):
        total = float(sums.error.sum())
        white = white_residual(frame, linear)
        if len(at):
            white = white - whiten(frame, (linear.slope @ change)[..., None])
        begin = np.linalg.solve(frame.upper, np.swapaxes(frame.start, 1, 2) @ white)[..., 0]
        share = 1.0
        while share > 0.1:
            theta = state.theta.copy()
            theta[at] = np.clip(theta[at] + share * change, low, high)
            trial = State(theta, state.offset + share * begin)
            new_linear, new_sums = look(trial)
            error = float(new_sums.error.sum())
            if np.isfinite(error) and error <= total + 1e-6:
                break
            share /= 2.0
        else:
            break
        state, linear, sums = trial, new_linear, new_sums
        change, promised = step(state, sums)
        if promised < DONE:
            break
    return state, sums
