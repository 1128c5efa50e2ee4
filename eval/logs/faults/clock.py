"""Clocks: the unit of time, and a pose that is late against the gyro or drifts away from it.

The attitude's turn over 60 ms is held against the gyro's mean over the same time, moved by a trial
delay; where they differ least is the delay. Its error comes from blocks of the flight that are
left out in turn (jackknife).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import SPAN_S, Rows
from eval.logs.faults.reading import TIMES, option

STEPS_S = (5e-5, 0.25)
"""Rows of any log are so far apart [s]."""
REACH_S, STEP_S = 0.1, 0.002
"""Delays that are tried, to both sides, and their distance [s]."""
BLOCKS = 8
CALM = 0.2
"""Turns slower than this tell nothing (root mean square) [rad/s]."""
LEAST_S, SURE = 0.002, 4.0
"""A delay below the first [s], or within so many standard errors of none, is left alone."""
GROWN_S, DRIFT, SURE_DRIFT = 0.005, 3e-4, 5.0
"""Clocks drift that part by more than the first over a flight [s], by more than the second (two
crystals part by less than 200 ppm), and by more than so many standard errors."""
LIKELY = 2.5
"""A drift of so many standard errors is taken off before its own error is judged."""
SEEN = 0.005
"""A flight that does not bound the drift by this does not show it."""
LATE_S = 0.025
"""A diagnosis estimates smaller offsets itself (the effect clock_offset) [s]."""


class Late(NamedTuple):
    """By how much an attitude is late against a gyro."""

    delay_s: float
    error_s: float
    """Standard error [s]."""
    drift: float
    """By how much that grows in a second of the flight."""
    drift_error: float
    """Standard error of the drift."""
    middle_s: float
    """When it is `delay_s` late [s]."""
    duration_s: float
    """Of the flight [s]."""

    @property
    def drifts(self) -> bool:
        """Whether the clocks part by more than their crystals do, and than is known anyway."""
        grown = abs(self.drift) * self.duration_s
        return grown > GROWN_S and abs(self.drift) > max(DRIFT, SURE_DRIFT * self.drift_error)

    def drift_figures(self) -> str:
        """Return the drift in words."""
        return (
            f"it gets later by {1e6 * self.drift:+.0f} ppm (± {1e6 * self.drift_error:.0f}), "
            f"{1e3 * self.drift * self.duration_s:+.1f} ms over the flight"
        )


def check_time(rows: Rows) -> list[Finding]:
    """Return in which unit the time is, where rows would else be impossibly far apart."""
    step = float(np.median(np.diff(rows["time"])))
    low, high = STEPS_S
    if low <= step <= high:
        return []
    fits = [unit for unit, factor in TIMES.items() if low <= step * factor <= high]
    figures = f"rows are {step:.3g} apart, which is no distance in s"
    if len(fits) != 1:
        return [Finding("doubt", "time", f"{figures}, ms, us or ns", "time_unit", step, 0.95)]
    text = f"{figures}: time is in {fits[0]}"
    return [Finding("corrected", "time", text, "time_unit", 1.0 / TIMES[fits[0]], 0.99,
                    option(("time", fits[0])))]  # fmt: skip


def check_clock(rows: Rows) -> list[Finding]:
    """Return whether a log's pose is late against its gyro by more than a diagnosis estimates."""
    if not {"quat", "rate"} <= rows.keys():
        return []
    known = [np.isfinite(rows[name]).all(axis=1) for name in ("quat", "rate")]
    (quat_time, quat), (rate_time, rate) = (
        (rows["time"][good], rows[name][good])
        for name, good in zip(("quat", "rate"), known, strict=True)
    )
    found = delay_of(quat_time, quat, rate_time, rate)
    if found is None:
        text = "the flight turns too little to hold its clocks against each other"
        return unseen("pose clock", text, "clock_offset", "clock_drift")
    drift = []
    if not found.drifts and not SURE_DRIFT * found.drift_error < SEEN:
        drift = unseen("pose clock", found.drift_figures(), "clock_drift")
    if found.drifts:
        fix = "suite import of the log that it was made of: the pose is moved"
        about = ("clock_drift", found.drift, 0.95, fix)
        drift = [Finding("doubt", "pose clock", found.drift_figures(), *about)]
    figures = f"it is {1e3 * found.delay_s:+.1f} ms (± {1e3 * found.error_s:.1f} ms) late"
    if abs(found.delay_s) < max(LATE_S, SURE * found.error_s):
        return [Finding("ok", "pose delay", figures + " against the gyro"), *drift]
    fix = "suite import moves it; or [effects.clock_offset] of the vehicle file"
    about = ("clock_offset", found.delay_s, 0.95, fix)
    return [Finding("doubt", "pose delay", figures + " against the gyro", *about), *drift]


def delay_of(
    quat_time: np.ndarray, quat: np.ndarray, rate_time: np.ndarray, rate: np.ndarray
) -> Late | None:
    """Return by how much the attitude `quat` (N, 4) is late against the gyro `rate` (M, 3).

    None where the flight turns too little, or where the best delay is at the end of the reach.
    """
    step = float(np.median(np.diff(quat_time))) if len(quat_time) > 1 else np.inf
    count = max(1, round(SPAN_S / step)) if np.isfinite(step) else 0
    if count == 0 or len(quat_time) < 20 * count or len(rate_time) < 100:
        return None
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    first, last = quat_time[:-count], quat_time[count:]
    span = last - first
    inside = (
        (span < 1.5 * count * step)
        & (first > rate_time[0] + REACH_S)
        & (last < rate_time[-1] - REACH_S)
    )
    if inside.sum() < 100:
        return None
    turns = rotation_vector(multiply(conjugate(unit[:-count]), unit[count:])) / span[:, None]
    first, last, turns = first[inside], last[inside], turns[inside]
    area = 0.5 * np.diff(rate_time)[:, None] * (rate[1:] + rate[:-1])
    full = np.concatenate([np.zeros((1, 3)), np.cumsum(area, axis=0)])

    middle, duration = 0.5 * float(last[-1] + first[0]), float(last[-1] - first[0])

    def gyro(late_s: float, drift: float) -> np.ndarray:
        at = [
            np.stack(
                [np.interp(t - late_s - drift * (t - middle), rate_time, c) for c in full.T], 1
            )
            for t in (first, last)
        ]
        return (at[1] - at[0]) / (last - first)[:, None]

    if np.sqrt(np.mean(np.sum(gyro(0.0, 0.0) ** 2, axis=1))) < CALM:
        return None
    trials = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    block = np.minimum((np.arange(len(first)) * BLOCKS) // len(first), BLOCKS - 1)

    def costs(drift: float) -> np.ndarray:
        cost = np.empty((BLOCKS, len(trials)))
        for k, late_s in enumerate(trials):
            off = turns - gyro(late_s, drift)
            size = np.linalg.norm(off - np.median(off, axis=0), axis=1)
            # The noise of one turn is that of two attitudes: wild ones must not decide.
            limit = 3.0 * np.median(size)
            loss = np.where(size < limit, 0.5 * size**2, limit * (size - 0.5 * limit))
            cost[:, k] = np.bincount(block, weights=loss, minlength=BLOCKS)
        return cost

    cost = costs(0.0)
    first_drift, (more, drift_error) = 0.0, _drift(trials, cost, duration)
    if abs(more) > LIKELY * drift_error:  # within a block, too, a drift would pass for scatter
        first_drift, cost = more, costs(more)
        more, drift_error = _drift(trials, cost, duration)
    whole = _lowest(trials, cost.sum(axis=0))
    parts = [_lowest(trials, cost.sum(axis=0) - cost[b]) for b in range(BLOCKS)]
    if whole is None or any(part is None for part in parts):
        return None
    error = _jackknife(np.array(parts, dtype=np.float64))
    return Late(whole, error, first_drift + more, drift_error, middle, duration)


def _drift(trials: np.ndarray, cost: np.ndarray, duration_s: float) -> tuple[float, float]:
    """Return by how much the delay grows in a second, from half to half, and its error."""
    half = BLOCKS // 2
    halves = [
        [_lowest(trials, part.sum(axis=0) - gone) for gone in (0.0, *part)]
        for part in (cost[:half], cost[half:])
    ]
    if any(part is None for each in halves for part in each):
        return 0.0, np.inf
    both = np.array(halves, dtype=np.float64)
    error = float(np.hypot(_jackknife(both[0, 1:]), _jackknife(both[1, 1:])))
    return float(both[1, 0] - both[0, 0]) / (0.5 * duration_s), error / (0.5 * duration_s)


def _jackknife(left_out: np.ndarray) -> float:
    """Return the standard error of an estimate by those with one block left out each."""
    count = len(left_out)
    return float(np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2)))


def _lowest(trials: np.ndarray, cost: np.ndarray) -> float | None:
    """Return where a parabola through the least cost and its neighbours is lowest."""
    k = int(np.argmin(cost))
    if k in (0, len(trials) - 1):
        return None
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    move = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(trials[k] + move * (trials[1] - trials[0]))
