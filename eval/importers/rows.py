"""Resample signals of different rates to the rows of one flight log.

The rows have the sample times of the slowest of position, attitude and gyro. If that signal is
faster than the wanted rate, only every n-th sample makes a row. So each measurement is in one row
only, and the noise of different rows is independent, as a diagnosis assumes. Faster signals are
smoothed over a row's period, so that vibration does not alias. A row has the mean of each command
until the next row.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from eval.importers.frames import conjugate, rotate
from eval.importers.signals import NEEDED, Recording, Signal, median_step
from eval.logs.columns import FlightLogError
from eval.logs.faults.relation import interpolate
from eval.logs.files import MOST_ROWS

LEAST_HZ = 20.0
"""Least row rate; for slower signals rows are added between the samples."""
COARSE_HZ = 100.0
"""Largest row rate for the checks of the pose [Hz]."""
SMOOTH = ("pos", "quat", "vel")
"""Signals that are interpolated by a cubic spline; the others linearly."""
SPARSE = ("pos", "quat", "vel", "rate", "acc")
"""Signals that stay empty between their samples where they are slower than the rows."""
HELD = (
    *("cmd_thrust", "cmd_rate", "cmd_torque", "cmd_quat", "throttle", "motor_cmd", "pwm"),
    *("kept:cmd_force", "kept:thrust_share"),
)
"""Signals that hold their value until the next sample."""
MEASURED = ("kept:est_", "kept:acc_w_")
"""First letters of the kept columns that are measured signals; others, such as a mode, may have
values between which nothing lies."""
GAP_S = 0.1
GAP_STEPS = 5.0
"""A pause between two samples is a gap if it is longer than `GAP_S` seconds and longer than
`GAP_STEPS` times the median time between samples."""
HOLD_S = 0.5
"""Longest time for which a command is held [s]; for slow commands, ten times their time between
samples if that is longer."""
FASTER = 0.6
"""A signal is smoothed if the time between its samples is below this share of a row's period."""
LOST = 0.8
"""A row gets no velocity if the nearest sample is further away than this many of their steps."""
SLOWER = 1.5
"""A signal is slower than the rows if its time between samples exceeds this many row periods."""


def rows_at(recording: Recording, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """Return the rows: `time` (T,) from 0 [s] and every signal as (T, C), NaN where unknown.

    Signals slower than the rows are interpolated; `sampled_rows` returns which rows are samples.
    `time_s` (T,) is on the clock of the recording, which has a signal of `NEEDED` [s].
    """
    rows = {"time": time_s - time_s[0]}
    for name, samples in recording.signals.items():
        if name == "cmd_quat":  # a mean of opposite signs of one attitude would be none
            rows[name] = held(samples._replace(value=continuous(samples.value)), time_s)
        elif name in HELD:
            rows[name] = held(samples, time_s)
        elif name.startswith("kept:") and not name.startswith(MEASURED):
            rows[name] = unchanged(samples, time_s)
        else:
            rows[name] = measured(samples, time_s, smooth=name in SMOOTH)
    if "quat" in rows:
        norm = np.linalg.norm(rows["quat"], axis=1, keepdims=True)
        on_sample = np.isin(time_s, recording.signals["quat"].time_s)[:, None]
        rows["quat"] = np.where(on_sample, rows["quat"], rows["quat"] / norm)
    return rows


def slowest(recording: Recording) -> str:
    """Return the slowest signal of `NEEDED` in the recording; its samples define the rows."""
    present = [name for name in NEEDED if name in recording.signals]
    return max(present, key=lambda name: median_step(recording.signals[name].time_s))


def row_times(
    recording: Recording,
    rate_hz: float = COARSE_HZ,
    start_s: float = 0.0,
    end_s: float | None = None,
    within: tuple[float, float] = (-np.inf, np.inf),
    origin_s: float | None = None,
) -> np.ndarray:
    """Return the rows' times (T,) on the recording's clock [s].

    Args:
        recording: holds at least one of pos, quat and rate.
        rate_hz: at most this many rows a second.
        start_s: least time of the first row [s], counted from `origin_s`.
        end_s: largest time of the last row [s], counted in the same way; None: no limit.
        within: first and last allowed time on the recording's clock [s].
        origin_s: first sample of the file, on the recording's clock [s]; None: the first time at
            which pos, quat and rate all have samples.

    Raises:
        FlightLogError: where fewer than two samples are left.
    """
    present = [name for name in NEEDED if name in recording.signals]
    needed = [recording.signals[name] for name in present]
    # The rows lie in the time that all required signals share.
    begin = max(s.time_s[0] for s in needed)
    end = min(s.time_s[-1] for s in needed)
    origin_s = begin if origin_s is None else origin_s
    last_allowed = end if end_s is None else min(end, origin_s + end_s)
    times = recording.signals[slowest(recording)].time_s
    times = times[(times >= begin) & (times <= end)]
    step = median_step(times)
    # A slow signal: add rows between its samples, so that the rows have at least `LEAST_HZ`.
    if step > 1.0 / LEAST_HZ and len(times) > 1:
        parts = int(np.ceil(step * LEAST_HZ - 1e-9))
        if (rows := (len(times) - 1) * parts) > MOST_ROWS:
            reason = (
                f"{' and '.join(present)} are {step:.3g} s apart, which makes {rows:,} rows; "
                f"at most {MOST_ROWS:,}: is its clock damaged, or its unit another one?"
            )
            raise FlightLogError(recording.name, reason, "time")
        share = np.arange(parts) / parts
        between = times[:-1, None] + share * np.diff(times)[:, None]
        # No rows are added within a gap.
        no_gap = np.diff(times)[:, None] < GAP_STEPS * step
        times = np.append(between[no_gap | (share == 0.0)], times[-1])
        step /= parts
    stride = max(1, int(np.ceil(1.0 / (rate_hz * step) - 0.01)))
    valid = (times >= within[0]) & (times <= within[1])
    inside = times[valid & (times >= origin_s + start_s) & (times <= last_allowed)]
    time_s = inside[::stride]
    if len(time_s) < 2:
        if valid.any():
            first_s, last_s = times[valid][[0, -1]] - origin_s
            if valid.sum() < 2:
                reason = "only 1 row; two or more are needed"
            elif len(inside) < valid.sum():
                reason = (
                    f"no two rows between --start and --end; rows are from {first_s:.4g} to "
                    f"{last_s:.4g} s, counted from the file's first sample"
                )
            else:
                reason = (
                    f"the log lasts {last_s - first_s:.2g} s; if it is longer, correct the unit of "
                    "its time: unit in [time] of the mapping, or --read time=ms, us or ns"
                )
        else:
            spans = ", ".join(
                f"{name} from {s.time_s[0]:.3f} to {s.time_s[-1]:.3f} s"
                for name, s in zip(present, needed, strict=True)
            )
            reason = f"{' and '.join(present)} have no common time ({spans})"
        raise FlightLogError(recording.name, reason, "time")
    return time_s


def sampled_rows(recording: Recording, time_s: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return which rows (T,) bool hold a sample, for each signal that is slower than the rows.

    A sample belongs to the nearest row, or to a row of the slowest signal within half the time
    between samples, so that some rows have all signals. A fast velocity with gaps is listed too.
    `time_s` (T,) is on the recording's clock [s].
    """
    row_step, is_sample = median_step(time_s), {}
    slowest_rows = nearest(time_s, recording.signals[slowest(recording)].time_s)
    for name in SPARSE:
        samples = recording.signals.get(name)
        if samples is None:
            continue
        step = median_step(samples.time_s)
        if step <= SLOWER * row_step:
            is_far = np.abs(samples.time_s[nearest(samples.time_s, time_s)] - time_s) > LOST * step
            if name == "vel" and is_far.any():
                is_sample[name] = ~is_far
            continue
        row = nearest(time_s, samples.time_s)
        shared_row = slowest_rows[nearest(time_s[slowest_rows], samples.time_s)]
        to_shared = np.abs(time_s[shared_row] - samples.time_s) <= 0.5 * step
        to_nearest = np.abs(time_s[row] - samples.time_s) <= row_step
        is_sample[name] = np.zeros(len(time_s), dtype=bool)
        is_sample[name][np.where(to_shared, shared_row, row)[to_shared | to_nearest]] = True
    return is_sample


def nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the indices into increasing `times` nearest to `wanted`; of two, the earlier one."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[after - 1] <= times[after] - wanted, after - 1, after)


def measured(samples: Signal, time_s: np.ndarray, smooth: bool) -> np.ndarray:
    """Return a measured signal at `time_s` (T,) as (T, C), NaN in gaps and beyond the ends.

    It is interpolated by a cubic spline (`smooth`) or linearly; linearly it is averaged over a
    row's period where it is faster than the rows.
    """
    value = continuous(samples.value) if smooth and samples.value.shape[1] == 4 else samples.value
    step, row_step = median_step(samples.time_s), median_step(time_s)
    gap_s = max(GAP_S, GAP_STEPS * step)
    out = np.full((len(time_s), value.shape[1]), np.nan)
    cuts = np.flatnonzero(np.diff(samples.time_s) > gap_s) + 1
    edges = [0, *cuts.tolist(), len(samples.time_s)]
    for first, stop in zip(edges[:-1], edges[1:], strict=True):
        t, v = samples.time_s[first:stop], value[first:stop]
        rows = np.flatnonzero((time_s >= t[0]) & (time_s <= t[-1]))
        if not len(rows):
            continue
        if smooth and len(t) >= 4:
            from scipy.interpolate import CubicSpline

            out[rows] = CubicSpline(t, v)(time_s[rows])
        elif not smooth and step < FASTER * row_step and len(t) > 1:
            out[rows] = smoothed(t, v, time_s[rows], row_step)
        else:
            out[rows] = interpolate(time_s[rows], t, v)
    return out


def held(samples: Signal, time_s: np.ndarray) -> np.ndarray:
    """Return a command held between samples, for rows at `time_s` (T,) as (T, C).

    A row gets the mean over its period, and NaN before the first sample and long after the last.
    """
    t, v = samples.time_s, samples.value
    last_sample = np.searchsorted(t, time_s, side="right") - 1
    out = v[np.clip(last_sample, 0, None)]
    # The command between its samples is constant, so its integral is a sum of rectangles.
    ends = np.append(time_s[1:], time_s[-1])
    changes = np.searchsorted(t, ends, side="left") - 1 > last_sample
    area = np.diff(t)[:, None] * v[:-1]
    integral_at_t = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(area, 0)])

    def integral(until_s: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(t, until_s, side="right") - 1, 0, None)
        return integral_at_t[k] + (until_s - t[k])[:, None] * v[k]

    rows = np.flatnonzero(changes & (last_sample >= 0))
    if len(rows):
        span = (ends - time_s)[rows, None]
        out[rows] = (integral(ends[rows]) - integral(time_s[rows])) / span
    age = time_s - t[np.clip(last_sample, 0, None)]
    longest_age_s = max(HOLD_S, 10.0 * median_step(t)) if len(t) > 1 else np.inf
    out[(last_sample < 0) | (age > longest_age_s)] = np.nan
    return out


def unchanged(samples: Signal, time_s: np.ndarray) -> np.ndarray:
    """Return the nearest sample for rows at `time_s` (T,) as (T, C), NaN in gaps."""
    index = nearest(samples.time_s, time_s)
    longest_s = max(GAP_S, GAP_STEPS * median_step(samples.time_s))
    is_near = np.abs(samples.time_s[index] - time_s) <= longest_s
    return np.where(is_near[:, None], samples.value[index], np.nan)


def turn_axes(signals: dict[str, Signal], name: str, to_world: bool) -> None:
    """Rotate a signal from body to world axes, or back, in place; drop what has no attitude."""
    time_s, value = signals.pop(name)
    if "quat" not in signals:
        return
    quat = measured(signals["quat"], time_s, smooth=True)
    known = np.isfinite(quat).all(axis=1)
    unit = quat[known] / np.linalg.norm(quat[known], axis=1, keepdims=True)
    if known.any():
        turned = rotate(unit if to_world else conjugate(unit), value[known])
        signals[name] = Signal(time_s[known], turned)


def continuous(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) with signs chosen so that they change continuously."""
    # A quaternion and its negative are the same attitude: avoid jumps between the two.
    flips = np.sum(quat_wxyz[1:] * quat_wxyz[:-1], axis=1) < 0
    sign = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    return quat_wxyz * sign[:, None]


def smoothed(t: np.ndarray, v: np.ndarray, query_s: np.ndarray, width_s: float) -> np.ndarray:
    """Return samples (N, C) at `t` (N,) smoothed by local parabolas, at `query_s` (M,): (M, C).

    A mean would flatten a curved signal (Savitzky and Golay 1964). Where fewer than three samples
    are in a window of `width_s`, they are interpolated linearly. All times in s.
    """
    first = np.searchsorted(t, query_s - 0.5 * width_s)
    count = np.searchsorted(t, query_s + 0.5 * width_s, side="right") - first
    # Least squares: sums of u^0 ... u^4, and of u^0 ... u^2 times the samples.
    moments, right_side = np.zeros((len(query_s), 5)), np.zeros((len(query_s), 3, v.shape[1]))
    for offset in range(int(count.max(initial=0))):
        k = np.minimum(first + offset, len(t) - 1)
        u = (t[k] - query_s) / (0.5 * width_s)
        powers = np.where((offset < count)[:, None], u[:, None] ** np.arange(5), 0.0)
        moments += powers
        right_side += powers[:, :3, None] * v[k][:, None, :]
    out = interpolate(query_s, t, v)
    enough = np.flatnonzero(count >= 3)
    normal = moments[enough][:, np.arange(3)[:, None] + np.arange(3)]
    out[enough] = np.linalg.solve(normal, right_side[enough])[:, 0]
    return out


def averaged(t: np.ndarray, v: np.ndarray, query_s: np.ndarray, width_s: float) -> np.ndarray:
    """Return moving averages (M, C), over `width_s` about `query_s` (M,), of samples (N, C) at `t`.

    Samples are interpolated linearly; near their ends the window shrinks about its centre. All
    times in s.
    """
    area = 0.5 * np.diff(t)[:, None] * (v[1:] + v[:-1])
    integral_at_t = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(area, axis=0)])
    half = np.minimum(0.5 * width_s, np.minimum(query_s - t[0], t[-1] - query_s))

    def integral(until_s: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(t, until_s, side="right") - 1, 0, len(t) - 2)
        since = (until_s - t[k])[:, None]
        slope = (v[k + 1] - v[k]) / (t[k + 1] - t[k])[:, None]
        return integral_at_t[k] + since * (v[k] + 0.5 * since * slope)

    # A window of no width, at an end of the samples, takes the value itself.
    width = np.where(half > 0, 2.0 * half, 1.0)[:, None]
    mean = (integral(query_s + half) - integral(query_s - half)) / width
    return np.where(half[:, None] > 0, mean, interpolate(query_s, t, v))
