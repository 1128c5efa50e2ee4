"""Timing two implementations in turn, and saying when the machine is too busy to be believed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from tracks.common.grid import Grid

BUSY_SHARE = 0.15
"""Share of the processor that others may use before a benchmark is not to be trusted [1]."""


@dataclass(frozen=True)
class Figure:
    """A measured rate, of which more is better, or a time."""

    value: float
    """The figure, in `unit`."""
    unit: str
    """Such as "gradient steps/s"."""
    less_is_better: bool = False
    """Whether it is a time."""


@dataclass(frozen=True)
class Comparison:
    """The outcome of a benchmark."""

    name: str
    """The benchmark's name."""
    ours: Figure
    """Our implementation."""
    baseline: Figure
    """The plain implementation of the same, on the same inputs."""
    warnings: tuple[str, ...] = ()
    """Why the figures may not be trusted; empty on a free machine."""
    details: dict[str, Any] = field(default_factory=dict)
    """Whatever else the benchmark measured."""
    grid: Grid | None = None
    """The details as a table for people; without one they are shown line by line."""

    @property
    def ratio(self) -> float:
        """How many times as fast ours is (above 1: faster)."""
        ratio = self.ours.value / self.baseline.value
        return 1 / ratio if self.ours.less_is_better else ratio


def in_turn(
    ours: Callable[[], object],
    baseline: Callable[[], object],
    repeats: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[float, float]:
    """Return the median seconds of one call of each, called alternately after one warm-up.

    Both callables must finish their work before they return (`jax.block_until_ready`).
    """
    ours()
    baseline()
    taken: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for seconds, call in zip(taken, (ours, baseline), strict=True):
            started = clock()
            call()
            seconds.append(clock() - started)
    return statistics.median(taken[0]), statistics.median(taken[1])


def load_warnings(interval_s: float = 1.0) -> tuple[str, ...]:
    """Return a warning where other processes use the processor, measured while we are idle."""
    import psutil

    share = psutil.cpu_percent(interval_s) / 100
    if share <= BUSY_SHARE:
        return ()
    return (
        f"other processes use {share:.0%} of the processor: the figures, and the baseline's most "
        "of all, are not to be trusted; run again on a free machine",
    )
