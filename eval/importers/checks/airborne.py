"""Find take-off and landing from the motors and the height."""

from __future__ import annotations

import numpy as np

from eval.importers.signals import Recording, Signal
from eval.logs.faults.finding import Finding

RUNNING = 0.5
"""Share of the usual effort in flight above which the motors carry the vehicle."""
HOLD_S = 0.3
"""Least time above it without a break [s]."""
RISE_M = 0.05
"""Height above the ground from which the vehicle counts as flying [m]."""
POWER = {
    **{"throttle": 1, "cmd_thrust": 1, "kept:cmd_force": 1},
    **{"pwm": 1, "motor": 2, "motor_cmd": 2},
}
"""Signals that measure the motors' effort, and their exponent in the thrust."""


def airborne(recording: Recording) -> tuple[tuple[float, float], list[Finding]]:
    """Return the first and the last time in flight [s]; infinite for a start or end in flight.

    Args:
        recording: with the time in s.
    """
    whole = (-np.inf, np.inf)
    effort = _effort(recording)
    if effort is None:
        text = "nothing says when the motors run: nothing is cut; see --start and --end"
        return whole, [Finding("note", "ground", text)]
    time_s, share = effort.time_s, effort.value[:, 0]
    running = share > RUNNING
    long = _lasting(time_s, running)
    if not long.any():
        text = "the motors never run for long: nothing is cut"
        return whole, [Finding("doubt", "ground", text)]
    first, last = int(np.argmax(long)), len(long) - 1 - int(np.argmax(long[::-1]))
    on_ground = time_s[first] > time_s[0], time_s[last] < time_s[-1]
    start = time_s[first] if on_ground[0] else -np.inf
    stop = time_s[last] if on_ground[1] else np.inf
    if "pos" in recording.signals:
        start, stop = _risen(recording.signals["pos"], start, stop)
    if not np.isfinite(start) and not np.isfinite(stop):
        return whole, [Finding("ok", "ground", "it flies from the first row to the last")]
    words = []
    if np.isfinite(start):
        words.append(f"the {start - time_s[0]:.1f} s before take-off")
    if np.isfinite(stop):
        words.append(f"the {time_s[-1] - stop:.1f} s after landing")
    text = f"{' and '.join(words)} are left out"
    return (float(start), float(stop)), [Finding("note", "ground", text)]


def _effort(recording: Recording) -> Signal | None:
    """Return the motors' effort, about 1 in flight."""
    for name, power in POWER.items():
        samples = recording.signals.get(name)
        if samples is None or len(samples.time_s) < 10:
            continue
        level = np.mean(samples.value, axis=1) ** power
        high = float(np.quantile(level, 0.95))
        if high <= 0.0:
            continue
        usual = float(np.median(level[level > RUNNING * high]))
        return Signal(samples.time_s, (level / usual)[:, None])
    return None


def _lasting(time_s: np.ndarray, running: np.ndarray) -> np.ndarray:
    """Return which samples belong to a run of at least `HOLD_S`."""
    edges = np.flatnonzero(np.diff(running.astype(int))) + 1
    out = np.zeros(len(running), dtype=bool)
    for part in np.split(np.arange(len(running)), edges):
        if running[part[0]] and time_s[part[-1]] - time_s[part[0]] >= HOLD_S:
            out[part] = True
    return out


def _risen(pos: Signal, start: float, stop: float) -> tuple[float, float]:
    """Return the first and last time within `start` and `stop` above the ground."""
    height = pos.value[:, 2]
    inside = (pos.time_s >= start) & (pos.time_s <= stop)
    if np.isfinite(start):
        before = height[(pos.time_s < start) & (pos.time_s > start - 1.0)]
        ground = float(np.median(before)) if len(before) else float(height[inside][0])
        up = np.flatnonzero(inside & (height > ground + RISE_M))
        start = float(pos.time_s[up[0]]) if len(up) else start
    if np.isfinite(stop):
        after = height[(pos.time_s > stop) & (pos.time_s < stop + 1.0)]
        ground = float(np.median(after)) if len(after) else float(height[inside][-1])
        up = np.flatnonzero(inside & (height > ground + RISE_M))
        stop = float(pos.time_s[up[-1]]) if len(up) else stop
    return start, stop
