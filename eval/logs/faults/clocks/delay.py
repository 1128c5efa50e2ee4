"""Check the clocks of pose and gyro: delay and drift of the pose, and a rotation of its axes.

A constant rotation between their body axes is found with the delay, since each resembles the other.

The body rate from the attitude over 60 ms is compared with the gyro's mean over the same time,
shifted by trial delays. The least difference gives the delay. Its standard error comes from
estimates that leave out one block of the flight at a time (jackknife).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.effects.log_faults import pose_delay
from eval.importers.frames import rates_between, rotate
from eval.logs.faults.clocks.rotation import fit_rotation, rotation_findings
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import SPAN_S, WIDTH_S, Rows, turns_of
from eval.logs.faults.relation import interpolate, jackknife_error, shifted, smooth
from eval.logs.velocity import velocity_from_position
from eval.vehicles.vehicle import Vehicle

REACH_S, STEP_S = 0.1, 0.002
"""Largest delay that is tried, in both directions, and the step between trials [s]."""
FAR_S, FAR_STEP_S, FAR_SHARE = 0.5, 0.02, 0.5
"""Larger delays, up to the first one, are tried in coarse steps. One of them must lower the misfit
of all small delays to this share: a periodic flight fits again after a period."""
BLOCKS = 8
"""Number of blocks of the jackknife."""
PLACE = np.arange(BLOCKS)
"""(BLOCKS,) numbers of the blocks."""
CALM = 0.2
"""Smallest usable body rate, root mean square [rad/s]."""
LEAST_S, SURE = 0.002, 4.0
"""Least delay that is corrected: in seconds, and in standard errors."""
CLEARLY = 15.0
"""The same for a velocity: in real logs an estimator's may be 60 ms late, by 10 standard errors."""
GROWN_S, DRIFT, SURE_DRIFT = 0.005, 3e-4, 5.0
"""Least drift that is reported: over a flight [s], relative (two crystals differ by less than
200 ppm), and in standard errors."""
JUMP = 0.5
"""A clock jumps if two constant delays leave less than this share of the squares that a line leaves
of the delays of the blocks."""
LIKELY = 2.5
"""A drift above this many standard errors is removed, and its error is estimated again. A force
that fits the path better by as many has the other time."""
SEEN = 0.005
"""The drift is not identifiable where `SURE_DRIFT` standard errors exceed this."""
LATE_S = 0.025
"""Least delay that is a fault [s]. A diagnosis estimates smaller ones itself (effect
`clock_offset`)."""
CUT = "find the jump, and cut the log there with --start or --end of suite import"
"""Fix of a clock that jumps."""
OF_POSE = ("pos", "quat", "vel")
"""Signals of the device that measures the pose; they share its delay."""
COARSE = 2.0
"""Shifts below this many rows of the path are too small to be seen in its acceleration."""


class Late(NamedTuple):
    """Delay of an attitude against a gyro, which may drift over the flight."""

    delay_s: float
    """Delay at the time `middle_s`; positive if the attitude is late [s]."""
    error_s: float
    """Standard error of `delay_s` [s]."""
    drift: float
    """Growth of the delay per second of flight."""
    drift_error: float
    """Standard error of the drift."""
    middle_s: float
    """Middle of the flight [s]."""
    duration_s: float
    """Duration of the flight [s]."""
    jump_s: float
    """By how much the delay grows at once; 0 if it changes evenly or not at all [s]."""
    rotation: np.ndarray
    """(3,) rotation vector from the attitude's body axes to the gyro's [deg]; 0 if too small."""

    def moved(self, signals: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> tuple[str, ...]:
        """Return the signals whose delay this is; `signals` are (times, values) by name.

        No pose is measured early, so an early one is a late gyro. But if the path fits the rotor
        speeds better at the gyro's time, the clock of the pose is wrong. The accelerometer is as
        late as the gyro if the path fits it better then.
        """
        if self.delay_s > 0.0 or _fits_later(signals, "motor", self.delay_s):
            return OF_POSE
        return ("rate", "acc") if _fits_later(signals, "acc", self.delay_s) else ("rate",)

    def figures(self, moved: Sequence[str]) -> tuple[str, str]:
        """Return the subject of a finding on the delay of the signals `moved`, and its text."""
        size = f"{1e3 * abs(self.delay_s):.1f} ms (± {1e3 * self.error_s:.1f} ms) late"
        if "rate" in moved:
            return "gyro delay", f"it is {size} against the attitude (a filter, or its time stamp)"
        sign = "-" if self.delay_s < 0.0 else "+"
        return "pose delay", f"it is {sign}{size} against the gyro"

    @property
    def drifts(self) -> bool:
        """Whether the drift exceeds what two crystals cause, and what its own error can cause."""
        growth_s = 0.0 if self.jump_s else abs(self.drift) * self.duration_s
        return growth_s > GROWN_S and abs(self.drift) > max(DRIFT, SURE_DRIFT * self.drift_error)

    def drift_findings(self, status: str, fix: str) -> list[Finding]:
        """Return the finding on a drift or jump of the delay, [] for neither.

        A drift has the status and the fix that are given; no shift corrects a jump.
        """
        if self.jump_s:
            text = f"its delay jumps by {1e3 * self.jump_s:+.0f} ms: a clock was set, or rows are "
            about = ("clock_drift", self.jump_s, 0.95, CUT)
            return [Finding("doubt", "pose clock", f"{text}missing", *about)]
        if not self.drifts:
            return []
        about = ("clock_drift", self.drift, 0.95, fix)
        return [Finding(status, "pose clock", self.drift_figures(), *about)]

    def drift_figures(self) -> str:
        """Return the drift as text."""
        return (
            f"it gets later by {1e6 * self.drift:+.0f} ppm (± {1e6 * self.drift_error:.0f}), "
            f"{1e3 * self.drift * self.duration_s:+.1f} ms over the flight"
        )


def check_clock(rows: Rows, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return findings on the pose's delay against the gyro, and on the drift of this delay.

    A delay that the vehicle file states (`clock_offset`) is no fault.
    """
    if not {"quat", "rate"} <= rows.keys():
        return []
    late = delay_of(rows["time"], rows["quat"], rows["time"], rows["rate"])
    if late is None:
        text = "the flight turns too little to hold its clocks against each other"
        return unseen("pose clock", text, "clock_offset", "clock_drift")
    drift = rotation_findings(late.rotation)
    if not (late.jump_s or late.drifts) and not SURE_DRIFT * late.drift_error < SEEN:
        drift += unseen("pose clock", late.drift_figures(), "clock_drift")
    fix = "suite import of the log that it was made of: the pose is moved"
    drift += late.drift_findings("doubt", fix)
    if late.jump_s:
        return drift
    known_s = 0.0 if vehicle is None else float(pose_delay(vehicle.effects))
    if abs(late.delay_s - known_s) < max(LATE_S, SURE * late.error_s):
        return [Finding("ok", *late.figures(OF_POSE)), *drift]
    moved = late.moved({name: (rows["time"], value) for name, value in rows.items()})
    fix = "suite import of the log that it was made of moves it"
    if "rate" not in moved:
        fix = "suite import moves it; or [effects.clock_offset] of the vehicle file"
    about = ("clock_offset", late.delay_s, 0.95, fix)
    subject, figures = late.figures(moved)
    figures += f"; clock_offset of the vehicle file: {1e3 * known_s:g} ms" if known_s else ""
    return [Finding("doubt", subject, figures, *about), *drift]


def late_against(
    time_s: np.ndarray, wanted: np.ndarray, given: np.ndarray
) -> tuple[float, float] | None:
    """Return by how much `given` (T, C) is later than `wanted` (T, C), and its error [s].

    Neither the scale nor a constant of `given` counts. None: not identifiable, or over `FAR_S`.
    """
    known, has_wanted = (np.isfinite(value).all(axis=1) for value in (given, wanted))
    known_s, given = time_s[known], given[known]
    far_s = _far_delay(time_s[has_wanted], wanted[has_wanted], known_s, given)
    reach_s = REACH_S + abs(far_s)
    inside = has_wanted & (time_s > time_s[0] + reach_s) & (time_s < time_s[-1] - reach_s)
    if min(known.sum(), inside.sum()) < 100:
        return None
    time_s = time_s[inside]
    wanted = (wanted[inside] - wanted[inside].mean(axis=0)).T[:, None]
    trials = far_s + np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    cost = np.empty((BLOCKS, len(trials)))
    for some, tried in shifted(time_s, trials, known_s, given):
        tried = tried - tried.mean(axis=-1, keepdims=True)
        scale = np.sum(wanted * tried, axis=(0, 2)) / np.maximum(np.sum(tried**2, (0, 2)), 1e-12)
        cost[:, some] = block_sums(np.sum((wanted - scale[:, None] * tried) ** 2, axis=0))
    return best_delay(trials, cost)


def _fits_later(
    signals: Mapping[str, tuple[np.ndarray, np.ndarray]], name: str, late_s: float
) -> bool:
    """Return whether the path fits the force by signal `name` better if it is `late_s` late.

    The force is that along body z, by the accelerometer or the squares of the rotor speeds.
    """
    if not {"pos", "quat", name} <= signals.keys():
        return False
    time_s, pos = signals["pos"]
    source_s, value = signals[name]
    if abs(late_s) < COARSE * float(np.median(np.diff(time_s))):
        return False
    quat_s, quat = signals["quat"]
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    z_w = rotate(unit, np.array([0.0, 0.0, 1.0]))
    z_w = interpolate(time_s, quat_s, z_w)
    acc_w = velocity_from_position(time_s, velocity_from_position(time_s, pos))
    force = np.sum(z_w * (acc_w + [0.0, 0.0, GRAVITY]), axis=1, keepdims=True)
    path = smooth(time_s, force, WIDTH_S)[:, 0]
    push = value[:, 2:] if name == "acc" else np.sum(value**2, axis=1, keepdims=True)
    push = smooth(source_s, push, WIDTH_S)[:, 0]
    trials = [np.interp(time_s - shift, source_s, push) for shift in (0.0, late_s)]
    inside = (time_s > source_s[0] + REACH_S) & (time_s < source_s[-1] - REACH_S)
    good = inside & np.isfinite(np.sum([path, *trials], axis=0))
    if good.sum() < 100 or not all(np.ptp(one[good]) for one in (path, *trials)):
        return False
    path, *trials = (one[good] - one[good].mean() for one in (path, *trials))
    now, then = (trial / np.linalg.norm(trial) * np.linalg.norm(path) for trial in trials)
    better = (path - now) ** 2 - (path - then) ** 2
    parts = np.array([part.sum() for part in np.array_split(better, BLOCKS)])
    return bool(parts.sum() > LIKELY * jackknife_error(parts.sum() - parts))


def delay_of(
    quat_time: np.ndarray, quat: np.ndarray, rate_time: np.ndarray, rate: np.ndarray
) -> Late | None:
    """Return the delay of the attitude `quat` (N, 4) against the gyro `rate` (M, 3).

    Samples with a NaN are not used. The result is None where the flight is too short or the body
    rates are too small, or where the best delay is the largest that is tried.
    """
    known = np.isfinite(quat).all(axis=1)
    quat_time, quat = quat_time[known], quat[known]
    known = np.isfinite(rate).all(axis=1)
    rate_time, rate = rate_time[known], rate[known]
    turns = smooth(quat_time, turns_of(quat_time, quat), SPAN_S)
    known = np.isfinite(turns).all(axis=1)
    gyro = smooth(rate_time, rate, 2.0 * SPAN_S)
    far_s = _far_delay(rate_time, gyro, quat_time[known], turns[known])
    near = _near_delay(quat_time - far_s, quat, rate_time, rate)
    if near is None:
        return None
    return near._replace(delay_s=near.delay_s + far_s, middle_s=near.middle_s + far_s)


def _far_delay(
    time_s: np.ndarray, wanted: np.ndarray, known_s: np.ndarray, given: np.ndarray
) -> float:
    """Return about the delay of `given` (N, C) against `wanted` (T, C) if `REACH_S` may not do.

    It is 0 if the delay is smaller or unclear [s]. Neither scale nor outliers count.
    """
    if min(len(time_s), len(known_s)) < 100:
        return 0.0
    inside = (time_s > known_s[0] + FAR_S) & (time_s < known_s[-1] - FAR_S)
    size = np.linalg.norm(wanted, axis=1)
    inside &= size <= 4.0 * np.quantile(size, 0.9)
    if inside.sum() < 100:
        return 0.0
    time_s, wanted = time_s[inside], (wanted[inside] - wanted[inside].mean(axis=0)).T[:, None]
    trials = np.arange(-FAR_S, FAR_S + 0.5 * FAR_STEP_S, FAR_STEP_S)
    unlike = np.ones(len(trials))
    for some, tried in shifted(time_s, trials, known_s, given):
        tried = tried - tried.mean(axis=-1, keepdims=True)
        norm = np.linalg.norm(wanted) * np.sqrt(np.sum(tried**2, axis=(0, 2)))
        alike = np.sum(wanted * tried, axis=(0, 2)) / np.maximum(norm, 1e-12)
        unlike[some] = 1.0 - np.maximum(alike, 0.0) ** 2
    best, is_small = int(np.argmin(unlike)), np.abs(trials) <= 0.5 * REACH_S
    is_clear = unlike[best] < FAR_SHARE * unlike[is_small].min()
    return float(trials[best]) if is_clear and abs(trials[best]) > 0.75 * REACH_S else 0.0


def _near_delay(
    quat_time: np.ndarray, quat: np.ndarray, rate_time: np.ndarray, rate: np.ndarray
) -> Late | None:
    """Return the delay of at most `REACH_S`; see `delay_of`."""
    step = float(np.median(np.diff(quat_time))) if len(quat_time) > 1 else np.inf
    count = max(1, round(SPAN_S / step)) if np.isfinite(step) else 0
    if count == 0 or len(quat_time) < 20 * count or len(rate_time) < 100:
        return None
    # Body rates from the attitude: rotations from `first` to `last`, where no rows are missing.
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    first, last = quat_time[:-count], quat_time[count:]
    span, turns = rates_between(quat_time, unit, count)
    inside = (
        (span < 1.5 * count * step)
        & (first > rate_time[0] + REACH_S)
        & (last < rate_time[-1] - REACH_S)
    )
    if inside.sum() < 100:
        return None
    first, last, turns = first[inside], last[inside], turns[inside]
    # Integral of the gyro, from which its mean over any time follows by interpolation.
    area = 0.5 * np.diff(rate_time)[:, None] * (rate[1:] + rate[:-1])
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(area, axis=0)])

    middle, duration = 0.5 * float(last[-1] + first[0]), float(last[-1] - first[0])

    def gyros(trials: np.ndarray, drift: float) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield (trials, the gyro's mean rates (3, trials, N)) over the same times, at a drift."""
        ends = (t - drift * (t - middle) for t in (first, last))
        both = (shifted(end_s, -trials, rate_time, integral) for end_s in ends)
        for (some, before), (_, after) in zip(*both, strict=True):
            yield some, (after - before) / (last - first)

    ((_, gyro),) = gyros(np.zeros(1), 0.0)
    if np.sqrt(np.mean(np.sum(gyro**2, axis=0))) < CALM or not turns.any():
        return None
    trials = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    rotation, turned = fit_rotation(turns, (gyro for _, gyro in gyros(trials, 0.0)))
    turns = (rotation @ turns.T)[:, None]

    def costs(drift: float) -> np.ndarray:
        """Return the misfit (BLOCKS, trials) of every block and trial delay."""
        cost = np.empty((BLOCKS, len(trials)))
        for some, gyro in gyros(trials, drift):
            residual = turns - gyro
            residual = residual - np.median(residual, axis=-1, keepdims=True)
            size = np.sqrt(np.sum(residual**2, axis=0))
            # Huber's loss limits the influence of outliers.
            limit = 3.0 * np.median(size, axis=-1, keepdims=True)
            loss = np.where(size < limit, 0.5 * size**2, limit * (size - 0.5 * limit))
            cost[:, some] = block_sums(loss)
        return cost

    cost = costs(0.0)
    first_drift, (rest_of_drift, drift_error) = 0.0, _drift(trials, cost, duration)
    if abs(rest_of_drift) > LIKELY * drift_error:  # inside a block a drift would count as scatter
        first_drift, cost = rest_of_drift, costs(rest_of_drift)
        rest_of_drift, drift_error = _drift(trials, cost, duration)
    if (best := best_delay(trials, cost)) is None:
        return None
    drift = first_drift + rest_of_drift
    each = [_lowest(trials, part) for part in cost]
    jump_s = (
        0.0 if None in each else _jump(np.array(each) + first_drift * duration / BLOCKS * PLACE)
    )
    return Late(*best, drift, drift_error, middle, duration, jump_s, turned)


def _jump(delay_s: np.ndarray) -> float:
    """Return by how much the delays (B,) of equal blocks grow at once; 0 if evenly or hardly."""
    line = delay_s - np.polyval(np.polyfit(PLACE, delay_s, 1), PLACE)
    parts = [np.split(delay_s, [k]) for k in PLACE[2:-1]]
    left = [sum(float(np.sum((part - part.mean()) ** 2)) for part in pair) for pair in parts]
    before, after = parts[int(np.argmin(left))]
    size_s = float(after.mean() - before.mean())
    error_s = np.sqrt(min(left) / (BLOCKS - 2) * (1.0 / len(before) + 1.0 / len(after)))
    is_clear = abs(size_s) > max(LATE_S, SURE_DRIFT * error_s)
    return size_s if is_clear and min(left) < JUMP * float(np.sum(line**2)) else 0.0


def _drift(trials: np.ndarray, cost: np.ndarray, duration_s: float) -> tuple[float, float]:
    """Return the drift (growth of the delay per second of flight), and its standard error.

    It is the difference of the delays of the two halves of the flight, whose middles are half the
    flight apart.
    """
    first, last = (best_delay(trials, part) for part in np.split(cost, 2))
    if first is None or last is None:
        return 0.0, np.inf
    apart_s = 0.5 * duration_s
    return (last[0] - first[0]) / apart_s, float(np.hypot(first[1], last[1])) / apart_s


def block_sums(value: np.ndarray) -> np.ndarray:
    """Return the sums (BLOCKS, K) of `value` (K, N) over equal blocks of its N rows."""
    starts = -(-PLACE * value.shape[-1] // BLOCKS)
    return np.add.reduceat(value, starts, axis=-1).T


def best_delay(trials: np.ndarray, cost: np.ndarray) -> tuple[float, float] | None:
    """Return the trial delay of the least `cost` (blocks, trials), and its error by jackknife."""
    total = cost.sum(axis=0)
    best, *without_block = (_lowest(trials, total - part) for part in (0.0, *cost))
    if best is None or None in without_block:
        return None
    return best, jackknife_error(np.array(without_block, dtype=np.float64))


def _lowest(trials: np.ndarray, cost: np.ndarray) -> float | None:
    """Return the minimum of the parabola through the least cost and its neighbours."""
    k = int(np.argmin(cost))
    if k in (0, len(trials) - 1):
        return None
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    move = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(trials[k] + move * (trials[1] - trials[0]))
