"""Find take-off and landing in a log from the motors' effort and the height."""

from __future__ import annotations

import numpy as np

from eval.importers.signals import Recording, Signal
from eval.logs.faults.finding import Finding

RUNNING = 0.5
"""The motors carry the vehicle if their effort exceeds this share of its median in flight."""
HOLD_S = 0.3
"""Least duration of a flight: time above `RUNNING` without a break [s]."""
RISE_M = 0.05
"""Height above the ground from which the vehicle counts as flying [m]."""
POWER = {
    **{"throttle": 1, "cmd_thrust": 1, "kept:cmd_force": 1},
    **{"pwm": 1, "motor": 2, "motor_cmd": 2},
}
"""Signals that measure the motors' effort -> exponent with which each gives the thrust."""


def airborne(recording: Recording) -> tuple[tuple[float, float], list[Finding]]:
    """Return the first and the last time in flight [s], and a finding.

    A time is infinite where the log starts or ends in flight, or has no signal of the motors.
    """
    no_limits = (-np.inf, np.inf)
    effort = _motor_effort(recording)
    if effort is None:
        text = "no signal shows when the motors run: nothing is cut; see --start and --end"
        return no_limits, [Finding("note", "ground", text)]
    time_s = effort.time_s
    in_flight = _long_runs(time_s, effort.value[:, 0] > RUNNING)
    if not in_flight.any():
        text = f"the motors never run for {HOLD_S:g} s: nothing is cut"
        return no_limits, [Finding("doubt", "ground", text)]
    first, last = np.flatnonzero(in_flight)[[0, -1]]
    start = float(time_s[first]) if time_s[first] > time_s[0] else -np.inf
    stop = float(time_s[last]) if time_s[last] < time_s[-1] else np.inf
    if "pos" in recording.signals:
        start, stop = _off_ground(recording.signals["pos"], start, stop)
    if not np.isfinite(start) and not np.isfinite(stop):
        return no_limits, [Finding("ok", "ground", "it flies from the first row to the last")]
    cuts = []
    if np.isfinite(start):
        cuts.append(f"the {start - time_s[0]:.1f} s before take-off")
    if np.isfinite(stop):
        cuts.append(f"the {time_s[-1] - stop:.1f} s after landing")
    text = f"{' and '.join(cuts)} are left out"
    return (float(start), float(stop)), [Finding("note", "ground", text)]


def _motor_effort(recording: Recording) -> Signal | None:
    """Return the motors' thrust relative to its median in flight; None without such a signal."""
    for name, power in POWER.items():
        samples = recording.signals.get(name)
        if samples is None or len(samples.time_s) < 10:
            continue
        thrust_level = np.mean(samples.value**power, axis=1)  # speeds may have the spin's sign
        high_level = float(np.quantile(thrust_level, 0.95))
        if high_level <= 0.0:
            continue
        median_in_flight = float(np.median(thrust_level[thrust_level > RUNNING * high_level]))
        return Signal(samples.time_s, (thrust_level / median_in_flight)[:, None])
    return None


def _long_runs(time_s: np.ndarray, running: np.ndarray) -> np.ndarray:
    """Return which samples belong to a run of at least `HOLD_S`."""
    edges = np.flatnonzero(np.diff(running.astype(int))) + 1
    in_long_run = np.zeros(len(running), dtype=bool)
    for run in np.split(np.arange(len(running)), edges):
        if running[run[0]] and time_s[run[-1]] - time_s[run[0]] >= HOLD_S:
            in_long_run[run] = True
    return in_long_run


def _off_ground(pos: Signal, start: float, stop: float) -> tuple[float, float]:
    """Return the first and last time [s] within `start` and `stop` above the ground.

    The ground is the median height over the second before the start and after the stop.
    """
    height = pos.value[:, 2]
    is_inside = (pos.time_s >= start) & (pos.time_s <= stop)
    if not is_inside.any():
        return start, stop
    if np.isfinite(start):
        before = height[(pos.time_s < start) & (pos.time_s > start - 1.0)]
        ground = float(np.median(before)) if len(before) else float(height[is_inside][0])
        above_ground = np.flatnonzero(is_inside & (height > ground + RISE_M))
        start = float(pos.time_s[above_ground[0]]) if len(above_ground) else start
    if np.isfinite(stop):
        after = height[(pos.time_s > stop) & (pos.time_s < stop + 1.0)]
        ground = float(np.median(after)) if len(after) else float(height[is_inside][-1])
        above_ground = np.flatnonzero(is_inside & (height > ground + RISE_M))
        stop = float(pos.time_s[above_ground[-1]]) if len(above_ground) else stop
    return start, stop
