"""Fits size, autocorrelation and drift of a state estimate's errors to their variogram.

The variogram g(l) is half the mean squared difference of two errors whose times differ by l, the
lag. A constant bias does not change it (Cressie 1993, "Statistics for spatial data", section 2.4).
The model is coloured noise (correlated in time) and a drift (a random walk with the distance). The
noise, with the variance v, is the sum of two first-order Gauss-Markov processes: a fast one with
the share f of v and the correlation time T_f, and a slow one with the correlation time T. The drift
has the variance c^2 for each metre; s is the speed:

    g(l) = v (1 - f exp(-l / T_f) - (1 - f) exp(-l / T)) + c^2 s l / 2

The drift c is fitted first, at lags of seconds. The other parameters are fitted to the variogram at
lags up to one second, and to the variance about the mean of each flight, v (1 - m) + c^2 s D / 6.
Here D is the duration of the flight, and m is the variance of the noise's mean divided by v. Each
stretch of 5 s has its own variogram; the disagreement between stretches gives the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from eval.judging.statistics import Interval
from suite.diagnose.estimate.block import normal_equations
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.identify.fit import DIFFER_P
from suite.diagnose.sensors.errors import ZERO, significant, stretches

SHORT_S = 1.0
"""The autocorrelation is fitted up to this lag [s]."""
SHORT_LAGS, LONG_LAGS = 40, 8
"""Number of lags up to `SHORT_S`, and number of lags for the fit of a drift."""
LONG_S, LONGEST = 2.0, 1.0 / 3.0
"""Lags for the fit of a drift: the shortest [s], and the longest as a share of a flight."""
LEAST_S = 0.01
"""Least correlation time in the fit [s]; the largest is the longest lag for a drift."""
TINY_S = 1e-6
"""Lower limit of a correlation time in a division [s]."""
LOG_RATIO = (-7.0, -0.7)
"""Bounds of log T_f / T, the fast correlation time over the slow one."""
LONGEST_NEW = 0.3
"""A fast correlation time below this share of the rows' distance counts as 0."""


class Series(NamedTuple):
    """One error along one flight of T rows."""

    value: np.ndarray
    """(T,) error; NaN where it is missing."""
    speed: np.ndarray
    """(T,) speed of the vehicle [m/s]; zeros for an error without drift."""
    step_s: float
    """Time between rows [s]."""

    @property
    def duration_s(self) -> float:
        """Duration of the flight [s]."""
        return len(self.value) * self.step_s


class Coloured(NamedTuple):
    """Parameters of one error; coloured means correlated in time."""

    noise: Interval
    """Standard deviation of the noise (without bias and drift), in the unit of the error."""
    fast: Interval
    """Share of the fast process in the variance of the noise."""
    fast_s: Interval
    """Correlation time of the fast process; 0 if its values are independent from row to row [s]."""
    lasts_s: Interval
    """Correlation time of the slow process [s]."""
    drift: Interval
    """Random walk with the distance [unit/sqrt(m)]."""
    bias: Interval
    """Standard deviation, over flights, of the part of the error that is constant in a flight."""

    def correlation(self, lag_s: np.ndarray, duration_s: float) -> np.ndarray:
        """Return the autocorrelation (L,) about the mean of a flight of `duration_s`."""
        colour = Colour(self.fast.value, self.fast_s.value, self.lasts_s.value)
        mean_share = colour.mean_variance(duration_s)
        return (colour.correlation(lag_s) - mean_share) / (1.0 - mean_share)


class Colour(NamedTuple):
    """Correlation of noise in time."""

    fast: float
    """Share of the fast process in the variance."""
    fast_s: float
    """Correlation time of the fast process [s]."""
    lasts_s: float
    """Correlation time of the slow process [s]."""

    def correlation(self, lag_s: np.ndarray) -> np.ndarray:
        """Return the autocorrelation at the lags `lag_s` (L,) [s]."""
        fast, slow = (np.exp(-lag_s / max(t, TINY_S)) for t in (self.fast_s, self.lasts_s))
        return self.fast * fast + (1.0 - self.fast) * slow

    def mean_variance(self, duration_s: float) -> float:
        """Return the variance of the mean over `duration_s`, divided by that of the noise."""
        total = 0.0
        for share, time_s in ((self.fast, self.fast_s), (1.0 - self.fast, self.lasts_s)):
            ratio = max(time_s, TINY_S) / duration_s
            total += share * (2.0 * ratio * (1.0 - ratio * (1.0 - float(np.exp(-1.0 / ratio)))))
        return total


class _Variograms(NamedTuple):
    """Variograms of B stretches at L lags, and with one more column the variance about the mean."""

    value: np.ndarray
    """(B, L) half the mean squared difference of errors at each lag."""
    weight: np.ndarray
    """(B, L) share of each stretch in the pairs of rows at a lag."""
    speed: np.ndarray
    """(B, 1) mean speed of each stretch [m/s]."""
    flight: np.ndarray
    """(B,) number of the flight of each stretch."""


def fit_colour(flights: Sequence[Series]) -> Coloured | None:
    """Fit size, autocorrelation and drift; None if the flights have less than two stretches.

    Every flight has at least one error that is not missing.
    """
    if not flights:
        return None
    step_s = max(flight.step_s for flight in flights)
    # No lags are measured but whole rows of the slowest flight.
    lag_s = step_s * np.rint(np.linspace(step_s, max(SHORT_S, step_s), SHORT_LAGS) / step_s)
    variograms = _variograms(flights, lag_s, about_mean=True)
    if variograms is None:
        return None
    drift = _drift(flights) if any(flight.speed.any() for flight in flights) else ZERO
    theta, half = _noise(flights, variograms, lag_s, 0.0)
    if significant(drift):
        # At long lags a slow noise resembles a drift. Noise that lasts longer counts as a drift.
        if _colour(theta).lasts_s > LONG_S:
            theta, half = _noise(flights, variograms, lag_s, drift.value**2)
        else:
            drift = drift._replace(value=0.0, low=0.0)
    # Convert the logarithms of the fit into parameters with intervals.
    log_variance, share, _, _ = theta
    colour, sd = _colour(theta), float(np.exp(0.5 * log_variance))
    low, high = np.clip([share - half[1], share + half[1]], 0.0, 1.0)
    fast_s = _from_log(colour.fast_s, float(np.hypot(half[2], half[3])))
    if colour.fast and colour.fast_s < LONGEST_NEW * step_s:
        colour = colour._replace(fast_s=0.0)
        fast_s = Interval(0.0, 0.0, min(fast_s.high, step_s))
    return Coloured(
        _from_log(sd, 0.5 * half[0]),
        Interval(float(share), float(low), float(high)),
        fast_s,
        _from_log(colour.lasts_s, half[3]),
        drift,
        _bias(flights, sd**2, colour),
    )


def _from_log(value: float, half: float) -> Interval:
    """Return the interval of `value`, whose logarithm has an interval of half-width `half`."""
    factor = float(np.exp(half))
    return Interval(value, value / factor, value * factor)


def _colour(theta: np.ndarray) -> Colour:
    """Return the correlation in time for the parameters (4,) of `_noise`."""
    return Colour(float(theta[1]), float(np.exp(theta[2] + theta[3])), float(np.exp(theta[3])))


def _noise(
    flights: Sequence[Series], variograms: _Variograms, lag_s: np.ndarray, walk: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the noise in addition to a random walk of the variance `walk` for each metre.

    The fast process is used only if its share is significant. `lag_s` (L,) are the lags of the
    variograms [s], whose last column is the variance about the mean. Returned are log v, f, log
    (T_f / T) and log T (4,), and the half-widths of their intervals.
    """
    duration_s = float(np.mean([flight.duration_s for flight in flights]))
    measured = variograms.value
    # The variance is the variogram's limit at long lags. It counts as much as all short lags.
    weight = variograms.weight * np.append(np.ones(SHORT_LAGS), SHORT_LAGS)
    root = np.sqrt(weight)
    size = float((variograms.weight[:, -1] * measured[:, -1]).sum()) + 1e-300

    def model(theta: np.ndarray) -> np.ndarray:
        """Return the modelled variogram (B, L), then the variance about the flight's mean."""
        variance, colour = np.exp(theta[0]), _colour(theta)
        at_lags = variance * (1.0 - colour.correlation(lag_s))
        about_mean = variance * (1.0 - colour.mean_variance(duration_s))
        drifted = 0.5 * walk * variograms.speed * np.append(lag_s, duration_s / 3.0)
        return np.append(at_lags, about_mean) + drifted

    def residual(theta: np.ndarray) -> np.ndarray:
        """Return the weighted residuals as one array."""
        return (root * (measured - model(theta)) / size).ravel()

    longest = max(LONGEST * duration_s, 2.0 * LONG_S)
    low = np.array([np.log(size) - 10.0, 0.0, LOG_RATIO[0], np.log(LEAST_S)])
    high = np.array([np.log(size) + 3.0, 1.0, LOG_RATIO[1], np.log(longest)])

    def fitted(free: list[int], start: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Fit the entries of theta at `free`; return theta, half-widths and squared error."""

        def complete(values: np.ndarray) -> np.ndarray:
            """Return all entries of theta for the values of the free ones."""
            theta = start.copy()
            theta[free] = values
            return theta

        best = least_squares(
            lambda values: residual(complete(values)), start[free], bounds=(low[free], high[free])
        )
        half = np.zeros(4)
        slope = -best.jac.reshape(*weight.shape, len(free))
        half[free] = np.minimum(_half_widths(slope, best.fun, variograms.flight), 20.0)
        return complete(best.x), half, float(best.cost)

    # Fit the slow process alone, then both; keep both only if the fast share is significant.
    slow, slow_half, _ = fitted([0, 3], np.array([np.log(size), 0.0, -1.5, np.log(0.3)]))
    starts = [np.array([np.log(size), 0.3, ratio, np.log(0.5)]) for ratio in (-1.5, -4.0)]
    fits = (fitted([0, 1, 2, 3], start) for start in starts)
    mixed, half, _ = min(fits, key=lambda fit: fit[2])
    return (mixed, half) if half[1] < mixed[1] < 1.0 - half[1] else (slow, slow_half)


def _drift(flights: Sequence[Series]) -> Interval:
    """Fit the random walk with the distance to the variogram's slope at long lags."""
    longest = LONGEST * min(flight.duration_s for flight in flights)
    if longest < 2.0 * LONG_S:
        return ZERO
    step_s = max(flight.step_s for flight in flights)
    lag_s = step_s * np.rint(np.geomspace(LONG_S, longest, LONG_LAGS) / step_s)
    variograms = _variograms(flights, lag_s)
    if variograms is None:
        return ZERO
    # A line in the lag: a constant for the noise, and a slope for the drift. The variance of a
    # variogram g grows like g^2 times the lag (Cressie 1993, section 2.4).
    pooled = (variograms.weight * variograms.value).sum(axis=0)
    root = np.sqrt(variograms.weight / lag_s) / np.maximum(pooled, 1e-300)
    columns = [np.ones_like(root), 0.5 * variograms.speed * lag_s]
    slope = np.stack(columns, axis=-1) * root[..., None]
    flat, measured = slope.reshape(-1, 2), (root * variograms.value).ravel()
    theta = np.linalg.lstsq(flat, measured, rcond=None)[0]
    half = _half_widths(slope, measured - flat @ theta, variograms.flight)[1]
    # A variance that is estimated too low seems too certain. So the upper end is that of an
    # interval of the logarithm; the lower end can be 0.
    power, half = max(float(theta[1]), 0.0), float(half)
    high = max(power + half, power * np.exp(half / power) if half < power else 0.0)
    return Interval(*(float(v) for v in np.sqrt([power, max(power - half, 0.0), high])))


def _variograms(
    flights: Sequence[Series], lag_s: np.ndarray, about_mean: bool = False
) -> _Variograms | None:
    """Return the variograms of all stretches at the lags (L,); None for less than two stretches.

    With `about_mean` there is one more column: the mean square about the mean of the flight. A
    stretch without a pair of rows is left out.
    """
    values, counts, speeds, flight_of = [], [], [], []
    for number, flight in enumerate(flights):
        stretch = stretches(len(flight.value), flight.step_s)
        size = stretch[-1] + 1
        lags = np.rint(lag_s / flight.step_s).astype(int)
        squares = [0.5 * (flight.value[k:] - flight.value[:-k]) ** 2 for k in lags]
        if about_mean:
            squares += [(flight.value - np.nanmean(flight.value)) ** 2]
        # Sum the squares and count them, by stretch, for each lag.
        totals, pairs = [], []
        for square in squares:
            good = np.isfinite(square)
            where = stretch[: len(good)][good]
            totals.append(np.bincount(where, square[good], size))
            pairs.append(np.bincount(where, minlength=size))
        total, count = np.stack(totals, axis=1), np.stack(pairs, axis=1)
        used = count[:, : len(lags)].any(axis=1)
        values.append((total / np.maximum(count, 1))[used])
        counts.append(count[used])
        known = np.isfinite(flight.speed)
        rows = np.bincount(stretch[known], minlength=size)
        speed = np.bincount(stretch[known], flight.speed[known], size) / np.maximum(rows, 1)
        speeds.append(speed[used, None])
        flight_of.append(np.full(used.sum(), number))
    all_counts = np.concatenate(counts)
    if len(all_counts) < 2 or not all_counts.any(axis=0).all():
        return None
    return _Variograms(
        np.concatenate(values),
        all_counts / all_counts.sum(axis=0),
        np.concatenate(speeds),
        np.concatenate(flight_of),
    )


def _half_widths(slope: np.ndarray, residual: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the half-widths (K,) of 95 % intervals by slopes (B, L, K) and residuals (B * L,)."""
    equations = normal_equations(slope, residual.reshape(slope.shape[:2]), flight)
    return intervals95(equations, DIFFER_P, leave_out=True, noise_share=0.0).half_width


def _bias(flights: Sequence[Series], variance: float, colour: Colour) -> Interval:
    """Return the standard deviation, over flights, of the mean error, without that by noise."""
    means, count = np.array([np.nanmean(flight.value) for flight in flights]), len(flights)
    noise = variance * np.mean([colour.mean_variance(f.duration_s) for f in flights])
    power = float((means**2).mean())
    # A sum of `count` squared normal variables has a chi-square distribution.
    ends = (power * count / chi2.ppf(share, count) for share in (0.975, 0.025))
    low, high = (np.sqrt(max(end - noise, 0.0)) for end in ends)
    return Interval(float(np.sqrt(max(power - noise, 0.0))), float(low), float(high))
