"""Size, autocorrelation and drift of an estimate's errors, fitted to their variogram.

The variogram, half the mean squared difference of errors a lag apart, is for two first-order
Gauss-Markov processes, a fast one with a share f of the variance v, and a random walk with the
distance (c^2 a metre, at the speed s)

    g(l) = v (1 - f exp(-l / T_f) - (1 - f) exp(-l / T)) + c^2 s l / 2

whatever constant bias a flight has (Cressie 1993, "Statistics for spatial data", section 2.4). The
drift is fitted at lags of seconds; then the others at lags up to one second and at the variance
about each flight's mean, v (1 - m) + c^2 s D / 6, where m is the share of the variance that the
mean of a flight of length D contains. Each stretch of a flight has a variogram of its own; their
disagreement gives the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from eval.judging.statistics import Interval
from suite.diagnose.estimate.block import NormalEquations, products
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.sensors.errors import DIFFER_P, STRETCH_S, acting

SHORT_S = 1.0
"""Colours are compared up to this lag [s]."""
SHORT, LONG = 40, 8
"""Lags up to `SHORT_S`, and those that show a drift."""
LONG_S, LONGEST = 2.0, 1.0 / 3.0
"""A drift shows from this lag on [s], up to this share of the shortest flight."""
LEAST_S = 0.01
"""The shortest correlation time that is tried [s]; the longest is that of a drift's lags."""
TINY_S = 1e-6
FASTER = (-7.0, -0.7)
"""Logarithm of the fast correlation time over the other."""
NOTHING = Interval(0.0, 0.0, 0.0)


class Series(NamedTuple):
    """One error along one flight."""

    value: np.ndarray
    """(T,) NaN where it is missing."""
    speed: np.ndarray
    """(T,) [m/s]; zeros where no drift is fitted."""
    step_s: float

    @property
    def duration_s(self) -> float:
        """Of the flight [s]."""
        return len(self.value) * self.step_s


class Coloured(NamedTuple):
    """Parameters of one error."""

    noise: Interval
    """Standard deviation without bias and drift, in the error's unit."""
    fast: Interval
    """Share of its variance that changes fast [1]."""
    fast_s: Interval
    """Correlation time of that share; 0 where it is new in every row [s]."""
    lasts_s: Interval
    """Correlation time of the rest [s]."""
    drift: Interval
    """Random walk with the distance [unit/sqrt(m)]."""
    bias: Interval
    """Standard deviation over flights of the part that is constant in a flight."""

    def correlation(self, lag_s: np.ndarray, duration_s: float) -> np.ndarray:
        """Return the autocorrelation (L,) that a flight of `duration_s` shows on average.

        The flight's mean is subtracted, which removes a share of a slow error.
        """
        colour = Colour(self.fast.value, self.fast_s.value, self.lasts_s.value)
        plain, lost = colour.correlation(lag_s), colour.of_mean(duration_s)
        return (plain - lost) / (1.0 - lost)


class Colour(NamedTuple):
    """Correlation of noise in time."""

    fast: float
    """Share [1]."""
    fast_s: float
    lasts_s: float

    def correlation(self, lag_s: np.ndarray) -> np.ndarray:
        """Return the autocorrelation (L,) at lags [s]."""
        fast, slow = (np.exp(-lag_s / max(t, TINY_S)) for t in (self.fast_s, self.lasts_s))
        return self.fast * fast + (1.0 - self.fast) * slow

    def of_mean(self, duration_s: float) -> float:
        """Return the variance of the mean over `duration_s`, over that of the noise."""
        both = ((self.fast, self.fast_s), (1.0 - self.fast, self.lasts_s))
        return sum(share * _of_mean(max(t, TINY_S) / duration_s) for share, t in both)


class _Rows(NamedTuple):
    """Variograms of B stretches at L lags."""

    value: np.ndarray
    """(B, L)."""
    weight: np.ndarray
    """(B, L) share of the pairs of rows at that lag."""
    speed: np.ndarray
    """(B, 1) mean [m/s]."""
    flight: np.ndarray
    """(B,)."""


def _of_mean(ratio: float) -> float:
    return 2.0 * ratio * (1.0 - ratio * (1.0 - float(np.exp(-1.0 / ratio))))


def fit_colour(flights: Sequence[Series]) -> Coloured | None:
    """Return size, colour and drift; None where the flights hold less than two stretches."""
    step_s = max(flight.step_s for flight in flights)
    rows = _variograms(flights, np.linspace(step_s, max(SHORT_S, step_s), SHORT))
    if rows is None:
        return None
    drift = _drift(flights) if any(flight.speed.any() for flight in flights) else NOTHING
    best = _noise(flights, rows, 0.0)
    if acting(drift):
        # A slow noise resembles a drift at long lags; one that lasts as long as these is a drift.
        if best.colour.lasts_s > LONG_S:
            best = _noise(flights, rows, drift.value**2)
        else:
            drift = drift._replace(value=0.0, low=0.0)
    log_v, share, _, _ = best.theta
    half, colour, sd = best.half, best.colour, float(np.exp(0.5 * log_v))
    low, high = np.clip([share - half[1], share + half[1]], 0.0, 1.0)
    fast_s = _spread(colour.fast_s, float(np.hypot(half[2], half[3])))
    if colour.fast and colour.fast_s < 0.3 * step_s:  # no row shows that it lasts
        colour = colour._replace(fast_s=0.0)
        fast_s = Interval(0.0, 0.0, min(fast_s.high, step_s))
    return Coloured(
        _spread(sd, 0.5 * half[0]),
        Interval(float(share), float(low), float(high)),
        fast_s,
        _spread(colour.lasts_s, half[3]),
        drift,
        _bias(flights, sd**2, colour),
    )


def _spread(value: float, half: float) -> Interval:
    """Return the interval of a number from that of its logarithm."""
    wide = float(np.exp(half))
    return Interval(value, value / wide, value * wide)


class _Noise(NamedTuple):
    """Noise that was fitted."""

    theta: np.ndarray
    """(4,) log v, f, log T_f / T, log T."""
    half: np.ndarray
    """(4,) half-widths of their intervals."""
    cost: float

    @property
    def colour(self) -> Colour:
        """Its correlation in time."""
        return _colour(self.theta)


def _colour(theta: np.ndarray) -> Colour:
    return Colour(float(theta[1]), float(np.exp(theta[2] + theta[3])), float(np.exp(theta[3])))


def _noise(flights: Sequence[Series], rows: _Rows, walk: float) -> _Noise:
    """Return the noise next to a random walk of `walk` a metre.

    A fast part is there only where its share is significant.
    """
    step_s = max(flight.step_s for flight in flights)
    lag_s = np.linspace(step_s, max(SHORT_S, step_s), SHORT)
    duration_s = float(np.mean([flight.duration_s for flight in flights]))
    about = _variograms(flights, None)
    assert about is not None
    # The variance counts as all short lags together: they say where the variogram ends.
    measured = np.concatenate([rows.value, about.value], axis=1)
    weight = np.concatenate([rows.weight, SHORT * about.weight], axis=1)
    size = float((about.weight * about.value).sum()) + 1e-300

    def model(theta: np.ndarray) -> np.ndarray:
        variance, colour = np.exp(theta[0]), _colour(theta)
        plain = variance * (1.0 - colour.correlation(lag_s))
        whole = variance * (1.0 - colour.of_mean(duration_s))
        drifted = 0.5 * walk * rows.speed * np.append(lag_s, duration_s / 3.0)
        return np.append(plain, whole) + drifted

    def residual(theta: np.ndarray) -> np.ndarray:
        return (np.sqrt(weight) * (measured - model(theta)) / size).ravel()

    longest = max(LONGEST * duration_s, 2.0 * LONG_S)
    low = np.array([np.log(size) - 10.0, 0.0, FASTER[0], np.log(LEAST_S)])
    high = np.array([np.log(size) + 3.0, 1.0, FASTER[1], np.log(longest)])

    def fitted(free: list[int], begin: np.ndarray) -> _Noise:
        def among(some: np.ndarray) -> np.ndarray:
            theta = begin.copy()
            theta[free] = some
            return theta

        found = least_squares(
            lambda some: residual(among(some)), begin[free], bounds=(low[free], high[free])
        )
        half = np.zeros(4)
        slope = -found.jac.reshape(*weight.shape, len(free))
        half[free] = np.minimum(_half_widths(slope, found.fun, rows.flight), 20.0)
        return _Noise(among(found.x), half, float(found.cost))

    alone = fitted([0, 3], np.array([np.log(size), 0.0, -1.5, np.log(0.3)]))
    begins = [np.array([np.log(size), 0.3, ratio, np.log(0.5)]) for ratio in (-1.5, -4.0)]
    both = min((fitted([0, 1, 2, 3], begin) for begin in begins), key=lambda one: one.cost)
    return both if both.theta[1] > both.half[1] and both.theta[1] < 1.0 - both.half[1] else alone


def _drift(flights: Sequence[Series]) -> Interval:
    """Return the random walk with the distance, by the variogram's slope at long lags."""
    longest = LONGEST * min(flight.duration_s for flight in flights)
    if longest < 2.0 * LONG_S:
        return NOTHING
    lag_s = np.geomspace(LONG_S, longest, LONG)
    rows = _variograms(flights, lag_s)
    if rows is None:
        return NOTHING
    root = np.sqrt(rows.weight)[..., None]
    slope = np.stack([np.ones_like(rows.weight), 0.5 * rows.speed * lag_s], axis=-1) * root
    flat = slope.reshape(-1, 2)
    theta = np.linalg.lstsq(flat, (root[..., 0] * rows.value).ravel(), rcond=None)[0]
    residual = (root[..., 0] * rows.value).ravel() - flat @ theta
    half = _half_widths(slope, residual, rows.flight)[1]
    ends = np.clip([theta[1], theta[1] - half, theta[1] + half], 0.0, None)
    return Interval(*(float(v) for v in np.sqrt(ends)))


def _variograms(flights: Sequence[Series], lag_s: np.ndarray | None) -> _Rows | None:
    """Return the variograms; without lags the squares about each flight's mean, in their place."""
    values, counts, speeds, flight_of = [], [], [], []
    for number, flight in enumerate(flights):
        stretch = (np.arange(len(flight.value)) * flight.step_s / STRETCH_S).astype(int)
        size = stretch[-1] + 1
        if lag_s is None:
            squares = [(flight.value - np.nanmean(flight.value)) ** 2]
        else:
            lags = np.rint(lag_s / flight.step_s).astype(int)
            squares = [0.5 * (flight.value[k:] - flight.value[:-k]) ** 2 for k in lags]
        good = [np.isfinite(square) for square in squares]
        of = [stretch[: len(ok)][ok] for ok in good]
        total = [np.bincount(a, s[ok], size) for a, s, ok in zip(of, squares, good, strict=True)]
        count = np.stack([np.bincount(a, minlength=size) for a in of], axis=1)
        there = count.any(axis=1)
        values.append((np.stack(total, axis=1) / np.maximum(count, 1))[there])
        counts.append(count[there])
        speed = np.bincount(stretch, np.nan_to_num(flight.speed)) / np.bincount(stretch)
        speeds.append(speed[there, None])
        flight_of.append(np.full(there.sum(), number))
    pairs = np.concatenate(counts)
    if len(pairs) < 2 or not pairs.any(axis=0).all():
        return None
    weight = pairs / pairs.sum(axis=0)
    speed = np.concatenate(speeds)
    return _Rows(np.concatenate(values), weight, speed, np.concatenate(flight_of))


def _half_widths(slope: np.ndarray, residual: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the half-widths (K,) of the 95 % intervals, by how stretches and flights disagree."""
    left = residual.reshape(*slope.shape[:2], 1)
    chi = (left[..., 0] ** 2).sum(axis=1)
    equations = NormalEquations(*products(slope, left), chi, flight)
    return intervals95(equations, DIFFER_P, leave_out=True, noise_share=0.0).half_width


def _bias(flights: Sequence[Series], variance: float, colour: Colour) -> Interval:
    """Return the size of the constant part of a flight: its mean, less the mean of the noise."""
    seen = [flight for flight in flights if np.isfinite(flight.value).any()]
    means, count = np.array([np.nanmean(flight.value) for flight in seen]), len(seen)
    noise = variance * np.mean([colour.of_mean(f.duration_s) for f in seen])
    power = float((means**2).mean())
    ends = (power * count / chi2.ppf(share, count) for share in (0.975, 0.025))
    low, high = (np.sqrt(max(end - noise, 0.0)) for end in ends)
    return Interval(float(np.sqrt(max(power - noise, 0.0))), float(low), float(high))
