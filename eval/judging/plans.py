"""Planned laps of 24 tracks, and how many times as long a policy's laps take.

A plan knows the whole track and has no camera and no noise. It was found by a local search over
B-splines flown through the differentiable quadrotor, and then flown by this judge in MuJoCo on the
vehicle `reference`. It is an upper bound on the least lap. The planner is in commit c6d768a
(`suite reproduce laps --trials 2`), and docs/archive/laps.md describes it.
"""

from __future__ import annotations

import functools
import json
import lzma
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, bootstrap_median
from eval.worlds.trial import TrialResult, TrialSpec

VEHICLE = "reference"
"""The shipped vehicle that the plans were flown on; a ratio holds for no other."""
PLANS = Path(__file__).with_name("plans.json.xz")
"""A list of tracks with `lap_s`, and rows of the flight: `time_ms` (T,), `pos_mm` (T, 3)."""


class Plan(NamedTuple):
    """A plan as the judge saw it flown to the end."""

    lap_s: float
    """Its lap time [s]."""
    time_s: np.ndarray
    """(T,) of the rows [s]."""
    pos_w: np.ndarray
    """(T, 3) centre of mass [m], to 1 mm."""


class OverPlan(NamedTuple):
    """A policy's laps compared with the plans of the same tracks."""

    policy: str
    ratio: Interval
    """Lap time over planned lap time: median over tracks, 95 % bootstrap interval; NaN for none."""
    finished: int
    """Tracks that have a plan and that the policy finished."""
    planned: int
    """Tracks that have a plan."""


@functools.cache
def plans() -> dict[TrialSpec, Plan]:
    """Return the plan of each track that has one: three families, levels 0, 3, 6, 9, seeds 0, 1."""
    with lzma.open(PLANS, "rt", encoding="utf-8") as file:
        stored = json.load(file)
    return {
        TrialSpec(row["track"], row["difficulty"], row["seed"]): Plan(
            row["lap_s"], 1e-3 * np.array(row["time_ms"]), 1e-3 * np.array(row["pos_mm"])
        )
        for row in stored["plans"]
    }


def over_plan(results: Sequence[TrialResult]) -> list[OverPlan]:
    """Return each policy's laps over the plans, for policies with trials on planned tracks.

    Args:
        results: on tracks of the families, flown by the vehicle `VEHICLE`.
    """
    found = []
    for policy in dict.fromkeys(row.policy for row in results):
        mine = [row for row in results if row.policy == policy and row.trial in plans()]
        ratios = [row.time_s / plans()[row.trial].lap_s for row in mine if row.success]
        if mine:
            found.append(
                OverPlan(policy, bootstrap_median(np.array(ratios)), len(ratios), len(mine))
            )
    return found
