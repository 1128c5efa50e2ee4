"""Checks of clocks: the unit of time, and the delay and drift of the pose against the gyro.

The attitude's rate over 60 ms is compared with the gyro's mean over the same time, shifted by trial
delays; the least difference gives the delay. Its error comes from leaving out blocks of the flight
in turn (jackknife).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import SPAN_S, Rows
from eval.logs.faults.reading import TIMES, option
from eval.logs.faults.relation import jackknife_error

STEPS_S = (5e-5, 0.25)
"""Possible time between rows of a log [s]."""
REACH_S, STEP_S = 0.1, 0.002
"""Largest delay that is tried, in both directions, and the step between trials [s]."""
BLOCKS = 8
CALM = 0.2
"""Smallest usable body rate, root mean square [rad/s]."""
LEAST_S, SURE = 0.002, 4.0
"""Least delay that is corrected: in seconds, and in standard errors."""
GROWN_S, DRIFT, SURE_DRIFT = 0.005, 3e-4, 5.0
"""Least drift that is reported: over a flight [s], relative (two crystals differ by less than
200 ppm), and in standard errors."""
LIKELY = 2.5
"""A drift of this many standard errors is removed before its error is estimated."""
SEEN = 0.005
"""The drift is not identifiable where its error exceeds this."""
LATE_S = 0.025
"""A diagnosis estimates smaller offsets itself (the effect clock_offset) [s]."""


class Late(NamedTuple):
    """Delay of an attitude against a gyro."""

    delay_s: float
    error_s: float
    """Standard error [s]."""
    drift: float
    """Growth of the delay per second of flight."""
    drift_error: float
    """Standard error of the drift."""
    middle_s: float
    """Time at which the delay is `delay_s` [s]."""
    duration_s: float
    """Of the flight [s]."""

    @property
    def drifts(self) -> bool:
        """Whether the drift exceeds that of crystals and its own error."""
        grown = abs(self.drift) * self.duration_s
        return grown > GROWN_S and abs(self.drift) > max(DRIFT, SURE_DRIFT * self.drift_error)

    def drift_figures(self) -> str:
        """Return the drift as text."""
        return (
            f"it gets later by {1e6 * self.drift:+.0f} ppm (± {1e6 * self.drift_error:.0f}), "
            f"{1e3 * self.drift * self.duration_s:+.1f} ms over the flight"
        )


def check_time(rows: Rows) -> list[Finding]:
    """Return the unit of the time, where the rows are impossibly far apart in seconds."""
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
    """Return whether the pose's delay exceeds what a diagnosis can estimate."""
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
    """Return the delay of the attitude `quat` (N, 4) against the gyro `rate` (M, 3).

    None where body rates are too small, or where the best delay is the largest that is tried.
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
            # Huber's loss limits the influence of outliers.
            limit = 3.0 * np.median(size)
            loss = np.where(size < limit, 0.5 * size**2, limit * (size - 0.5 * limit))
            cost[:, k] = np.bincount(block, weights=loss, minlength=BLOCKS)
        return cost

    cost = costs(0.0)
    first_drift, (more, drift_error) = 0.0, _drift(trials, cost, duration)
    if abs(more) > LIKELY * drift_error:  # inside a block a drift would count as scatter
        first_drift, cost = more, costs(more)
        more, drift_error = _drift(trials, cost, duration)
    whole = _lowest(trials, cost.sum(axis=0))
    parts = [_lowest(trials, cost.sum(axis=0) - cost[b]) for b in range(BLOCKS)]
    if whole is None or any(part is None for part in parts):
        return None
    error = jackknife_error(np.array(parts, dtype=np.float64))
    return Late(whole, error, first_drift + more, drift_error, middle, duration)


def _drift(trials: np.ndarray, cost: np.ndarray, duration_s: float) -> tuple[float, float]:
    """Return the growth of the delay per second between the two halves, and its error."""
    half = BLOCKS // 2
    halves = [
        [_lowest(trials, part.sum(axis=0) - gone) for gone in (0.0, *part)]
        for part in (cost[:half], cost[half:])
    ]
    if any(part is None for each in halves for part in each):
        return 0.0, np.inf
    both = np.array(halves, dtype=np.float64)
    error = float(np.hypot(jackknife_error(both[0, 1:]), jackknife_error(both[1, 1:])))
    return float(both[1, 0] - both[0, 0]) / (0.5 * duration_s), error / (0.5 * duration_s)


def _lowest(trials: np.ndarray, cost: np.ndarray) -> float | None:
    """Return the minimum of the parabola through the least cost and its neighbours."""
    k = int(np.argmin(cost))
    if k in (0, len(trials) - 1):
        return None
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    move = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(trials[k] + move * (trials[1] - trials[0]))
