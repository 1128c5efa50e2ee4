"""The colour of measurement noise: a state estimator's errors last from one row to the next.

Each group of channels has white noise and noise of a first-order Gauss-Markov process, that decays
as exp(-t / T). How much of it there is, and T, maximise the likelihood of what is left of every
window when a polynomial is taken off it (restricted likelihood; Patterson & Thompson 1971), so
that a model's slow error is not taken for noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from suite.diagnose.data.noise import noise_of
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

SHARES = (0.3, 0.6, 0.85, 0.97)
LASTS_S = (0.01, 0.025, 0.06, 0.15)
"""Where the search for the best colour begins: the best pair of these."""
LEAST_ROWS = 30
"""A window with fewer rows says nothing of colours."""


class Noise(NamedTuple):
    """Measurement noise."""

    sigma: np.ndarray
    """(19,) standard deviation of each channel in its unit; NaN where nothing was measured."""
    coloured: dict[str, tuple[float, float]]
    """By group of channels, where there is some: share of the variance that has the colour, and the
    time T after which it is forgotten [s]."""


class _Stretches(NamedTuple):
    """Rows of one group of channels, the same number N of each of V windows."""

    time_s: np.ndarray
    """(V, N) [s]."""
    values: np.ndarray
    """(V, N, C)."""
    powers: np.ndarray
    """(V, N, P) the polynomial."""


def measured_noise(
    residual: np.ndarray, windows: FlightWindows, limits: Thresholds = THRESHOLDS
) -> Noise:
    """Return the noise in `residual` (W, N, 19), measured - simulated in `windows`."""
    sigma, coloured = noise_of(residual, windows, limits=limits), {}
    for name, channels in SLICES.items():
        stretches = _stretches(residual, windows, channels, limits)
        if stretches is None or not np.isfinite(sigma[channels]).all():
            continue
        found = _colour(stretches, limits)
        if found is not None:
            coloured[name] = found
            energy, freedom, _ = _whitened(stretches, *found)
            # The median of chi-square over n is (1 - 2 / 9n)^3 (Wilson and Hilferty 1931).
            level = np.median(energy / freedom, axis=0) / (1.0 - 2.0 / (9.0 * freedom)) ** 3
            sigma[channels] = np.maximum(np.sqrt(level), sigma[channels])
    return Noise(sigma, coloured)


def colour_filter(noise: Noise, name: str, windows: FlightWindows) -> np.ndarray:
    """Return the (W, N, N) that make independent rows of rows of the group `name` over its noise.

    Rows without a value stay what they are.
    """
    seen = np.asarray(windows.seen)[..., SLICES[name]].all(axis=-1)
    matrix = _correlation(np.asarray(windows.row_s), *noise.coloured[name])
    both = seen[:, :, None] & seen[:, None]
    matrix = np.where(both, matrix, np.eye(matrix.shape[-1]))
    return np.linalg.inv(np.linalg.cholesky(matrix))


def _correlation(time_s: np.ndarray, share: float, lasts_s: float) -> np.ndarray:
    """Return the correlation (V, N, N) of noise at times (V, N)."""
    apart = np.abs(time_s[:, :, None] - time_s[:, None])
    return (1.0 - share) * np.eye(time_s.shape[1]) + share * np.exp(-apart / lasts_s)


def _stretches(
    residual: np.ndarray, windows: FlightWindows, channels: slice, limits: Thresholds
) -> _Stretches | None:
    seen = np.asarray(windows.seen)[..., channels].all(axis=-1)
    count = seen.sum(axis=1)
    if not len(count) or count.max() < LEAST_ROWS:
        return None
    rows = int(np.quantile(count[count >= LEAST_ROWS], 0.1))
    chosen = np.flatnonzero(count >= rows)
    chosen = chosen[:: -(-len(chosen) // limits.colour_windows)]
    first = np.argsort(~seen[chosen], axis=1, kind="stable")[:, :rows]
    time_s = np.take_along_axis(np.asarray(windows.row_s)[chosen], first, axis=1)
    values = np.take_along_axis(residual[chosen][..., channels], first[..., None], axis=1)
    span = time_s - time_s.mean(axis=1, keepdims=True)
    span = span / np.abs(span).max(axis=1, keepdims=True)
    return _Stretches(time_s, values, span[..., None] ** np.arange(limits.colour_degree + 1))


def _whitened(stretches: _Stretches, share: float, lasts_s: float) -> tuple[np.ndarray, int, float]:
    """Return the energy (V, C) beside the polynomial, its degrees of freedom, and log-likelihood.

    Every stretch has a size of noise of its own, so that a few bad ones do not decide.
    """
    lower = np.linalg.cholesky(_correlation(stretches.time_s, share, lasts_s))
    over = np.linalg.solve(lower, np.concatenate([stretches.powers, stretches.values], axis=-1))
    degree = stretches.powers.shape[-1]
    basis, upper = np.linalg.qr(over[..., :degree])
    values = over[..., degree:]
    left = values - basis @ (np.swapaxes(basis, 1, 2) @ values)
    energy, freedom = (left**2).sum(axis=1), stretches.values.shape[1] - degree
    spread = np.log(np.einsum("vii->vi", lower)).sum(axis=1)
    spread += np.log(np.abs(np.einsum("vii->vi", upper))).sum(axis=1)
    size = 0.5 * freedom * np.log(np.maximum(energy, 1e-300))
    return energy, freedom, -float((spread[:, None] + size).sum())


def _colour(stretches: _Stretches, limits: Thresholds) -> tuple[float, float] | None:
    """Return (share, T) of the likeliest colour; None where white noise is as good."""

    def likelihood(share: float, lasts_s: float) -> float:
        return _whitened(stretches, share, lasts_s)[2]

    white = likelihood(0.0, 1.0)
    start = max(
        ((share, lasts_s) for share in SHARES for lasts_s in LASTS_S),
        key=lambda pair: likelihood(*pair),
    )
    if likelihood(*start) - white < limits.colour_gain:
        return None

    def pair(x: np.ndarray) -> tuple[float, float]:
        return float(1.0 / (1.0 + np.exp(-x[0]))), float(np.exp(np.clip(x[1], -6.0, 0.0)))

    begin = np.array([np.log(start[0] / (1.0 - start[0])), np.log(start[1])])
    options = {"maxfev": 50, "xatol": 0.02, "fatol": 0.2}
    best = minimize(lambda x: -likelihood(*pair(x)), begin, method="Nelder-Mead", options=options)
    return pair(best.x)
