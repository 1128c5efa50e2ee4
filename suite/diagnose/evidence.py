"""Whitened residuals of windows, freed from the unknown state in which each window starts.

A window's start is measured with the same noise as its other rows. It is left free: what 12 small
changes of it can explain is projected out of residuals and slopes, and what stays has the
measurement's own white noise. All that the search needs is then a few sums a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from suite.diagnose.model import STATE, Linear, Model
from suite.diagnose.windows import Windows

SLOW = 5
"""Degree of the polynomials in which a model's error of a window would show."""


class Frame(NamedTuple):
    """How windows are whitened and freed from their starts."""

    weight: np.ndarray
    """(W, N, 19) 1 / noise; 0 where nothing was measured."""
    start: np.ndarray
    """(W, M, 12) orthonormal, what the start explains of the whitened rows."""
    upper: np.ndarray
    """(W, 12, 12) from the start to `start`'s coordinates."""
    slow: np.ndarray
    """(W, M, 12 L) slow errors of pose, velocity and rates, less what the start explains."""
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
    """(W, 12) of the windows' starts from the measured ones."""


def make_frame(linear: Linear, sigma: np.ndarray, windows: Windows) -> Frame:
    """Return the frame of `windows` at the start slopes of `linear` (its last 12 directions)."""
    weight = np.where(windows.seen, 1.0 / np.where(np.isfinite(sigma), sigma, 1.0), 0.0)
    count, rows, channels = weight.shape
    slope = (linear.slope[..., -STATE:] * weight[..., None]).reshape(count, -1, STATE)
    start, upper = np.linalg.qr(slope)
    upper = upper + 1e-9 * np.eye(STATE)
    time = np.asarray(windows.row_s)
    basis = np.zeros((count, rows, channels, 12, SLOW + 1))
    for degree in range(SLOW + 1):
        power = np.polynomial.legendre.Legendre.basis(degree)(2.0 * time - 1.0)
        for channel in range(12):
            basis[:, :, channel, channel, degree] = power * (weight[:, :, channel] > 0)
    flat = basis.reshape(count, rows * channels, -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    slow = flat - start @ (np.swapaxes(start, 1, 2) @ flat)
    slow_freedom = (slow**2).sum(axis=1).reshape(count, 12, SLOW + 1).sum(axis=2)
    freedom = (weight > 0).sum(axis=(1, 2)) - STATE
    return Frame(weight, start, upper, slow, slow_freedom, freedom)


def free(frame: Frame, values: np.ndarray) -> np.ndarray:
    """Return `values` (W, N, 19[, K]) whitened and freed from the start, (W, M[, K])."""
    extra = values.ndim - frame.weight.ndim
    weight = frame.weight.reshape(*frame.weight.shape, *[1] * extra)
    flat = (values * weight).reshape(len(values), frame.start.shape[1], *values.shape[3:])
    if not extra:
        return flat - np.einsum("wmi,wni,wn->wm", frame.start, frame.start, flat, optimize=True)
    return flat - frame.start @ (np.swapaxes(frame.start, 1, 2) @ flat)


def sums_of(frame: Frame, linear: Linear, directions: int) -> Sums:
    """Return the normal equations of `linear` along its first `directions`."""
    residual = free(frame, linear.residual)
    slope = free(frame, linear.slope[..., :directions])
    turned = np.swapaxes(slope, 1, 2)
    slow = np.einsum("wml,wm->wl", frame.slow, residual, optimize=True) ** 2
    return Sums(
        turned @ slope,
        (turned @ residual[..., None])[..., 0],
        (residual**2).sum(axis=1),
        slow.reshape(len(slow), 12, SLOW + 1).sum(axis=2),
    )


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
) -> tuple[State, Sums]:
    """Fit the numbers at `indices` and every window's start (Gauss-Newton, halved where it fails).

    Returns:
        The best state, and its sums along `indices`.
    """
    entries = model.space
    low, high, scale = entries.array("low"), entries.array("high"), entries.array("step")
    at = np.array(indices, dtype=int)

    def look(state: State) -> tuple[Linear, Sums]:
        linear = model.linearise(state.theta, state.offset, windows, indices)
        return linear, sums_of(frame, linear, len(indices))

    linear, sums = look(state)
    for _ in range(rounds):
        total = float(sums.error.sum())
        change = solve(
            sums.square.sum(0),
            sums.cross.sum(0),
            low[at] - state.theta[at],
            high[at] - state.theta[at],
            scale[at],
        )
        left = linear.residual - (linear.slope @ change if len(at) else 0.0)
        white = (left * frame.weight).reshape(len(left), -1, 1)
        begin = np.linalg.solve(frame.upper, np.swapaxes(frame.start, 1, 2) @ white)[..., 0]
        share = 1.0
        while share > 0.1:
            theta = state.theta.copy()
            theta[at] = np.clip(theta[at] + share * change, low[at], high[at])
            trial = State(theta, state.offset + share * begin)
            new_linear, new_sums = look(trial)
            error = float(new_sums.error.sum())
            if np.isfinite(error) and error <= total + 1e-6:
                break
            share /= 2.0
        else:
            break
        state, linear, sums = trial, new_linear, new_sums
        if total - error < 0.05:
            break
    return state, sums
