"""Planned (near-optimal) laps of 24 tracks, and the ratios of a policy's lap times to them.

A plan is a trajectory that was computed with knowledge of the whole track, by a local search over
B-splines with the differentiable quadrotor. The judge then flew it in MuJoCo with the vehicle
`reference`. Its lap time is an upper bound of the shortest lap time. The planner is in commit
c6d768a (`suite reproduce laps --trials 2`), and docs/archive/measurements.md describes it.
"""

from __future__ import annotations

import functools
import json
import lzma
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, bootstrap
from eval.worlds.trial import TrialResult, TrialSpec

VEHICLE = "reference"
"""The shipped vehicle of the plans; ratios are valid only for it."""
PLANS = Path(__file__).with_name("plans.json.xz")
"""File with a list of tracks, each with `lap_s`, `time_ms` (T,) and `pos_mm` (T, 3)."""


class Plan(NamedTuple):
    """A planned lap as the judge flew it."""

    lap_s: float
    """Lap time [s]."""
    time_s: np.ndarray
    """(T,) times of the positions [s]."""
    pos_w: np.ndarray
    """(T, 3) positions of the centre of mass, rounded to 1 mm [m]."""


class OverPlan(NamedTuple):
    """A policy's laps compared with the plans of the same tracks."""

    policy: str
    ratio: Interval
    """Lap time over planned lap time: median over tracks with its 95 % bootstrap interval; NaN if
    no track was finished."""
    finished: int
    """Number of trials on planned tracks that the policy finished."""
    planned: int
    """Number of trials of the policy on planned tracks."""


@functools.cache
def plans() -> dict[TrialSpec, Plan]:
    """Return the plans by track: three families, levels 0, 3, 6 and 9, seeds 0 and 1."""
    with lzma.open(PLANS, "rt", encoding="utf-8") as file:
        stored = json.load(file)
    return {
        TrialSpec(row["track"], row["difficulty"], row["seed"]): Plan(
            row["lap_s"], 1e-3 * np.array(row["time_ms"]), 1e-3 * np.array(row["pos_mm"])
        )
        for row in stored["plans"]
    }


def over_plan(results: Sequence[TrialResult]) -> list[OverPlan]:
    """Return each policy's laps compared with the plans, for trials on planned tracks.

    The tracks are of the families, and the vehicle is `VEHICLE`.
    """
    comparisons = []
    for policy in dict.fromkeys(row.policy for row in results):
        rows = [row for row in results if row.policy == policy and row.trial in plans()]
        ratios = [row.time_s / plans()[row.trial].lap_s for row in rows if row.success]
        if rows:
            ratio = bootstrap(np.array(ratios))
            comparisons.append(OverPlan(policy, ratio, len(ratios), len(rows)))
    return comparisons
