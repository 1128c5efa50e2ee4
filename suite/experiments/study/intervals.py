"""Numbers over training seeds: their spread, and differences with intervals over trials as well.

A bootstrap of three seeds that differ is too narrow (few clusters; Cameron, Gelbach and Miller
2008, doi 10.1162/rest.90.3.414), so that a verdict asks every seed to agree besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval

DRAWS = 4000
"""Of the bootstrap."""
FEWEST_SEEDS = 3
"""With less, nothing is called a gain or a loss."""


class Spread(NamedTuple):
    """A number over training seeds."""

    mean: float
    least: float
    most: float


class Gap(NamedTuple):
    """By how much one number is above another, over training seeds and trials."""

    difference: Interval
    """Over all."""
    of_seeds: list[float]
    """Of each training seed."""

    @property
    def verdict(self) -> str:
        """`gain` or `loss` where the interval leaves zero out and every seed agrees.

        Otherwise, and with less than `FEWEST_SEEDS`, it is `unclear`.
        """
        if len(self.of_seeds) < FEWEST_SEEDS:
            return "unclear"
        if self.difference.low > 0 and min(self.of_seeds) > 0:
            return "gain"
        return "loss" if self.difference.high < 0 and max(self.of_seeds) < 0 else "unclear"


def spread(values: Sequence[float]) -> Spread:
    """Return the mean of values with the least and the most of them."""
    return Spread(float(np.mean(values)), min(values), max(values))


def nested(gaps: Sequence[np.ndarray]) -> Gap:
    """Return the mean over all trials of `gaps`, (trials,) of each seed, each with its own trials.

    Seeds are drawn anew, and for each that is drawn its trials.
    """
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(DRAWS):
        seeds = [gaps[k] for k in rng.integers(0, len(gaps), len(gaps))]
        drawn.append(
            np.concatenate([gap[rng.integers(0, len(gap), len(gap))] for gap in seeds]).mean()
        )
    whole = _interval(float(np.concatenate(gaps).mean()), drawn)
    return Gap(whole, [float(gap.mean()) for gap in gaps])


def _interval(mean: float, drawn: Sequence[float]) -> Interval:
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(mean, float(low), float(high))
