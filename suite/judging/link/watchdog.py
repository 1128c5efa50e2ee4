"""When a policy must hand over: limits, and the reasons in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from suite.judging.link.messages import State
from tracks.geometry.rotation import quat_to_rot
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Limits:
    """Beyond any of these the companion hands over."""

    silence_s: Annotated[float, Range(0.01, 10.0)] = 0.1
    """Longest time without a state [s]."""
    image_age_s: Annotated[float, Range(0.01, 10.0)] = 0.5
    """Longest time without a depth image [s]."""
    tilt_deg: Annotated[float, Range(1.0, 180.0)] = 85.0
    """Largest angle between body z and the vertical [deg]."""
    margin_m: Annotated[float, Range(0.0, 1000.0)] = 10.0
    """The box reaches this far beyond the gates and the start, on every side [m]."""
    floor_m: Annotated[float, Range(-1000.0, 1000.0)] = -0.5
    """The bottom of the box, world z [m]."""
    deadline_s: Annotated[float, Range(1e-4, 1.0)] = 0.02
    """From a state's arrival to its set point; a policy's answer that is later is not flown [s]."""
    late_most: Annotated[int, Range(1, 1000)] = 5
    """So many late answers in a row."""
    clock_jump_s: Annotated[float, Range(0.01, 100.0)] = 0.2
    """Largest step of the vehicle's clock against ours, forwards or backwards [s]."""


@dataclass(frozen=True)
class Box:
    """Where the vehicle may be, world [m]."""

    low: np.ndarray
    high: np.ndarray


def box_of(points_w: np.ndarray, limits: Limits) -> Box:
    """Return the box around points (N, 3)."""
    low, high = points_w.min(0) - limits.margin_m, points_w.max(0) + limits.margin_m
    low[2] = limits.floor_m
    return Box(low, high)


def trouble_with_state(state: State, box: Box, limits: Limits) -> str | None:
    """Return why a state is none to fly on from, or None."""
    numbers = np.concatenate(state[1:])
    if not np.isfinite(numbers).all() or not np.isfinite(state.time_s):
        return "state is not finite"
    tilt = float(np.degrees(np.arccos(np.clip(quat_to_rot(state.quat_wxyz)[2, 2], -1, 1))))
    if tilt > limits.tilt_deg:
        return f"tilt {tilt:.0f} deg, allowed {limits.tilt_deg:g}"
    if not ((state.pos_w >= box.low) & (state.pos_w <= box.high)).all():
        place = ", ".join(f"{x:.1f}" for x in state.pos_w)
        return f"outside the box at {place} m"
    return None


class ClockCheck:
    """Whether the vehicle's clock goes as ours does."""

    def __init__(self, limits: Limits) -> None:
        self._most = limits.clock_jump_s
        self._offset: float | None = None

    def add(self, stamp_s: float, now_s: float) -> str | None:
        """Return why a stamp cannot be, or None.

        The offset follows slowly, so that a drift is no jump.
        """
        offset = now_s - stamp_s
        if self._offset is None:
            self._offset = offset
        apart = offset - self._offset
        if abs(apart) > self._most:
            return f"clock jumped by {-apart:+.2f} s"
        self._offset += 0.01 * apart
        return None


Clock = Callable[[], float]
"""Seconds that only go forward."""
