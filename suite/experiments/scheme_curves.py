"""Learning curves of training schemes over their seeds, and what is read off them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from suite.experiments.seed_intervals import Spread, spread

if TYPE_CHECKING:
    from suite.experiments.schemes import Learnt, Scheme

METRICS = {
    "reward": ("reward", 1, 0),
    "success_cross": ("success cross [%]", 100, 0),
    "success_rate": ("success rate [%]", 100, 0),
    "v_max": ("v_max [m/s]", 1, 1),
    "gates": ("gates", 1, 2),
}
"""Title, factor and digits of what is measured."""
FIGURE = ("reward", "v_max", "success_rate", "gates")
"""What the paper's figure shows."""
WANTED = (1, 2, 3)
"""Mean gates a trial, of four, whose first time the table gives."""


class Row(NamedTuple):
    """One scheme over its training seeds; those that diverged are left out."""

    scheme: str
    """Its key."""
    words: str
    seeds: int
    """Trainings, the diverged ones included."""
    diverged: int
    steps: list[int]
    """Environment steps at each measurement."""
    time: list[float]
    """Seconds of training until then, mean over seeds."""
    curves: dict[str, list[Spread]]
    """Of `METRICS`, at each measurement; empty where all diverged."""
    reached: dict[int, list[tuple[float, float]]]
    """Steps and seconds of the first measurement with so many gates, of the seeds that have one."""
    compile_s: float
    """Mean over seeds [s]."""


def summaries(chosen: Sequence[Scheme], results: Sequence[Learnt]) -> list[Row]:
    """Return every scheme's row.

    Args:
        chosen: schemes, in order.
        results: all their runs.
    """
    rows = []
    for scheme in chosen:
        mine = [run for run in results if run.scheme == scheme.key]
        whole = [run.points for run in mine if not run.diverged]
        at = list(zip(*whole, strict=True))
        curves = {
            name: [spread([point[name] for point in points]) for points in at]
            for name in METRICS
            if at
        }
        steps = [int(points[0]["steps"]) for points in at]
        time = [float(np.mean([point["time"] for point in points])) for points in at]
        compiling = float(np.mean([run.compile_s for run in mine]))
        row = Row(scheme.key, scheme.words, len(mine), len(mine) - len(whole), steps, time, curves,
                  {gates: first_times(whole, gates) for gates in WANTED}, compiling)  # fmt: skip
        rows.append(row)
    return rows


def first_times(
    runs: Sequence[Sequence[Mapping[str, float]]], gates: float
) -> list[tuple[float, float]]:
    """Return steps and seconds of the first point with `gates`, of every run that has one."""
    firsts = [next((p for p in points if p["gates"] >= gates), None) for points in runs]
    return [(point["steps"], point["time"]) for point in firsts if point is not None]


def value_at(row: Row, name: str, time: float) -> Spread:
    """Return a scheme's number at its last measurement within `time` seconds of training."""
    number = max(k for k, spent in enumerate(row.time) if spent <= time + 1e-9)
    return row.curves[name][number]
