"""Fly policies under conditions, such as a vehicle with an additional effect or with sensor errors.

An effect is one physical cause of a mismatch, such as drag. A sweep is a series of conditions in
which one disturbance grows. A single condition ("single") belongs to no sweep.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, paired_success, wilson
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from suite.common.console import Console
from suite.experiments.study.conditions import (
    Condition,
    Sweep,
    effect_conditions,
    sweep_conditions,
    sweeps,
)
from suite.experiments.study.judging import TrialRequest, Workspace, fly_trials
from suite.experiments.study.options import select


class ConditionResult(NamedTuple):
    """A condition and the results of every policy under it, on the same trials."""

    condition: Condition
    """Vehicle, sensors and simulator of the flights."""
    results: Mapping[str, Sequence[TrialResult]]
    """Label of each policy -> results of its trials."""

    def success(self, policy: str) -> Interval:
        """Return the success rate over all tracks and levels."""
        return wilson(int(self.won(policy).sum()), len(self.results[policy]))

    def won(self, policy: str) -> np.ndarray:
        """Return whether each trial of a policy succeeded, (n,) bool."""
        return np.array([row.success for row in self.results[policy]])


SweepResults = dict[Sweep, list[ConditionResult]]
"""Sweep -> results under its conditions; the undisturbed condition is the first."""


def select_conditions(
    vehicle: Vehicle, only: Sequence[str]
) -> tuple[list[Condition], dict[Sweep, list[Condition]]]:
    """Return the conditions with one effect each, and the conditions of each sweep.

    With names in `only`, both parts have these effects and sweeps alone.

    Raises:
        ValueError: for an unknown name.
    """
    all_sweeps, singles = sweeps(vehicle), effect_conditions(vehicle)
    known = dict.fromkeys(entry.name for entry in (*all_sweeps, *singles))
    names = select(known, only, "effect or sweep")
    return (
        [condition for condition in singles if condition.name in names],
        {sweep: sweep_conditions(vehicle, sweep) for sweep in all_sweeps if sweep.name in names},
    )


def fly_conditions(
    conditions: Sequence[Condition],
    policies: Mapping[str, str],
    trials: Sequence[TrialSpec],
    workspace: Workspace,
    console: Console,
) -> list[ConditionResult]:
    """Return the results of every policy under every condition.

    `policies` maps labels to names or paths. Each policy flies all trials under every condition.
    """
    requests = {
        (number, name): TrialRequest(
            policy, condition.vehicle, trials, condition.sensors, condition.simulator
        )
        for name, policy in policies.items()
        for number, condition in enumerate(conditions)
    }
    rows = fly_trials(requests, workspace, console, "flying under every condition")
    return [
        ConditionResult(condition, {name: rows[number, name] for name in policies})
        for number, condition in enumerate(conditions)
    ]


def by_sweep(
    results: Iterable[ConditionResult], sweeps: Mapping[Sweep, Sequence[Condition]]
) -> SweepResults:
    """Return the results under the conditions of `sweeps`, which are in this order, by sweep."""
    remaining = iter(results)
    return {sweep: [next(remaining) for _ in points] for sweep, points in sweeps.items()}


def tested_numbers(entry: ConditionResult, base: ConditionResult) -> dict[str, Any]:
    """Return the results under one condition for JSON, over all trials and by track.

    `change` is the difference of the success rate to that under `base`, the undisturbed condition.
    """
    numbers: dict[str, Any] = {
        "name": entry.condition.name,
        "size": entry.condition.size,
        "words": entry.condition.size_text,
        "sensors": entry.condition.sensors,
        "effects": dict(entry.condition.vehicle.effects),
        "policies": {},
    }
    for name, rows in entry.results.items():
        tracks = dict.fromkeys(row.track for row in rows)
        numbers["policies"][name] = {
            "success": entry.success(name),
            "change": paired_success(entry.won(name), base.won(name)),
            "tracks": {
                track: float(np.mean([row.success for row in rows if row.track == track]))
                for track in tracks
            },
            "v_max": float(np.median([row.v_max for row in rows])),
            "v_mean": float(np.median([row.v_mean for row in rows])),
        }
    return numbers
