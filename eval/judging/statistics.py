"""Confidence intervals of scores: success rates, medians, paired differences, training seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import comb, nan, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95
"""Confidence of every interval in tables and result files."""
NORMAL_QUANTILE = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
"""97.5 % quantile of the standard normal distribution."""
LEAST_VALUES = 6
"""Smallest number of values for which a median has an interval: even the whole range of five values
contains the median of their distribution with a probability of only 94 %."""
AT_ONCE = 10_000_000
"""Largest number of resampled values that a bootstrap holds in memory at once."""


class Interval(NamedTuple):
    """An estimate and its confidence interval."""

    value: float
    low: float
    high: float


class PairedDifference(NamedTuple):
    """Difference of two success rates on the same trials."""

    value: float
    """First success rate minus second success rate."""
    low: float
    """Lower end of the confidence interval."""
    high: float
    """Upper end of the confidence interval."""
    p_value: float
    """Two-sided p-value of the exact McNemar test."""
    only_first: int
    """Number of trials in which only the first succeeded."""
    only_second: int
    """Number of trials in which only the second succeeded."""


def wilson(successes: float, trials: int) -> Interval:
    """Return the success rate with its score interval (Wilson 1927, no continuity correction).

    A trial that was flown several times counts with its mean.

    Raises:
        ValueError: unless 0 <= successes <= trials and trials >= 1.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(
            f"{successes} successes in {trials} trials: expected 0 <= successes <= trials and at "
            "least one trial"
        )
    z, rate = NORMAL_QUANTILE, successes / trials
    middle = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * sqrt(rate * (1 - rate) / trials + (z / (2 * trials)) ** 2)
    # Exactly 0 and 1 at the ends, without rounding errors.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == trials else middle + half
    return Interval(rate, low, high)


def wilson_by_group(groups: Sequence[Sequence[bool]]) -> Interval:
    """Return the share of true values in all groups, with a Wilson interval over groups.

    The values of a group may depend on each other, as the components of one estimate do. So the
    interval is that of as many trials as there are groups with a value. It is too wide where the
    values of a group are independent.

    Raises:
        ValueError: if there is no value.
    """
    values = [value for group in groups for value in group]
    count = sum(bool(group) for group in groups)
    return wilson(count * (sum(values) / max(len(values), 1)), count)


def bootstrap(
    values: np.ndarray,
    seed: int = 0,
    statistic: Callable[..., np.ndarray] = np.median,
    resamples: int = 4000,
) -> Interval:
    """Return a statistic of values (n,) with its percentile bootstrap interval (Efron 1979).

    Without values the estimate is NaN, and with fewer than `LEAST_VALUES` the ends of the interval
    are. The same seed gives the same interval.
    """
    values = np.asarray(values, float)
    if len(values) < LEAST_VALUES:
        return Interval(float(statistic(values)) if len(values) else nan, nan, nan)
    rng, rows = np.random.default_rng(seed), max(1, AT_ONCE // len(values))
    resampled = np.concatenate(
        [
            statistic(values[rng.integers(0, len(values), (count, len(values)))], axis=1)
            for count in [rows] * (resamples // rows) + [resamples % rows]
            if count
        ]
    )
    low, high = np.quantile(resampled, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(statistic(values)), float(low), float(high))


def expected_largest(values: np.ndarray, among: int) -> float | None:
    """Return the expected maximum of `among` values that are drawn at random from values (n,).

    Each value is drawn at most once. None if n is less than `among`.
    """
    count = len(values)
    if count < among:
        return None
    # The k-th smallest (from 0) is the largest in comb(k, among - 1) of all comb(n, among) choices.
    probability = [comb(k, among - 1) / comb(count, among) for k in range(count)]
    return float(np.sort(values) @ np.array(probability))


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Return the two-sided exact p-value of McNemar's test.

    In `only_first` pairs only the first succeeded, in `only_second` pairs only the second.
    """
    n, fewer = only_first + only_second, min(only_first, only_second)
    tail = sum(comb(n, k) for k in range(fewer + 1))
    return min(1.0, 2 * tail / 2**n)


def paired_success(first: np.ndarray, second: np.ndarray) -> PairedDifference:
    """Return the difference of two success rates on the same trials.

    The interval is that of Newcombe (1998, method 10): Wilson intervals combined by the
    square-and-add rule, with the correlation phi of the pairs. Both are (n,) bool, in the order of
    the trials.

    Raises:
        ValueError: where there is no trial, or the lengths differ.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    if len(first) != len(second):
        raise ValueError(f"{len(first)} trials against {len(second)}: pairs need as many of each")
    n = len(first)
    both, neither = int((first & second).sum()), int((~first & ~second).sum())
    only_first, only_second = int((first & ~second).sum()), int((~first & second).sum())
    rate_1 = wilson(both + only_first, n)
    rate_2 = wilson(both + only_second, n)
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

    def combine(a: float, b: float) -> float:
        return sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))

    value = rate_1.value - rate_2.value
    return PairedDifference(
        value,
        value - combine(rate_1.value - rate_1.low, rate_2.high - rate_2.value),
        value + combine(rate_1.high - rate_1.value, rate_2.value - rate_2.low),
        mcnemar_exact(only_first, only_second),
        only_first,
        only_second,
    )


def over_seeds(first: np.ndarray, second: np.ndarray | None = None, draws: int = 4000) -> Interval:
    """Return a mean, or the difference of two means, with its 95 % interval.

    The interval is over training seeds and trials.

    It is a hierarchical bootstrap: training seeds and trials are resampled, with the same trials
    for all seeds of a resample. With few seeds its interval is too narrow (Owen 2007, The
    pigeonhole bootstrap). So its deviations are scaled to the variance of a two-way random effects
    model, and to Student's t with Satterthwaite's (1946) degrees of freedom.

    Args:
        first: (S, T) values, such as successes, of S training seeds on T trials.
        second: (R, T) values of another method on the same trials, which are subtracted.
        draws: number of resamples.

    Raises:
        ValueError: with fewer than two seeds of a method, fewer than two trials, or different
            numbers of trials.
    """
    from scipy.stats import t as student

    groups = [np.asarray(group, float) for group in (first, second) if group is not None]
    trial_count = groups[0].shape[1]
    for group in groups:
        if min(group.shape) < 2 or group.shape[1] != trial_count:
            raise ValueError(
                "an interval over training seeds needs two or more seeds of each method and two or "
                "more trials, the same for all; given are "
                + " and ".join(f"{len(each)} seeds of {each.shape[1]} trials" for each in groups)
            )
    signs = (1.0, -1.0)[: len(groups)]
    value = sum(sign * group.mean() for sign, group in zip(signs, groups, strict=True))
    trial_means = sum(sign * group.mean(0) for sign, group in zip(signs, groups, strict=True))
    # Variance of the mean: between trials, plus between seeds, less the noise that both contain.
    variance = float(np.var(trial_means, ddof=1)) / trial_count
    variances, part_degrees = [variance], [trial_count - 1.0]
    rng, resampled = np.random.default_rng(0), np.zeros(draws)
    trials = (
        rng.multinomial(trial_count, np.full(trial_count, 1 / trial_count), draws) / trial_count
    )
    for sign, group in zip(signs, groups, strict=True):
        seed_count = len(group)
        seed_variance = float(np.var(group.mean(1), ddof=1)) / seed_count
        residual = group - group.mean(1, keepdims=True) - group.mean(0) + group.mean()
        noise_variance = (
            float((residual**2).sum())
            / ((seed_count - 1) * (trial_count - 1))
            / (seed_count * trial_count)
        )
        variance += seed_variance - noise_variance
        variances = [*variances, seed_variance, noise_variance]
        part_degrees = [*part_degrees, seed_count - 1.0, (seed_count - 1.0) * (trial_count - 1.0)]
        seeds = rng.multinomial(seed_count, np.full(seed_count, 1 / seed_count), draws) / seed_count
        resampled += sign * np.einsum("ds,st,dt->d", seeds, group, trials, optimize=True)
    largest = max(variance, max(variances))
    resampled_sd = float(resampled.std())
    if not largest or not resampled_sd:
        return Interval(float(value), float(value), float(value))
    degrees = largest**2 / sum(
        part**2 / df for part, df in zip(variances, part_degrees, strict=True)
    )
    quantile = float(student.ppf(0.975, max(1.0, degrees)))
    factor = sqrt(largest) * quantile / (NORMAL_QUANTILE * resampled_sd)
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Interval(
        float(value), float(value + factor * (low - value)), float(value + factor * (high - value))
    )
