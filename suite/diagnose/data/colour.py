"""Autocorrelated (coloured) measurement noise: errors of a state estimator last over several rows.

Position, attitude and velocity have white noise plus a first-order Gauss-Markov process, which
decays as exp(-t / T). Its share and T maximise the likelihood of the windows after a polynomial is
subtracted (restricted likelihood; Patterson & Thompson 1971). An error of the model accumulates
along a window, noise does not. So the likelihood also contains an error that is white in force and
torque; otherwise it would count as noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular
from scipy.optimize import minimize, minimize_scalar

from suite.diagnose.data.noise import at_least, noise_of, typical_variance
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

TIMES_S = tuple(np.geomspace(0.012, 0.2, 8).tolist())
"""Times T that are tried [s]; a longer one is absorbed by a window's start, which is free."""
LEFT_S = tuple(np.geomspace(0.03, 1.0, 6).tolist())
"""The same where the whole residual counts as noise [s]."""
DRIFTS = (0.0, *np.logspace(-3.0, 5.0, 17).tolist())
"""How fast a model's error may grow: its variance after a second, over the noise's."""
ESTIMATED = ("position", "attitude", "velocity")
"""Groups of one state estimator, with the same T. Other sensors have white noise."""
INTEGRATED = {"position": 2, "attitude": 2, "velocity": 1}
"""By group, how often a force or torque is integrated to move it; other groups follow at once."""
LEAST_ROWS = 30
"""Least number of rows of a window to estimate T."""


class Noise(NamedTuple):
    """Measurement noise."""

    sigma: np.ndarray
    """(19,) standard deviation of each channel in its unit; NaN where nothing was measured."""
    coloured: dict[str, tuple[float, float]]
    """By group of channels, where there is some: share of the variance that has the colour, and the
    time T after which it is forgotten [s]."""


class _Stretches(NamedTuple):
    """Rows of a group of channels in V windows, N of each, at about the same times in all."""

    time_s: np.ndarray
    """(N,) [s]."""
    values: np.ndarray
    """(N, V * C)."""
    powers: np.ndarray
    """(N, P) the polynomial."""
    drift: np.ndarray
    """(N, N) covariance of a model's error, 1 after a second."""


class _Process(NamedTuple):
    """Noise of unit variance, and a model's error."""

    share: float
    """Of the noise, that is coloured."""
    lasts_s: float
    """T [s]."""
    drift: float
    """Variance of the model's error after a second."""


def measured_noise(
    residual: np.ndarray,
    start_slope: np.ndarray,
    windows: FlightWindows,
    limits: Thresholds = THRESHOLDS,
) -> Noise:
    """Return the noise in residuals.

    Args:
        residual: (W, N, 19) measured - simulated.
        start_slope: (W, N, 19, F) of the simulated values along each window's start.
        windows: W of them.
        limits: from where on noise has a colour.
    """
    sigma = noise_of(residual, windows, limits=limits)
    residual = _freed(residual, start_slope, np.where(windows.seen, 1.0 / sigma, 0.0))
    sigma = noise_of(residual, windows, limits=limits)
    parts = _parts(residual, sigma, windows, ESTIMATED, limits)
    tried = {name: _by_time(stretches, limits) for name, stretches in parts.items()}
    gains = np.sum([[gain for _, gain in each] for each in tried.values()], axis=0)
    coloured = {}
    for name in parts if np.max(gains) >= limits.colour_gain else ():
        process, _ = tried[name][int(gains.argmax())]
        energy, freedom, _ = _without_polynomial(parts[name], process)
        sigma[SLICES[name]] = np.sqrt(typical_variance(energy.reshape(-1, 3), freedom))
        coloured[name] = (process.share, process.lasts_s)
    return Noise(at_least(sigma, limits), coloured)


def left_as_noise(
    residual: np.ndarray,
    start_slope: np.ndarray,
    windows: FlightWindows,
    limits: Thresholds = THRESHOLDS,
) -> Noise:
    """Return the noise if the whole residual counts as noise, the model's error included.

    Where the best model is off by more than noise, this bounds the bias of fitted numbers. The
    arguments are those of `measured_noise`.
    """
    sigma = noise_of(residual, windows, limits=limits)
    residual = _freed(residual, start_slope, np.where(windows.seen, 1.0 / sigma, 0.0))
    coloured = {}
    for name, stretches in _parts(residual, sigma, windows, SLICES, limits).items():
        rows = len(stretches.time_s)
        bare = stretches._replace(powers=np.zeros((rows, 0)), drift=np.zeros((rows, rows)))
        process, _ = max(_by_time(bare, limits, LEFT_S), key=lambda one: one[1])
        energy, freedom, _ = _without_polynomial(bare, process)
        channels = SLICES[name]
        width = channels.stop - channels.start
        sigma[channels] = np.sqrt((energy.reshape(-1, width) / freedom).mean(axis=0))
        coloured[name] = (process.share, process.lasts_s)
    return Noise(at_least(sigma, limits), coloured)


def colour_filter(noise: Noise, name: str, windows: FlightWindows) -> np.ndarray:
    """Return the (W, N, N) that make independent rows of rows of the group `name` over its noise.

    Rows without a value stay what they are.
    """
    seen = np.asarray(np.all(windows.seen[..., SLICES[name]], axis=-1))
    matrix = _correlation(np.asarray(windows.row_s), *noise.coloured[name])
    both = seen[:, :, None] & seen[:, None]
    matrix = np.where(both, matrix, np.eye(matrix.shape[-1]))
    lower = np.linalg.cholesky(matrix)
    # A general inverse takes two to five times as long.
    (inverse,) = get_lapack_funcs(("trtri",), (lower,))
    return np.array([inverse(one, lower=1)[0] for one in lower]).reshape(lower.shape)


def _correlation(time_s: np.ndarray, share: float, lasts_s: float) -> np.ndarray:
    """Return the correlation (..., N, N) of noise at times (..., N)."""
    apart = np.abs(time_s[..., :, None] - time_s[..., None, :])
    return (1.0 - share) * np.eye(time_s.shape[-1]) + share * np.exp(-apart / lasts_s)


def _freed(residual: np.ndarray, slope: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return `residual` (W, N, 19) without what errors of each window's start explain.

    `slope` (W, N, 19, F) is along the start, `weight` (W, N, 19) of each value.
    """
    rows = (slope * np.nan_to_num(weight)[..., None]).reshape(len(slope), -1, slope.shape[-1])
    white = (residual * np.nan_to_num(weight)).reshape(len(slope), -1, 1)
    turned = np.swapaxes(rows, 1, 2)
    size = np.sqrt(np.einsum("wfm,wmf->wf", turned, rows))[:, :, None] + 1e-30
    gram = (turned / size) @ (rows / np.swapaxes(size, 1, 2)) + 1e-9 * np.eye(slope.shape[-1])
    moved = np.linalg.solve(gram, (turned / size) @ white) / size
    return residual - (slope @ moved[:, None])[..., 0]


def _parts(
    residual: np.ndarray,
    sigma: np.ndarray,
    windows: FlightWindows,
    names: Iterable[str],
    limits: Thresholds,
) -> dict[str, _Stretches]:
    """Return the stretches of those groups of `names` of which enough was seen."""
    found = {}
    for name in names:
        if np.isfinite(sigma[SLICES[name]]).all():
            stretches = _stretches(residual[..., SLICES[name]], windows, name, limits)
            if stretches is not None:
                found[name] = stretches
    return found


def _stretches(
    values: np.ndarray, windows: FlightWindows, name: str, limits: Thresholds
) -> _Stretches | None:
    """Return the rows of `values` (W, N, C) of the group `name`; None where too few were seen."""
    seen = np.asarray(np.all(windows.seen[..., SLICES[name]], axis=-1))
    count = seen.sum(axis=1)
    if not len(count) or count.max() < LEAST_ROWS:
        return None
    rows = int(np.quantile(count[count >= LEAST_ROWS], 0.1))
    chosen = np.flatnonzero(count >= rows)
    first = np.argsort(~seen[chosen], axis=1, kind="stable")[:, :rows]
    times_s = np.take_along_axis(np.asarray(windows.row_s)[chosen], first, axis=1)
    time_s = np.median(times_s, axis=0)
    # What a lost row or jitter moves by a few rows has the same colour; a hole is another thing.
    near = np.abs(times_s - time_s).max(axis=1) <= limits.colour_aside * np.diff(time_s).mean()
    stacked = np.take_along_axis(values[chosen], first[..., None], axis=1)[near]
    if not len(stacked):
        return None
    span = (time_s - time_s.mean()) / (time_s[-1] - time_s[0])
    return _Stretches(
        time_s,
        np.moveaxis(stacked, 1, 0).reshape(rows, -1),
        span[:, None] ** np.arange(limits.colour_degree + 1),
        _drift(time_s - time_s[0], INTEGRATED.get(name, 0)),
    )


def _drift(time_s: np.ndarray, integrated: int) -> np.ndarray:
    """Return the covariance (N, N) of white noise integrated so often, 1 after a second."""
    early, late = np.minimum.outer(time_s, time_s), np.maximum.outer(time_s, time_s)
    if integrated == 2:
        return 0.5 * early**2 * (3.0 * late - early)
    return early if integrated == 1 else np.zeros_like(early)


def _without_polynomial(stretches: _Stretches, process: _Process) -> tuple[np.ndarray, int, float]:
    """Return the energy (V * C,) off the polynomial, its freedom, and half a log-determinant.

    Rows are whitened by `process` first.
    """
    matrix = _correlation(stretches.time_s, process.share, process.lasts_s)
    lower = np.linalg.cholesky(matrix + process.drift * stretches.drift)
    both = np.concatenate([stretches.powers, stretches.values], axis=1)
    over = solve_triangular(lower, both, lower=True, check_finite=False)
    degree = stretches.powers.shape[1]
    basis, upper = np.linalg.qr(over[:, :degree])
    values = over[:, degree:]
    energy = (values**2).sum(axis=0) - ((basis.T @ values) ** 2).sum(axis=0)
    spread = np.log(np.diag(lower)).sum() + np.log(np.abs(np.diag(upper))).sum()
    return energy, len(values) - degree, float(spread)


def _likelihood(stretches: _Stretches, process: _Process) -> float:
    """Return the restricted log-likelihood of `process`.

    Every stretch has its own noise variance, so that a few bad ones do not dominate.
    """
    energy, freedom, spread = _without_polynomial(stretches, process)
    size = 0.5 * freedom * np.log(np.maximum(energy, 1e-300))
    return -float((spread + size).sum())


def _by_time(
    stretches: _Stretches, limits: Thresholds, times_s: Sequence[float] = TIMES_S
) -> list[tuple[_Process, float]]:
    """Return for each of `times_s` the likeliest process, and its gain over white noise.

    A drift needs a clearly higher likelihood than noise alone.
    """

    def likely(process: _Process) -> float:
        cost = limits.drift_gain if process.drift else 0.0
        return _likelihood(stretches, process) - cost

    drifts = DRIFTS if stretches.drift.any() else (0.0,)
    white = max((_Process(0.0, 1.0, drift) for drift in drifts), key=likely)
    nothing, found = likely(white), []
    for lasts_s in times_s:
        alone = minimize_scalar(
            lambda share, t=lasts_s: -likely(_Process(share, t, 0.0)),
            bounds=(0.0, 0.999),
            method="bounded",
            options={"xatol": 0.01},
        )
        best, most = _Process(float(alone.x), lasts_s, 0.0), -float(alone.fun)
        if white.drift:
            drifting, more = _with_drift(likely, best, white.drift)
            if more > most:
                best, most = drifting, more
        found.append((best, most - nothing))
    return found


def _with_drift(
    likely: Callable[[_Process], float], begin: _Process, drift: float
) -> tuple[_Process, float]:
    """Return the likeliest process that lasts as long as `begin`, and how likely it is.

    The search begins at `drift`.
    """

    def process_at(x: np.ndarray) -> _Process:
        share = float(1.0 / (1.0 + np.exp(-x[0])))
        return begin._replace(share=share, drift=float(np.exp(np.clip(x[1], -12.0, 14.0))))

    share = np.clip(begin.share, 0.01, 0.99)
    best = minimize(
        lambda x: -likely(process_at(x)),
        np.array([np.log(share / (1.0 - share)), np.log(drift)]),
        method="Nelder-Mead",
        options={"maxfev": 30, "xatol": 0.05, "fatol": 0.1},
    )
    return process_at(best.x), -float(best.fun)
