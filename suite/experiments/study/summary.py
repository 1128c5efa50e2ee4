"""Summarise the trainings of each setting over its seeds: mean, least and most of every measure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from suite.common.curve import METRICS
from suite.experiments.study.training import Setting, TrainingResult


class Spread(NamedTuple):
    """The values of one measure, such as `v_max`, over the training seeds."""

    mean: float
    """Mean over the seeds."""
    least: float
    """Smallest value."""
    most: float
    """Largest value."""


class Summary(NamedTuple):
    """One setting over its training seeds; diverged trainings are left out of all numbers."""

    key: str
    """Name of the setting."""
    label: str
    """Label of the setting in tables."""
    recipe: Any
    """The trained configuration, a `TrainConfig` or a `PpoConfig`."""
    seeds: int
    """Number of trainings, including diverged ones."""
    trainings: list[list[dict[str, float]]]
    """Measurements of every training that did not diverge, in the order of time; a measurement
    is a dictionary of measures."""
    at: list[dict[str, Spread]]
    """The spread of every measure over the seeds, at each measurement; empty if all diverged."""

    @property
    def diverged(self) -> int:
        """Number of trainings that diverged."""
        return self.seeds - len(self.trainings)

    def values(self, name: str) -> list[float]:
        """Return a measure at the end of each training, without diverged ones."""
        return [points[-1][name] for points in self.trainings]

    def text(self, name: str) -> str:
        """Return a measure at the end as text for a table: mean over seeds [least, most]."""
        if not self.at:
            return "diverged"
        _, scale, digits = METRICS[name]
        mean, least, most = (f"{scale * value:.{digits}f}" for value in self.at[-1][name])
        return f"{mean} [{least}, {most}]"


def summaries(settings: Sequence[Setting], runs: Sequence[TrainingResult]) -> list[Summary]:
    """Return the summary of every setting, in order."""
    result = []
    for key, label, recipe in settings:
        setting_runs = [run for run in runs if run.setting == key]
        trainings = [run.points for run in setting_runs if not run.diverged]
        at = [
            {name: _spread([point[name] for point in seeds]) for name in seeds[0]}
            for seeds in zip(*trainings, strict=True)
        ]
        result.append(Summary(key, label, recipe, len(setting_runs), trainings, at))
    return result


def _spread(values: Sequence[float]) -> Spread:
    """Return mean, least and most of `values`."""
    return Spread(float(np.mean(values)), min(values), max(values))
