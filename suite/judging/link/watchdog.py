"""The watchdog of a flight over a link: checks of the received states, with their limits.

Beyond a limit the companion hands over. The policy's actions are checked elsewhere: by the action
guard (`eval/judging/guard.py`), and with `--monitor` by the safety monitor
(`eval/judging/monitor.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from suite.judging.link.messages import State
from tracks.geometry.rotation import quat_to_rot
from tracks.input.ranges import Range

DRIFT = 1e-3
"""Largest relative drift between two clocks; that of quartz clocks is a tenth of it."""


@dataclass(frozen=True)
class Limits:
    """Limits of states, images and times; beyond any of them the companion hands over."""

    silence_s: Annotated[float, Range(0.01, 10.0)] = 0.1
    """Hand over to the autopilot after this time without a newer state [s]."""
    image_age_s: Annotated[float, Range(0.01, 10.0)] = 0.5
    """Hand over after this time without a depth image [s]."""
    tilt_deg: Annotated[float, Range(1.0, 180.0)] = 85.0
    """Hand over beyond this angle between body z and the vertical [deg]."""
    margin_m: Annotated[float, Range(0.0, 1000.0)] = 10.0
    """Hand over outside a box that reaches this far beyond the gates and the start [m]."""
    floor_m: Annotated[float, Range(-1000.0, 1000.0)] = -0.5
    """World z of the bottom of that box [m]."""
    deadline_s: Annotated[float, Range(1e-4, 1.0)] = 0.02
    """Latest decision of the policy after its state's arrival [s]; a later one is replaced by the
    action before it."""
    late_most: Annotated[int, Range(1, 1000)] = 5
    """Hand over after this many late decisions in a row."""
    clock_jump_s: Annotated[float, Range(0.01, 100.0)] = 0.2
    """Hand over if the vehicle's clock jumps by more than this relative to that of the companion,
    or if its states arrive later than this [s]."""
    jump_m: Annotated[float, Range(0.01, 100.0)] = 0.5
    """Hand over if the position changes by more than the speed explains plus this distance [m]."""


@dataclass(frozen=True)
class Box:
    """The allowed region of the vehicle in the world frame."""

    low: np.ndarray
    """(3,) lower corner [m]."""
    high: np.ndarray
    """(3,) upper corner [m]."""


def allowed_box(points_w: np.ndarray, limits: Limits) -> Box:
    """Return the box around points (N, 3) [m], with the margin and the floor of `limits`."""
    low, high = points_w.min(0) - limits.margin_m, points_w.max(0) + limits.margin_m
    low[2] = limits.floor_m
    return Box(low, high)


def refuse_high_floor(points_w: np.ndarray, limits: Limits) -> None:
    """Refuse a floor that is not below points (N, 3), the start and the gates of a track [m].

    Raises:
        ValueError: with the heights.
    """
    lowest_m = points_w[:, 2].min()
    if limits.floor_m >= lowest_m:
        raise ValueError(
            f"--floor-m is {limits.floor_m:g}, allowed is less than {lowest_m:.3g}, the lowest "
            "height of the start and the gates [m]: below the floor the companion hands over"
        )


def state_fault(state: State, box: Box, limits: Limits) -> str | None:
    """Return the reason for which a state cannot be used, or None."""
    if state.fault:
        return state.fault
    numbers = np.concatenate([state.pos_w, state.quat_wxyz, state.vel_w, state.rate_b])
    if not np.isfinite(numbers).all() or not np.isfinite(state.time_s):
        return "state is not finite"
    tilt = float(np.degrees(np.arccos(np.clip(quat_to_rot(state.quat_wxyz)[2, 2], -1, 1))))
    if tilt > limits.tilt_deg:
        return f"tilt {tilt:.0f} deg, allowed {limits.tilt_deg:g}"
    if not ((state.pos_w >= box.low) & (state.pos_w <= box.high)).all():
        place = ", ".join(f"{x:.1f}" for x in state.pos_w)
        return f"outside the box at {place} m"
    return None


def jump_fault(last: State, state: State, limits: Limits) -> str | None:
    """Return the reason for which a state cannot follow the last one, or None.

    If the estimated position jumps, a gate could be counted that was not passed, or missed.
    """
    if state.component != last.component:
        numbers = f"{last.component} and {state.component}"
        return f"ODOMETRY of the components {numbers}; route that of the autopilot alone"
    if state.resets != last.resets:
        return "the vehicle's estimator reset its state"
    moved_m = float(np.linalg.norm(state.pos_w - last.pos_w))
    speed = max(float(np.linalg.norm(vel_w)) for vel_w in (last.vel_w, state.vel_w))
    since_s = state.time_s - last.time_s
    if moved_m > speed * since_s + limits.jump_m:
        return f"position jumped by {moved_m:.2f} m in {since_s:.3f} s at {speed:.1f} m/s"
    return None


class ClockCheck:
    """Checks that the clocks of vehicle and companion run alike, and that states are in time."""

    def __init__(self, limits: Limits) -> None:
        self._limit_s = limits.clock_jump_s
        self._offset_s: float | None = None
        self._last_s = 0.0

    def add(self, stamp_s: float, now_s: float) -> str | None:
        """Return the reason for which a time stamp is wrong, or None.

        The offset of the clocks (arrival minus time stamp) is compared with the smallest one so
        far, which is that of the shortest delay. The smallest one may grow by `DRIFT` only. So a
        slowly growing delay is found like a jump. `stamp_s` is the time of the vehicle's clock in
        the state [s], `now_s` that of the companion's clock at its arrival [s].
        """
        offset_s = now_s - stamp_s
        if self._offset_s is None:
            self._offset_s = offset_s
        else:
            self._offset_s += DRIFT * (now_s - self._last_s)
        self._last_s = now_s
        jump_s = offset_s - self._offset_s
        if jump_s > self._limit_s:
            return f"clock jumped by {-jump_s:+.2f} s, or states are that late"
        if jump_s < -self._limit_s:
            return f"clock jumped by {-jump_s:+.2f} s"
        self._offset_s = min(self._offset_s, offset_s)
        return None

    def vehicle_time(self, now_s: float) -> float:
        """Return the time of the vehicle's clock at `now_s` of the companion's clock [s].

        It is early by the shortest delay of a state, which no clock at one end of a link shows.
        """
        assert self._offset_s is not None  # a state has arrived
        return now_s - self._offset_s


Clock = Callable[[], float]
"""Monotonic time [s]."""
