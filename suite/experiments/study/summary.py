"""Rows over their training seeds: what policies came to in worlds that no training has seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from suite.experiments.study.training import Row, Trained


class Spread(NamedTuple):
    """A number over training seeds."""

    mean: float
    least: float
    most: float


class Metric(NamedTuple):
    """A number of `validation.measured`, as tables show it."""

    title: str
    scale: float
    digits: int


METRICS = {
    "reward": Metric("reward", 1, 0),
    "success_cross": Metric("success cross [%]", 100, 0),
    "collision_free": Metric("collision-free rate [%]", 100, 0),
    "v_max": Metric("v_max [m/s]", 1, 1),
    "gates": Metric("gates", 1, 2),
}


class Summary(NamedTuple):
    """One row over its training seeds; those that diverged are left out of all numbers."""

    key: str
    words: str
    recipe: Any
    seeds: int
    """Trainings, the diverged ones included."""
    whole: list[list[dict[str, float]]]
    """The measurements of every training that did not diverge."""
    at: list[dict[str, Spread]]
    """Over seeds, at each measurement; empty where all diverged."""

    @property
    def diverged(self) -> int:
        """How many trainings did."""
        return self.seeds - len(self.whole)

    def values(self, name: str) -> list[float]:
        """Return a number of each training that did not diverge, at its end."""
        return [points[-1][name] for points in self.whole]

    def text(self, name: str) -> str:
        """Return a number's mean at the end with the least and the most of a seed, for cells."""
        if not self.at:
            return "diverged"
        _, scale, digits = METRICS[name]
        mean, least, most = (f"{scale * value:.{digits}f}" for value in self.at[-1][name])
        return f"{mean} [{least}, {most}]"


def summaries(rows: Sequence[Row], runs: Sequence[Trained]) -> list[Summary]:
    """Return every row over its seeds, in order."""
    found = []
    for row in rows:
        mine = [run for run in runs if run.row == row.key]
        whole = [run.points for run in mine if not run.diverged]
        at = [
            {name: _spread([point[name] for point in seeds]) for name in seeds[0]}
            for seeds in zip(*whole, strict=True)
        ]
        found.append(Summary(row.key, row.words, row.recipe, len(mine), whole, at))
    return found


def _spread(values: Sequence[float]) -> Spread:
    return Spread(float(np.mean(values)), min(values), max(values))
