"""Time several implementations in turn, and warn if the machine is too busy for a comparison."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from tracks.common.grid import Grid

BUSY_SHARE = 0.15
"""Share of the processor that other processes may use without a warning, from 0 to 1."""


@dataclass(frozen=True)
class Figure:
    """A measured rate (more is better) or a time (less is better)."""

    value: float
    """The rate or time, in `unit`."""
    unit: str
    less_is_better: bool = False
    """Whether the figure is a time, not a rate."""


@dataclass(frozen=True)
class Comparison:
    """The result of a benchmark."""

    name: str
    ours: Figure
    """Speed of the suite."""
    baseline: Figure
    """Speed of the plain implementation of the same computation, on the same inputs."""
    warnings: tuple[str, ...] = ()
    """Reasons not to trust the figures; empty on a machine without other load."""
    details: dict[str, Any] = field(default_factory=dict)
    """Further results of the benchmark."""
    grid: Grid | None = None
    """The details as a table; without it they are printed line by line."""

    @property
    def ratio(self) -> float:
        """Our speed over the baseline's (above 1: ours is faster)."""
        ratio = self.ours.value / self.baseline.value
        return 1 / ratio if self.ours.less_is_better else ratio


def in_turn(
    calls: Mapping[str, Callable[[], object]],
    rounds: int = 5,
    clock: Callable[[], float] = time.perf_counter,
    most_s: float = math.inf,
) -> dict[str, list[float]]:
    """Return the seconds of each call in every round, after one call each to warm up.

    The calls take turns, so that a changing load of the machine affects all of them alike. Each
    call must finish its work before it returns (`jax.block_until_ready`). Except the first, no
    round begins after `most_s` [s].
    """
    for call in calls.values():
        call()
    times_s: dict[str, list[float]] = {name: [] for name in calls}
    end_s = time.perf_counter() + most_s
    for number in range(rounds):
        if number and time.perf_counter() > end_s:
            break
        for name, call in calls.items():
            started = clock()
            call()
            times_s[name].append(clock() - started)
    return times_s


def compare_times(
    name: str,
    times_s: Mapping[str, list[float]],
    work: float,
    unit: str,
    details: Mapping[str, Any],
) -> Comparison:
    """Return the comparison of two implementations by the medians of their times [s].

    The times are from `in_turn`, those of the suite first. The work of one call, divided by a time
    [s], gives a figure in `unit`.
    """
    ours, baseline = (
        Figure(work / statistics.median(seconds), unit) for seconds in times_s.values()
    )
    return Comparison(name, ours, baseline, details=dict(details))


def load_warnings() -> tuple[str, ...]:
    """Return a warning if other processes use the processor, measured while this one is idle."""
    import psutil

    share = psutil.cpu_percent(interval=1.0) / 100
    if share <= BUSY_SHARE:
        return ()
    return (
        f"other processes use {share:.0%} of the processor: the figures, above all the baseline's, "
        "are not reliable; run again on a machine without other load",
    )
