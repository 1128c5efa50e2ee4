"""Results of each setting over its training seeds, in worlds that no training has seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from suite.common.curve import METRICS
from suite.experiments.study.training import Row, Trained


class Spread(NamedTuple):
    """A number over training seeds."""

    mean: float
    least: float
    most: float


class Summary(NamedTuple):
    """One setting over its training seeds; diverged trainings are left out of all numbers."""

    key: str
    words: str
    recipe: Any
    seeds: int
    """Number of trainings, including diverged ones."""
    whole: list[list[dict[str, float]]]
    """The measurements of every training that did not diverge."""
    at: list[dict[str, Spread]]
    """Over seeds, at each measurement; empty if all diverged."""

    @property
    def diverged(self) -> int:
        """Number of trainings that diverged."""
        return self.seeds - len(self.whole)

    def values(self, name: str) -> list[float]:
        """Return a number of each training at its end, without diverged ones."""
        return [points[-1][name] for points in self.whole]

    def text(self, name: str) -> str:
        """Return a number at the end for a cell: mean over seeds [least, most]."""
        if not self.at:
            return "diverged"
        _, scale, digits = METRICS[name]
        mean, least, most = (f"{scale * value:.{digits}f}" for value in self.at[-1][name])
        return f"{mean} [{least}, {most}]"


def summaries(rows: Sequence[Row], runs: Sequence[Trained]) -> list[Summary]:
    """Return every setting over its seeds, in order."""
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
