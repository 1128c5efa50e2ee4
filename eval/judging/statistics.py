"""Confidence intervals of scores: Wilson, bootstrap, and differences on the same trials."""

from __future__ import annotations

from collections.abc import Callable
from math import comb, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95
"""Confidence of every interval in tables and result files."""
AT_ONCE = 10_000_000
"""Most bootstrap draws in memory at once."""


class Interval(NamedTuple):
    """An estimate and its confidence interval."""

    value: float
    low: float
    high: float


class PairedDifference(NamedTuple):
    """Difference of two success rates on the same trials."""

    value: float
    """First minus second."""
    low: float
    high: float
    p_value: float
    """Exact McNemar test, two-sided."""
    only_first: int
    """Trials in which only the first succeeded."""
    only_second: int
    """Trials in which only the second succeeded."""


def wilson(successes: float, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return the success rate with its score interval (Wilson 1927, no continuity correction).

    A trial that was flown several times counts with its mean.

    Raises:
        ValueError: unless 0 <= successes <= trials and trials >= 1.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(
            f"{successes} successes in {trials} trials: wanted 0 <= successes <= "
            "trials and at least one trial"
        )
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / trials
    middle = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * sqrt(rate * (1 - rate) / trials + (z / (2 * trials)) ** 2)
    # Exact at the ends, where rounding would leave 1e-17 or 1 - 1e-16.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == trials else middle + half
    return Interval(rate, low, high)


def bootstrap_median(
    values: np.ndarray, seed: int = 0, confidence: float = CONFIDENCE, resamples: int = 4000
) -> Interval:
    """Return the median of values (n,) with its percentile bootstrap interval (Efron 1979).

    NaN in all three where there is no value; the same seed gives the same interval.
    """
    return _bootstrap(np.median, values, seed, confidence, resamples)


def bootstrap_mean(
    values: np.ndarray, seed: int = 0, confidence: float = CONFIDENCE, resamples: int = 4000
) -> Interval:
    """Return the mean of values (n,) with its percentile bootstrap interval (Efron 1979).

    NaN in all three where there is no value; the same seed gives the same interval.
    """
    return _bootstrap(np.mean, values, seed, confidence, resamples)


def expected_largest(values: np.ndarray, among: int) -> float | None:
    """Return the mean of the largest of `among` of the values (n,), over all ways to pick them.

    None where there are fewer values than that.
    """
    count = len(values)
    if count < among:
        return None
    # The k-th smallest (from 0) is the largest of comb(k, among - 1) of all picks.
    picks = [comb(k, among - 1) / comb(count, among) for k in range(count)]
    return float(np.sort(values) @ np.array(picks))


def _bootstrap(
    statistic: Callable[..., np.ndarray],
    values: np.ndarray,
    seed: int,
    confidence: float,
    resamples: int,
) -> Interval:
    values = np.asarray(values, float)
    if not len(values):
        return Interval(float("nan"), float("nan"), float("nan"))
    rng, rows = np.random.default_rng(seed), max(1, AT_ONCE // len(values))
    found = np.concatenate(
        [
            statistic(values[rng.integers(0, len(values), (count, len(values)))], axis=1)
            for count in [rows] * (resamples // rows) + [resamples % rows]
            if count
        ]
    )
    low, high = np.quantile(found, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(statistic(values)), float(low), float(high))


def paired_bootstrap(
    first: np.ndarray, second: np.ndarray, seed: int = 0, confidence: float = CONFIDENCE
) -> Interval:
    """Return the median of first - second, (n,) on the same trials, with its interval.

    Raises:
        ValueError: where the two have not the same length.
    """
    if len(first) != len(second):
        raise ValueError(f"{len(first)} values against {len(second)}: pairs need as many of each")
    return bootstrap_median(np.asarray(first, float) - np.asarray(second, float), seed, confidence)


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Return the two-sided exact p-value of McNemar's test from the discordant pairs."""
    n, few = only_first + only_second, min(only_first, only_second)
    tail = sum(comb(n, k) for k in range(few + 1))
    return min(1.0, 2 * tail / 2**n)


def paired_success(
    first: np.ndarray, second: np.ndarray, confidence: float = CONFIDENCE
) -> PairedDifference:
    """Return the difference of two success rates on the same trials.

    The interval is Newcombe's (1998, method 10): Wilson intervals joined by square-and-add, with
    the correlation of the pairs.

    Args:
        first: (n,) bool, in the order of the trials.
        second: (n,) bool, the same trials in the same order.
        confidence: of the interval.

    Raises:
        ValueError: where there is no trial, or not as many in both.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    if len(first) != len(second):
        raise ValueError(f"{len(first)} trials against {len(second)}: pairs need as many of each")
    n = len(first)
    both, neither = int((first & second).sum()), int((~first & ~second).sum())
    only_first, only_second = int((first & ~second).sum()), int((~first & second).sum())
    one = wilson(both + only_first, n, confidence)
    two = wilson(both + only_second, n, confidence)
    product = (
        (both + only_first)
        * (only_second + neither)
        * (both + only_second)
        * (only_first + neither)
    )
    covariance = both * neither - only_first * only_second
    if covariance > 0:
        covariance = max(covariance - n / 2, 0.0)
    phi = covariance / sqrt(product) if product else 0.0

    def joined(a: float, b: float) -> float:
        return sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))

    value = one.value - two.value
    return PairedDifference(
        value,
        value - joined(one.value - one.low, two.high - two.value),
        value + joined(one.high - one.value, two.value - two.low),
        mcnemar_exact(only_first, only_second),
        only_first,
        only_second,
    )


def over_seeds(
    first: np.ndarray, second: np.ndarray | None = None, seed: int = 0, draws: int = 4000
) -> Interval:
    """Return a mean, or the difference of two, with its 95 % interval over seeds and trials.

    A hierarchical bootstrap: training seeds and trials are resampled, the same trials for all
    seeds of a draw. With few seeds that is too narrow (Owen 2007, The pigeonhole bootstrap), so its
    deviations are scaled to the variance of a two-way layout of random effects, and to Student's t
    with Satterthwaite's (1946) degrees of freedom.

    Args:
        first: (S, T) values, such as successes, of S training seeds on T trials.
        second: (R, T) of another method on the same trials, to be subtracted.
        seed: of the draws.
        draws: of the bootstrap.

    Raises:
        ValueError: with fewer than two seeds a method, fewer than two trials, or other trials.
    """
    from scipy.stats import t as student

    groups = [np.asarray(group, float) for group in (first, second) if group is not None]
    count = groups[0].shape[1]
    for group in groups:
        if group.ndim != 2 or min(group.shape) < 2 or group.shape[1] != count:
            raise ValueError(
                f"values are {[each.shape for each in groups]}; wanted (seeds, trials), two or "
                "more of each, and the same trials"
            )
    signs = (1.0, -1.0)[: len(groups)]
    value = sum(sign * group.mean() for sign, group in zip(signs, groups, strict=True))
    of_trials = sum(sign * group.mean(0) for sign, group in zip(signs, groups, strict=True))
    variance = (parts := [float(np.var(of_trials, ddof=1)) / count])[0]
    freedom = [count - 1.0]
    rng, drawn = np.random.default_rng(seed), np.zeros(draws)
    trials = rng.multinomial(count, np.full(count, 1 / count), draws) / count
    for sign, group in zip(signs, groups, strict=True):
        n = len(group)
        between = float(np.var(group.mean(1), ddof=1)) / n
        rest = group - group.mean(1, keepdims=True) - group.mean(0) + group.mean()
        noise = float((rest**2).sum()) / ((n - 1) * (count - 1)) / (n * count)
        variance += between - noise
        parts, freedom = [*parts, between, noise], [*freedom, n - 1.0, (n - 1.0) * (count - 1.0)]
        seeds = rng.multinomial(n, np.full(n, 1 / n), draws) / n
        drawn += sign * np.einsum("ds,st,dt->d", seeds, group, trials, optimize=True)
    largest = max(variance, max(parts))
    spread = float(drawn.std())
    if not largest or not spread:
        return Interval(float(value), float(value), float(value))
    degrees = largest**2 / sum(part**2 / df for part, df in zip(parts, freedom, strict=True))
    wide = sqrt(largest) * float(student.ppf(0.975, max(1.0, degrees))) / (1.959964 * spread)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(
        float(value), float(value + wide * (low - value)), float(value + wide * (high - value))
    )
