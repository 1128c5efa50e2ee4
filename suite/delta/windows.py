"""Recorded flights as windows at the policy's decisions, cut for replay in the point mass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.delta.warm import WARM_S, Warm, gather
from tracks.geometry.rotation import quat_to_rot

HISTORY = 2
"""Decisions before a window whose commands may still be on their way into it."""


class Windows(NamedTuple):
    """N windows of T decisions; row 0 is where the replay starts."""

    pos_w: np.ndarray
    """(N, T + 1, 3) measured [m]."""
    vel_w: np.ndarray
    """(N, T + 1, 3) measured [m/s]."""
    acc_w: np.ndarray
    """(N, 3) measured at the start [m/s^2]."""
    rot_w: np.ndarray
    """(N, 3, 3) measured at the start, body to world."""
    heading_w: np.ndarray
    """(N, T + 1, 3) level direction that the nose follows, unit."""
    action_b: np.ndarray
    """(N, T, 3) the actions flown [m/s^2]."""
    commands_w: np.ndarray
    """(N, HISTORY, 3) commands before the window in world axes, latest first [m/s^2]."""
    time_step: np.ndarray
    """(N, T) time between decisions [s]."""
    warm_inputs: np.ndarray
    """(N, W, 9) as in `suite.delta.warm.Warm`."""
    warm_seen: np.ndarray
    """(N, W)."""

    @property
    def warm(self) -> Warm:
        """What the network saw before each window."""
        return Warm(self.warm_inputs, self.warm_seen)


def _heading(rot_w: np.ndarray) -> np.ndarray:
    """Return the level direction (..., 3) from which `point_mass.attitude` makes the same nose.

    That is the one square to body y; body x laid flat points elsewhere once the body is rolled.
    """
    left, up = rot_w[..., 1], rot_w[..., 2]
    ahead = np.stack([left[..., 1], -left[..., 0], np.zeros_like(left[..., 0])], axis=-1)
    ahead = ahead * np.where(up[..., 2:] < 0, -1.0, 1.0)
    size = np.linalg.norm(ahead, axis=-1, keepdims=True)
    return np.where(size > 1e-3, ahead / np.maximum(size, 1e-3), [1.0, 0.0, 0.0])


def cut_windows(logs: Sequence[FlightLog], duration_s: float, stride_s: float) -> Windows:
    """Return windows of `duration_s`, one starting every `stride_s` of every flight.

    A window with a missing value is left out. The acceleration at the start is the mean over the
    row's period, from the measured velocity.

    Raises:
        ValueError: where a log has no actions, or no flight is as long as a window.
    """
    parts = [window for log in logs for window in _flight_windows(log, duration_s, stride_s)]
    if not parts:
        names = ", ".join(log.name for log in logs[:3])
        raise ValueError(
            f"no window of {duration_s} s in {len(logs)} flights ({names}, ...); record longer "
            "flights with suite collect"
        )
    shortest = min(part.action_b.shape[0] for part in parts)
    rows = {"pos_w": shortest + 1, "vel_w": shortest + 1, "heading_w": shortest + 1}
    rows |= {"action_b": shortest, "time_step": shortest}
    looks_back = min(part.warm_seen.shape[0] for part in parts)

    def stacked(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        if name.startswith("warm"):
            return np.stack([a[len(a) - looks_back :] for a in arrays])
        return np.stack([a[: rows[name]] if name in rows else a for a in arrays])

    return Windows(*(stacked(name).astype(np.float32) for name in Windows._fields))


def _flight_windows(log: FlightLog, duration_s: float, stride_s: float) -> list[Windows]:
    action, decides = log.action_b, log.policy_step
    if action is None or decides is None:
        raise ValueError(
            f"{log.name}: columns action_x, action_y, action_z and policy_step are needed to fit "
            "the Delta Action Model; record flights with suite collect"
        )
    at = np.flatnonzero(decides & log.whole)
    at = at[at + 1 < len(log.time_s)]
    time, rot = log.time_s[at], quat_to_rot(log.quat_wxyz[at])
    gap = (log.time_s[at + 1] - time)[:, None]
    acc = (log.vel_w[at + 1] - log.vel_w[at]) / gap
    command = (rot @ action[at][:, :, None])[:, :, 0]
    heading = _heading(rot)
    if len(at) < HISTORY + 3:
        return []
    period = float(np.median(np.diff(time)))
    steps, stride = round(duration_s / period), max(1, round(stride_s / period))
    found = []
    for first in range(HISTORY, len(at) - steps, stride):
        span = slice(first, first + steps + 1)
        steady = np.diff(time[first - HISTORY : first + steps + 1])
        if (steady > 1.5 * period).any() or not np.isfinite(acc[first]).all():
            continue
        found.append(
            Windows(
                log.pos_w[at[span]],
                log.vel_w[at[span]],
                acc[first],
                rot[first],
                heading[span],
                action[at[span]][:-1],
                command[first - HISTORY : first][::-1],
                np.diff(time[span]),
                *gather(rot, log.vel_w[at], action[at], first, round(WARM_S / period)),
            )
        )
    return found
