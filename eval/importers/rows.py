"""Signals of different rates brought onto the rows of one flight log.

Rows stand at samples of the gyro (every n-th where it is faster than asked). What is measured is
interpolated to them, never across a hole; what is faster than the rows is averaged over a row's
period, so that vibration does not alias. A command is what was in force until the next row.
"""

from __future__ import annotations

import numpy as np

from eval.flight_check import FlightLogError
from eval.importers.frames import turn
from eval.importers.signals import Recording, Signal, median_step

SMOOTH = ("pos", "quat", "vel")
"""Interpolated by a cubic spline, as they follow from accelerations; the others linearly."""
HELD = ("cmd_thrust", "cmd_rate", "throttle", "motor_cmd")
"""Hold their value until the next sample."""
HOLE_S = 0.1
HOLE_STEPS = 5.0
"""Samples further apart than both are a hole."""
HOLD_S = 0.5
"""A command is not held for longer than this (and ten of its own steps) [s]."""
FAR_FASTER = 0.6
"""Signals whose step is below this share of a row's are averaged."""


def rows_from(
    recording: Recording, rate_hz: float, start_s: float, end_s: float | None
) -> dict[str, np.ndarray]:
    """Return the rows: `time` (T,) from 0 [s] and every signal as (T, C), NaN where unknown.

    Args:
        recording: holds at least pos, quat and rate.
        rate_hz: at most this many rows a second.
        start_s: first row, counted from where pos, quat and rate are all there [s].
        end_s: last row, in the same count, or None.

    Raises:
        FlightLogError: where pos, quat and rate share less than two samples of time.
    """
    needed = [recording.signals[name] for name in ("pos", "quat", "rate")]
    first = max(s.time_s[0] for s in needed)
    last = min(s.time_s[-1] for s in needed)
    stop = last if end_s is None else min(last, first + end_s)
    base = recording.signals["rate"].time_s
    every = max(1, round(1.0 / (rate_hz * median_step(base))))
    inside = base[(base >= first + start_s) & (base <= stop)]
    time_s = inside[::every]
    if len(time_s) < 2:
        spans = ", ".join(
            f"{name} from {s.time_s[0]:.3f} to {s.time_s[-1]:.3f} s"
            for name, s in zip(("pos", "quat", "rate"), needed, strict=True)
        )
        reason = f"no time at which position, attitude and gyro are all there ({spans})"
        raise FlightLogError(recording.name, "time", None, reason)
    rows = {"time": time_s - time_s[0]}
    for name, samples in recording.signals.items():
        if name in HELD:
            rows[name] = held(samples, time_s)
        else:
            rows[name] = measured(samples, time_s, smooth=name in SMOOTH)
    norm = np.linalg.norm(rows["quat"], axis=1, keepdims=True)
    on_sample = np.isin(time_s, recording.signals["quat"].time_s)[:, None]
    rows["quat"] = np.where(on_sample, rows["quat"], rows["quat"] / norm)
    return rows


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
            out[at] = averaged(t, v, time_s[at], row_step)
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
