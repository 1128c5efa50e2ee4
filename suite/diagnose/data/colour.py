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

from suite.diagnose.data.noise import noise_of, typical_variance
from suite.diagnose.data.windows import CHANNELS, SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

TRIED = ((0.6, 0.02), (0.6, 0.08), (0.95, 0.02), (0.95, 0.08), (0.95, 0.2))
"""Shares and times T [s] of which the likeliest is where the search for a colour begins."""
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
    """Rows of channels that were seen together, the same number N each of V windows."""

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
    seen = {name: np.asarray(np.all(windows.seen[..., at], axis=-1)) for name, at in SLICES.items()}
    together: dict[bytes, list[str]] = {}
    for name, channels in SLICES.items():
        if np.isfinite(sigma[channels]).all():
            together.setdefault(seen[name].tobytes(), []).append(name)
    for names in together.values():
        channels = np.concatenate([np.arange(CHANNELS)[SLICES[name]] for name in names])
        stretches = _stretches(residual[..., channels], windows, seen[names[0]], limits)
        if stretches is None:
            continue
        tried = [(pair, _likelihood(stretches, *pair)) for pair in ((0.0, 1.0), *TRIED)]
        for name in names:
            at = np.isin(channels, np.arange(CHANNELS)[SLICES[name]])
            (_, white), *others = [(pair, float(likely[at].sum())) for pair, likely in tried]
            start, best = max(others, key=lambda one: one[1])
            if best - white < limits.colour_gain:
                continue
            own = stretches._replace(values=stretches.values[..., at])
            coloured[name] = _likeliest(own, start)
            energy, freedom, _ = _beside_polynomial(own, *coloured[name])
            level = np.sqrt(typical_variance(energy, freedom))
            sigma[SLICES[name]] = np.maximum(level, sigma[SLICES[name]])
    return Noise(sigma, coloured)


def colour_filter(noise: Noise, name: str, windows: FlightWindows) -> np.ndarray:
    """Return the (W, N, N) that make independent rows of rows of the group `name` over its noise.

    Rows without a value stay what they are.
    """
    seen = np.asarray(np.all(windows.seen[..., SLICES[name]], axis=-1))
    matrix = _correlation(np.asarray(windows.row_s), *noise.coloured[name])
    both = seen[:, :, None] & seen[:, None]
    matrix = np.where(both, matrix, np.eye(matrix.shape[-1]))
    return np.linalg.inv(np.linalg.cholesky(matrix))


def _correlation(time_s: np.ndarray, share: float, lasts_s: float) -> np.ndarray:
    """Return the correlation (V, N, N) of noise at times (V, N)."""
    apart = np.abs(time_s[:, :, None] - time_s[:, None])
    return (1.0 - share) * np.eye(time_s.shape[1]) + share * np.exp(-apart / lasts_s)


def _stretches(
    values: np.ndarray, windows: FlightWindows, seen: np.ndarray, limits: Thresholds
) -> _Stretches | None:
    """Return the rows of `values` (W, N, C) that were `seen` (W, N); None where too few are."""
    count = seen.sum(axis=1)
    if not len(count) or count.max() < LEAST_ROWS:
        return None
    rows = int(np.quantile(count[count >= LEAST_ROWS], 0.1))
    chosen = np.flatnonzero(count >= rows)
    chosen = chosen[:: -(-len(chosen) // limits.colour_windows)]
    first = np.argsort(~seen[chosen], axis=1, kind="stable")[:, :rows]
    time_s = np.take_along_axis(np.asarray(windows.row_s)[chosen], first, axis=1)
    span = time_s - time_s.mean(axis=1, keepdims=True)
    span = span / np.abs(span).max(axis=1, keepdims=True)
    powers = span[..., None] ** np.arange(limits.colour_degree + 1)
    return _Stretches(time_s, np.take_along_axis(values[chosen], first[..., None], axis=1), powers)


def _beside_polynomial(
    stretches: _Stretches, share: float, lasts_s: float
) -> tuple[np.ndarray, int, np.ndarray]:
    """Return the energy (V, C) beside the polynomial, its freedom, and log-determinants (V,).

    Rows are whitened by the colour first.
    """
    lower = np.linalg.cholesky(_correlation(stretches.time_s, share, lasts_s))
    over = np.linalg.solve(lower, np.concatenate([stretches.powers, stretches.values], axis=-1))
    degree = stretches.powers.shape[-1]
    powers, values = over[..., :degree], over[..., degree:]
    turned = np.swapaxes(powers, 1, 2)
    gram, along = turned @ powers, turned @ values
    energy = (values**2).sum(axis=1) - (along * np.linalg.solve(gram, along)).sum(axis=1)
    spread = np.log(np.einsum("vii->vi", lower)).sum(axis=1)
    return energy, values.shape[1] - degree, spread + 0.5 * np.linalg.slogdet(gram)[1]


def _likelihood(stretches: _Stretches, share: float, lasts_s: float) -> np.ndarray:
    """Return the restricted log-likelihood (C,) of a colour.

    Every stretch has a size of noise of its own, so that a few bad ones do not decide.
    """
    energy, freedom, spread = _beside_polynomial(stretches, share, lasts_s)
    size = 0.5 * freedom * np.log(np.maximum(energy, 1e-300))
    return -(spread[:, None] + size).sum(axis=0)


def _likeliest(stretches: _Stretches, start: tuple[float, float]) -> tuple[float, float]:
    """Return (share, T) of the likeliest colour, from `start` on."""

    def pair(x: np.ndarray) -> tuple[float, float]:
        return float(1.0 / (1.0 + np.exp(-x[0]))), float(np.exp(np.clip(x[1], -6.0, 0.0)))

    begin = np.array([np.log(start[0] / (1.0 - start[0])), np.log(start[1])])
    options = {"maxfev": 40, "xatol": 0.05, "fatol": 0.2}
    best = minimize(
        lambda x: -_likelihood(stretches, *pair(x)).sum(),
        begin,
        method="Nelder-Mead",
        options=options,
    )
    return pair(best.x)
