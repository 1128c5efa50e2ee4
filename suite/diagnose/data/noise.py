"""Estimates the measurement noise, white and autocorrelated (coloured).

A model's error is smooth, noise is not. So a polynomial is subtracted from a few consecutive rows
at a time, and the remainder is noise. The noise of a state estimator is autocorrelated: that of
position, attitude and velocity is modelled as white noise plus a first-order Gauss-Markov process,
whose correlation decays as exp(-t / T). Estimated are T and the share of the variance that this
process has. They maximise the likelihood of the residuals in windows (1 s stretches of flights),
after a polynomial is subtracted (restricted likelihood; Patterson & Thompson 1971). An error of the
model, in contrast to noise, accumulates along a window (drift). So the likelihood also contains a
drift by random force and torque; it would count as noise otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logit

from suite.diagnose.data.windows import CHANNELS, SLICES, STATE, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

TIMES_S = tuple(np.geomspace(0.012, 0.2, 8).tolist())
"""Tested correlation times T [s]. Noise that lasts longer acts as an error of a window's start
state, which is fitted anyway."""
MISFIT_TIMES_S = tuple(np.geomspace(0.03, 1.0, 6).tolist())
"""Tested correlation times if the whole residual counts as noise [s]."""
DRIFTS = (0.0, *np.logspace(-3.0, 5.0, 17).tolist())
"""Tested sizes of the model's error: its variance after a second over the variance of the noise."""
INTEGRATED = {"position": 2, "attitude": 2, "velocity": 1}
"""Group of channels -> how many times a force or torque is integrated to give it; others: 0. These
are of one state estimator, so their noise has the same T; other noise is white."""
LEAST_ROWS = 30
"""Smallest number of rows of a window from which T is estimated."""


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


class Noise(NamedTuple):
    """Measurement noise of all channels."""

    sigma: np.ndarray
    """(19,) standard deviation of each channel in its unit; NaN where nothing was measured."""
    coloured: dict[str, tuple[float, float]]
    """Group of channels with autocorrelated noise -> (share of its variance that is autocorrelated,
    correlation time T [s])."""


class _Stretches(NamedTuple):
    """N rows of a group of C channels in V windows, at about the same times in all windows."""

    time_s: np.ndarray
    """(N,) times of the rows in a window [s]."""
    values: np.ndarray
    """(N, V * C) residuals."""
    powers: np.ndarray
    """(N, P) terms of the polynomial that is subtracted."""
    drift: np.ndarray
    """(N, N) covariance of the model's accumulated error, scaled to a variance of 1 after 1 s."""


class _Process(NamedTuple):
    """Parameters of noise with a variance of 1, and of the model's error."""

    share: float
    """Share of the noise's variance that is autocorrelated."""
    lasts_s: float
    """Correlation time T [s]."""
    drift: float
    """Variance of the model's error after a second, over the variance of the noise."""


def measured_noise(linear: Linearisation, limits: Thresholds = THRESHOLDS) -> Noise:
    """Estimate the measurement noise from the residuals of windows."""
    linear, _ = _without_start(linear, limits)
    sigma = noise_of(linear.residual, linear.windows, limits=limits)
    groups = _stretches(linear, sigma, INTEGRATED, limits)
    fits = {name: _fit_by_time(stretches, limits) for name, stretches in groups.items()}
    gains = np.sum([[gain for _, gain in by_time] for by_time in fits.values()], axis=0)
    coloured = {}
    # All groups share one T. Without a clear gain by it, the noise is white.
    for name in groups if np.max(gains) >= limits.colour_gain else ():
        process, _ = fits[name][int(gains.argmax())]
        energy, freedom, _ = _without_polynomial(groups[name], process)
        sigma[SLICES[name]] = np.sqrt(typical_variance(energy.reshape(-1, 3), freedom))
        coloured[name] = (process.share, process.lasts_s)
    return Noise(at_least(sigma, limits), coloured)


def residual_as_noise(linear: Linearisation, limits: Thresholds = THRESHOLDS) -> Noise:
    """Return the noise if the whole residual counts as noise, including the model's error.

    Intervals then allow for the bias by a model that does not fit.
    """
    linear, sigma = _without_start(linear, limits)
    coloured = {}
    for name, stretches in _stretches(linear, sigma, SLICES, limits).items():
        rows = len(stretches.time_s)
        bare = stretches._replace(powers=np.zeros((rows, 0)), drift=np.zeros((rows, rows)))
        process, _ = max(_fit_by_time(bare, limits, MISFIT_TIMES_S), key=lambda fit: fit[1])
        energy, freedom, _ = _without_polynomial(bare, process)
        channels = SLICES[name]
        width = channels.stop - channels.start
        sigma[channels] = np.sqrt((energy.reshape(-1, width) / freedom).mean(axis=0))
        coloured[name] = (process.share, process.lasts_s)
    return Noise(at_least(sigma, limits), coloured)


def colour_filter(noise: Noise, name: str, windows: FlightWindows) -> np.ndarray:
    """Return matrices (W, N, N) that make rows over their standard deviation independent.

    Rows of the group `name` without a value stay unchanged.
    """
    valid = np.asarray(np.all(windows.valid[..., SLICES[name]], axis=-1))
    correlation = _correlation(np.asarray(windows.row_s), *noise.coloured[name])
    pairs = valid[:, :, None] & valid[:, None]
    lower = np.linalg.cholesky(np.where(pairs, correlation, np.eye(correlation.shape[-1])))
    # A general inverse takes two to five times as long.
    (inverse,) = get_lapack_funcs(("trtri",), (lower,))
    return np.array([inverse(one, lower=1)[0] for one in lower]).reshape(lower.shape)


def _correlation(time_s: np.ndarray, share: float, lasts_s: float) -> np.ndarray:
    """Return the correlation (..., N, N) of noise at `time_s` (..., N), see `Noise.coloured`."""
    lag_s = np.abs(time_s[..., :, None] - time_s[..., None, :])
    return (1.0 - share) * np.eye(time_s.shape[-1]) + share * np.exp(-lag_s / lasts_s)


def _without_start(linear: Linearisation, limits: Thresholds) -> tuple[Linearisation, np.ndarray]:
    """Return the residuals without what errors of start states and inputs explain, and their noise.

    The noise (19,) is that before.
    """
    residual, first = linear.residual, linear.slope.shape[-1] - linear.offset.shape[1]
    slope, error = linear.slope[..., first : first + STATE], linear.windows.input_error
    if error is not None:
        slope = np.concatenate([slope, error], axis=-1)
    prior = (np.arange(slope.shape[-1]) >= STATE).astype(float)  # input errors have unit variance
    sigma = noise_of(residual, linear.windows, limits=limits)
    weight = np.where(linear.windows.valid, 1.0 / sigma, 0.0)
    rows = (slope * np.nan_to_num(weight)[..., None]).reshape(len(slope), -1, slope.shape[-1])
    white = (residual * np.nan_to_num(weight)).reshape(len(slope), -1, 1)
    transposed = np.swapaxes(rows, 1, 2)
    size = np.sqrt(np.einsum("wfm,wmf->wf", transposed, rows))[:, :, None] + 1e-30
    gram = (transposed / size) @ (rows / np.swapaxes(size, 1, 2))
    gram = gram + (1e-9 + prior[:, None] / size**2) * np.eye(slope.shape[-1])
    change = np.linalg.solve(gram, (transposed / size) @ white) / size
    return linear._replace(residual=residual - (slope @ change[:, None])[..., 0]), sigma


def _stretches(
    linear: Linearisation, sigma: np.ndarray, names: Iterable[str], limits: Thresholds
) -> dict[str, _Stretches]:
    """Return the stretches of the residuals, by group of channels in `names` with enough rows.

    All stretches of a group get the number of rows that nine of ten usable windows have.
    """
    windows, groups = linear.windows, {}
    for name in names:
        channels = SLICES[name]
        valid = np.asarray(np.all(windows.valid[..., channels], axis=-1))
        count = valid.sum(axis=1)
        if not np.isfinite(sigma[channels]).all() or count.max(initial=0) < LEAST_ROWS:
            continue
        rows = int(np.quantile(count[count >= LEAST_ROWS], 0.1))
        chosen = np.flatnonzero(count >= rows)
        first_rows = np.argsort(~valid[chosen], axis=1, kind="stable")[:, :rows]
        times_s = np.take_along_axis(np.asarray(windows.row_s)[chosen], first_rows, axis=1)
        time_s = np.median(times_s, axis=0)
        # Windows with a lost row or jitter stay, since their times differ little from the median
        # times. Windows with a hole are left out.
        alike = np.abs(times_s - time_s).max(axis=1) <= limits.colour_aside * np.diff(time_s).mean()
        values = linear.residual[chosen][..., channels]
        stacked = np.take_along_axis(values, first_rows[..., None], axis=1)[alike]
        if not len(stacked):
            continue
        time = (time_s - time_s.mean()) / (time_s[-1] - time_s[0])
        powers = time[:, None] ** np.arange(limits.colour_degree + 1)
        drift = _drift_covariance(time_s - time_s[0], INTEGRATED.get(name, 0))
        residuals = np.moveaxis(stacked, 1, 0).reshape(rows, -1)
        groups[name] = _Stretches(time_s, residuals, powers, drift)
    return groups


def _drift_covariance(time_s: np.ndarray, integrations: int) -> np.ndarray:
    """Return the covariance (N, N), 1 after 1 s, of white noise integrated 1 or 2 times; else 0."""
    early, late = np.minimum.outer(time_s, time_s), np.maximum.outer(time_s, time_s)
    if integrations == 2:
        return 0.5 * early**2 * (3.0 * late - early)
    return early if integrations == 1 else np.zeros_like(early)


def _without_polynomial(stretches: _Stretches, process: _Process) -> tuple[np.ndarray, int, float]:
    """Return the energy (V * C,) without the polynomial, its freedom, and half a log-determinant.

    The energy is that of each column whitened by `process`; the log-determinant is a term of the
    restricted likelihood.
    """
    correlation = _correlation(stretches.time_s, process.share, process.lasts_s)
    lower = np.linalg.cholesky(correlation + process.drift * stretches.drift)
    columns = np.concatenate([stretches.powers, stretches.values], axis=1)
    white = solve_triangular(lower, columns, lower=True, check_finite=False)
    degree = stretches.powers.shape[1]
    basis, upper = np.linalg.qr(white[:, :degree])
    values = white[:, degree:]
    # Rounding errors can make the energy of a flight at rest negative.
    energy = np.maximum((values**2).sum(axis=0) - ((basis.T @ values) ** 2).sum(axis=0), 0.0)
    half_log_det = np.log(np.diag(lower)).sum() + np.log(np.abs(np.diag(upper))).sum()
    return energy, len(values) - degree, float(half_log_det)


def _fit_by_time(
    stretches: _Stretches, limits: Thresholds, times_s: Sequence[float] = TIMES_S
) -> list[tuple[_Process, float]]:
    """Return the most likely process for each T, and its log-likelihood above white noise's."""

    def score(process: _Process) -> float:
        """Return the restricted log-likelihood, less the cost of a drift."""
        energy, freedom, half_log_det = _without_polynomial(stretches, process)
        # Every stretch has a noise variance of its own, so that a few bad ones do not dominate.
        size = 0.5 * freedom * np.log(np.maximum(energy, 1e-300))
        cost = limits.drift_gain if process.drift else 0.0
        return -float((half_log_det + size).sum()) - cost

    drifts = DRIFTS if stretches.drift.any() else (0.0,)
    white = max((_Process(0.0, 1.0, drift) for drift in drifts), key=score)
    white_score, fits = score(white), []
    for lasts_s in times_s:
        without_drift = minimize_scalar(
            lambda share, t=lasts_s: -score(_Process(share, t, 0.0)),
            bounds=(0.0, 0.999),
            method="bounded",
            options={"xatol": 0.01},
        )
        best = _Process(float(without_drift.x), lasts_s, 0.0)
        best_score = -float(without_drift.fun)
        if white.drift:
            drifting, drifting_score = _with_drift(score, best, white.drift)
            if drifting_score > best_score:
                best, best_score = drifting, drifting_score
        fits.append((best, best_score - white_score))
    return fits


def _with_drift(
    score: Callable[[_Process], float], begin: _Process, drift: float
) -> tuple[_Process, float]:
    """Return the process with the best `score` and the T of `begin`, and that score."""

    def process_at(x: np.ndarray) -> _Process:
        drift = float(np.exp(np.clip(x[1], -12.0, 14.0)))
        return begin._replace(share=float(expit(x[0])), drift=drift)

    share = np.clip(begin.share, 0.01, 0.99)
    best = minimize(
        lambda x: -score(process_at(x)),
        np.array([logit(share), np.log(drift)]),
        method="Nelder-Mead",
        options={"maxfev": 30, "xatol": 0.05, "fatol": 0.1},
    )
    return process_at(best.x), -float(best.fun)


def rotor_noise(windows: FlightWindows, limits: Thresholds = THRESHOLDS) -> float:
    """Return an upper limit of the noise of measured rotor speeds that are an input [rad/s].

    An input has no residuals, so fast changes of the speeds themselves count as noise.
    """
    rotors = SLICES["rotor speed"]
    others = ((0, 0), (0, 0), (rotors.start, 0))  # the channels before the rotor speeds
    speeds, valid = (np.pad(x, others) for x in (windows.row_rotor_speed, windows.rotor_valid))
    sigma = noise_of(speeds, windows._replace(valid=valid), limits.rotor_noise_rows, limits)
    return float(np.sqrt((sigma[rotors] ** 2).mean()))


def noise_of(
    residual: np.ndarray,
    windows: FlightWindows,
    rows_together: int | None = None,
    limits: Thresholds = THRESHOLDS,
) -> np.ndarray:
    """Return the standard deviation (19,) of each channel's noise in `residual` (W, N, 19).

    NaN where nothing was measured. A channel with too few rows in every window gets its RMS, an
    upper limit. A polynomial is subtracted from (by default `limits.noise_rows`) rows together.
    """
    block_rows, degree = rows_together or limits.noise_rows, limits.noise_degree
    # Sum of squares and degrees of freedom of each piece, by channel.
    pieces: list[list[tuple[float, int]]] = [[] for _ in range(CHANNELS)]
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
                    pieces[channel].append((float(energy), count - degree - 1))
    sigma = np.full(CHANNELS, np.nan)
    for c in range(CHANNELS):
        if pieces[c]:
            sigma[c] = np.sqrt(typical_variance(*np.array(pieces[c]).T))
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
    """Return noise (T, R) like that of rotor speeds `speed` (T, R), NaN where `speed` is NaN."""
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
