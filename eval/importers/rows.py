"""Signals of different rates brought onto the rows of one flight log.

Row times are the samples of the slowest of position, attitude and gyro (every n-th where it exceeds
the wanted rate). So each measurement is in one row only, and rows have independent noise, as a
diagnosis assumes. Faster signals are smoothed over a row's period, so that vibration does not
alias. A command is its mean until the next row.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from eval.importers.frames import turn
from eval.importers.signals import NEEDED, Recording, Signal, median_step
from eval.logs.columns import FlightLogError
from eval.logs.files import MOST_ROWS

LEAST_HZ = 20.0
"""Least row rate; for slower signals rows are added between the samples."""
SMOOTH = ("pos", "quat", "vel")
"""Signals that are interpolated by a cubic spline; the others linearly."""
SPARSE = ("pos", "quat", "vel", "rate", "acc")
"""Signals that stay empty between their samples where they are slower than the rows."""
HELD = (
    *("cmd_thrust", "cmd_rate", "cmd_torque", "cmd_quat", "throttle", "motor_cmd", "pwm"),
    "kept:cmd_force",
)
"""Signals that hold their value until the next sample."""
HOLE_S = 0.1
HOLE_STEPS = 5.0
"""A gap exceeds both: in seconds, and in median steps."""
HOLD_S = 0.5
"""Longest time for which a command is held, unless ten of its steps are longer [s]."""
FAR_FASTER = 0.6
"""Signals whose step is below this share of a row's are smoothed."""
LOST = 0.8
"""A row further than this many steps from any velocity sample gets none."""
SLOWER = 1.5
"""Signals whose step exceeds this many rows' are slower than the rows."""


def rows_at(recording: Recording, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """Return the rows: `time` (T,) from 0 [s] and every signal as (T, C), NaN where unknown.

    Signals slower than the rows are interpolated here; `own_rows` returns their measured rows.

    Args:
        recording: holds at least one of pos, quat and rate.
        time_s: (T,) of the rows, on the recording's clock [s].
    """
    rows = {"time": time_s - time_s[0]}
    for name, samples in recording.signals.items():
        if name in HELD:
            rows[name] = held(samples, time_s)
        else:
            rows[name] = measured(samples, time_s, smooth=name in SMOOTH)
    if "quat" in rows:
        norm = np.linalg.norm(rows["quat"], axis=1, keepdims=True)
        on_sample = np.isin(time_s, recording.signals["quat"].time_s)[:, None]
        rows["quat"] = np.where(on_sample, rows["quat"], rows["quat"] / norm)
    return rows


def slowest(recording: Recording) -> str:
    """Return the slowest available signal of `NEEDED`; its samples define the rows."""
    there = [name for name in NEEDED if name in recording.signals]
    return max(there, key=lambda name: median_step(recording.signals[name].time_s))


def row_times(
    recording: Recording,
    rate_hz: float,
    start_s: float,
    end_s: float | None,
    within: tuple[float, float] = (-np.inf, np.inf),
) -> np.ndarray:
    """Return the rows' times (T,) on the recording's clock [s].

    Args:
        recording: holds at least one of pos, quat and rate.
        rate_hz: at most this many rows a second.
        start_s: first row, counted from where pos, quat and rate are all there [s].
        end_s: last row, in the same count, or None.
        within: first and last time on the recording's clock [s].

    Raises:
        FlightLogError: where pos, quat and rate share less than two samples of time.
    """
    there = [name for name in NEEDED if name in recording.signals]
    needed = [recording.signals[name] for name in there]
    first = max(s.time_s[0] for s in needed)
    last = min(s.time_s[-1] for s in needed)
    stop = last if end_s is None else min(last, first + end_s)
    base = recording.signals[slowest(recording)].time_s
    base = base[(base >= first) & (base <= last)]
    step = median_step(base)
    if step > 1.0 / LEAST_HZ and len(base) > 1:
        parts = int(np.ceil(step * LEAST_HZ - 1e-9))
        if (rows := (len(base) - 1) * parts) > MOST_ROWS:
            reason = (
                f"{' and '.join(there)} are {step:.3g} s apart, which makes {rows:,} rows; "
                f"at most {MOST_ROWS:,}: is its clock damaged, or its unit another one?"
            )
            raise FlightLogError(recording.name, "time", None, reason)
        share = np.arange(parts) / parts
        between = base[:-1, None] + share * np.diff(base)[:, None]
        # A gap stays empty.
        near = np.diff(base)[:, None] < HOLE_STEPS * step
        base = np.append(between[near | (share == 0.0)], base[-1])
        step /= parts
    every = max(1, int(np.ceil(1.0 / (rate_hz * step) - 0.01)))
    inside = (base >= within[0]) & (base <= within[1])
    time_s = base[inside & (base >= first + start_s) & (base <= stop)][::every]
    if len(time_s) < 2:
        if inside.any():
            reason = (
                f"--start and --end leave nothing of {base[inside][0] - first:.1f} to "
                f"{base[inside][-1] - first:.1f} s; they count from the file's first sample"
            )
        else:
            spans = ", ".join(
                f"{name} from {s.time_s[0]:.3f} to {s.time_s[-1]:.3f} s"
                for name, s in zip(there, needed, strict=True)
            )
            reason = f"no time at which {' and '.join(there)} are there ({spans})"
        raise FlightLogError(recording.name, "time", None, reason)
    return time_s


def own_rows(recording: Recording, time_s: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the measured rows (T,) bool of each signal that is slower than the rows.

    A sample is for the row nearest to it, and for that of the slowest signal where one is within
    half of its own step, so that there are rows in which nothing is missing.

    Args:
        recording: the signals on their own times.
        time_s: (T,) of the rows, on the recording's clock [s].
    """
    row_step, found = median_step(time_s), {}
    anchor = nearest(time_s, recording.signals[slowest(recording)].time_s)
    for name in SPARSE:
        samples = recording.signals.get(name)
        if samples is None:
            continue
        step = median_step(samples.time_s)
        if step <= SLOWER * row_step:
            far = np.abs(samples.time_s[nearest(samples.time_s, time_s)] - time_s) > LOST * step
            if name == "vel" and far.any():
                found[name] = ~far
            continue
        row = nearest(time_s, samples.time_s)
        close = anchor[nearest(time_s[anchor], samples.time_s)]
        near = np.abs(time_s[close] - samples.time_s) <= 0.5 * median_step(samples.time_s)
        inside = np.abs(time_s[row] - samples.time_s) <= row_step
        found[name] = np.zeros(len(time_s), dtype=bool)
        found[name][np.where(near, close, row)[near | inside]] = True
    return found


def nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the places in increasing `times` that are nearest to `wanted`, the earlier of two."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[after - 1] <= times[after] - wanted, after - 1, after)


def measured(samples: Signal, time_s: np.ndarray, smooth: bool) -> np.ndarray:
    """Return a measured signal at `time_s` (T,) as (T, C), NaN in holes and beyond the ends."""
    value = continuous(samples.value) if smooth and samples.value.shape[1] == 4 else samples.value
    step, row_step = median_step(samples.time_s), median_step(time_s)
    hole = max(HOLE_S, HOLE_STEPS * step)
    out = np.full((len(time_s), value.shape[1]), np.nan)
    cuts = np.flatnonzero(np.diff(samples.time_s) > hole) + 1
    edges = [0, *cuts.tolist(), len(samples.time_s)]
    for first, stop in zip(edges[:-1], edges[1:], strict=True):
        t, v = samples.time_s[first:stop], value[first:stop]
        at = np.flatnonzero((time_s >= t[0]) & (time_s <= t[-1]))
        if not len(at):
            continue
        if smooth and len(t) >= 4:
            out[at] = _spline(t, v, time_s[at])
        elif not smooth and step < FAR_FASTER * row_step and len(t) > 1:
            out[at] = smoothed(t, v, time_s[at], row_step)
        else:
            out[at] = _linear(t, v, time_s[at])
    return out


def held(samples: Signal, time_s: np.ndarray) -> np.ndarray:
    """Return a command for rows at `time_s` (T,) as (T, C).

    Where the command changes inside a row's period, its mean over that period is returned, which
    is what acts; before the first sample and long after the last, NaN.
    """
    t, v = samples.time_s, samples.value
    index = np.searchsorted(t, time_s, side="right") - 1
    out = v[np.clip(index, 0, None)]
    ends = np.append(time_s[1:], time_s[-1])
    changes = np.searchsorted(t, ends, side="left") - 1 > index
    full = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(np.diff(t)[:, None] * v[:-1], 0)])

    def integral(at: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, None)
        return full[k] + (at - t[k])[:, None] * v[k]

    rows = np.flatnonzero(changes & (index >= 0))
    if len(rows):
        span = (ends - time_s)[rows, None]
        out[rows] = (integral(ends[rows]) - integral(time_s[rows])) / span
    age = time_s - t[np.clip(index, 0, None)]
    old = max(HOLD_S, 10.0 * median_step(t)) if len(t) > 1 else np.inf
    out[(index < 0) | (age > old)] = np.nan
    return out


def in_world(vel_b: Signal, quat: Signal) -> Signal:
    """Return a velocity in body axes as one in world axes, where the attitude is known."""
    attitude = measured(quat, vel_b.time_s, smooth=True)
    known = np.isfinite(attitude).all(axis=1)
    unit = attitude[known] / np.linalg.norm(attitude[known], axis=1, keepdims=True)
    return Signal(vel_b.time_s[known], turn(unit, vel_b.value[known]))


def continuous(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs such that neighbours are near each other."""
    flips = np.sum(quat_wxyz[1:] * quat_wxyz[:-1], axis=1) < 0
    sign = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    return quat_wxyz * sign[:, None]


def _spline(t: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
    from scipy.interpolate import CubicSpline

    return CubicSpline(t, v)(at)


def _linear(t: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, t, column) for column in v.T], axis=1)


def smoothed(t: np.ndarray, v: np.ndarray, at: np.ndarray, width_s: float) -> np.ndarray:
    """Return the value (M, C) at each `at` of a parabola through the samples within `width_s`.

    A mean would flatten what is curved; a parabola keeps it and averages the noise alike
    (Savitzky and Golay 1964). Where fewer than three samples are near, lines join them.
    """
    first = np.searchsorted(t, at - 0.5 * width_s)
    count = np.searchsorted(t, at + 0.5 * width_s, side="right") - first
    moment, right = np.zeros((len(at), 5)), np.zeros((len(at), 3, v.shape[1]))
    for offset in range(int(count.max(initial=0))):
        k = np.minimum(first + offset, len(t) - 1)
        u = (t[k] - at) / (0.5 * width_s)
        powers = np.where((offset < count)[:, None], u[:, None] ** np.arange(5), 0.0)
        moment += powers
        right += powers[:, :3, None] * v[k][:, None, :]
    out = _linear(t, v, at)
    enough = np.flatnonzero(count >= 3)
    normal = moment[enough][:, np.arange(3)[:, None] + np.arange(3)]
    out[enough] = np.linalg.solve(normal, right[enough])[:, 0]
    return out


def averaged(t: np.ndarray, v: np.ndarray, at: np.ndarray, width_s: float) -> np.ndarray:
    """Return the mean (M, C) of samples `v` (N, C) at `t`, joined by lines, around each `at`.

    Near the ends of the samples the width shrinks so that it stays around `at`.
    """
    area = 0.5 * np.diff(t)[:, None] * (v[1:] + v[:-1])
    full = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(area, axis=0)])
    half = np.minimum(0.5 * width_s, np.minimum(at - t[0], t[-1] - at))

    def integral(where: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(t, where, side="right") - 1, 0, len(t) - 2)
        part = (where - t[k])[:, None]
        slope = (v[k + 1] - v[k]) / (t[k + 1] - t[k])[:, None]
        return full[k] + part * (v[k] + 0.5 * part * slope)

    # A window that has no width at an end of the data: the value itself.
    width = np.where(half > 0, 2.0 * half, 1.0)[:, None]
    mean = (integral(at + half) - integral(at - half)) / width
    return np.where(half[:, None] > 0, mean, _linear(t, v, at))
