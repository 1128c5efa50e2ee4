"""Policies flown under other conditions than those of the result tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from suite.experiments.study.judging import Order, Place, Setup, flown
from suite.experiments.study.options import chosen


class Tested(NamedTuple):
    """A condition and the results of every policy under it, on the same trials."""

    condition: Condition
    results: Mapping[str, Sequence[TrialResult]]
    """By the policy's label."""

    def success(self, policy: str) -> Interval:
        """Return the success rate over all tracks and levels."""
        return wilson(int(self.won(policy).sum()), len(self.results[policy]))

    def won(self, policy: str) -> np.ndarray:
        """Return which trials succeeded, (n,) bool."""
        return np.array([row.success for row in self.results[policy]])


Grown = dict[Sweep, list[Tested]]
"""The tested conditions of each sweep, the undisturbed first."""


def chosen_conditions(
    vehicle: Vehicle, only: Sequence[str]
) -> tuple[list[Condition], dict[Sweep, list[Condition]]]:
    """Return the effects and the sweeps of `vehicle` that are in `only`, all if it is empty.

    Raises:
        ValueError: for an unknown name.
    """
    grown, alone = sweeps(vehicle), effect_conditions(vehicle)
    known = dict.fromkeys(entry.name for entry in (*grown, *alone))
    names = chosen(known, only, "effect or sweep")
    return (
        [condition for condition in alone if condition.name in names],
        {sweep: sweep_conditions(vehicle, sweep) for sweep in grown if sweep.name in names},
    )


def flown_under(
    alone: Sequence[Condition],
    grown: Mapping[Sweep, Sequence[Condition]],
    policies: Mapping[str, str],
    trials: Sequence[TrialSpec],
    place: Place,
    console: Console,
) -> tuple[list[Tested], Grown]:
    """Return all conditions with the results of every policy under them.

    Args:
        alone: single conditions.
        grown: conditions by sweep.
        policies: by label.
        trials: each policy flies all of them under every condition.
        place: cache of flights, and workers.
        console: shows progress.
    """
    conditions = [*alone, *(point for points in grown.values() for point in points)]
    orders = {
        (at, name): Order(
            Setup(policy, condition.vehicle, condition.sensors, condition.simulator), trials
        )
        for name, policy in policies.items()
        for at, condition in enumerate(conditions)
    }
    rows = flown(orders, place, console, "flying under every condition")
    tested = [
        Tested(condition, {name: rows[at, name] for name in policies})
        for at, condition in enumerate(conditions)
    ]
    rest = iter(tested[len(alone) :])
    return tested[: len(alone)], {s: [next(rest) for _ in points] for s, points in grown.items()}


def tested_numbers(entry: Tested, base: Tested) -> dict[str, Any]:
    """Return the results under one condition for JSON, over all trials and by track."""
    found: dict[str, Any] = {
        "name": entry.condition.name,
        "size": entry.condition.size,
        "words": entry.condition.words,
        "sensors": entry.condition.sensors,
        "effects": dict(entry.condition.vehicle.effects),
        "policies": {},
    }
    for name, rows in entry.results.items():
        tracks = dict.fromkeys(row.track for row in rows)
        found["policies"][name] = {
            "success": entry.success(name),
            "change": paired_success(entry.won(name), base.won(name)),
            "tracks": {
                track: float(np.mean([row.success for row in rows if row.track == track]))
                for track in tracks
            },
            "v_max": float(np.median([row.v_max for row in rows])),
            "v_mean": float(np.median([row.v_mean for row in rows])),
        }
    return found
