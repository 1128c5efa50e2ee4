"""Check time stamps: their unit, pauses, and jitter.

Stamps of the arrival of messages jitter, while the signal was sampled evenly. A measured path is
smooth in the times of its measurement. If it is smoother in even times than in those of the stamps,
the stamps jitter. A sampling that is really uneven makes it less smooth. Messages may also arrive
in bursts of a few; a sample is then compared with samples outside its burst. Errors of stamps that
last longer than a burst are those of a sampling whose rate changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d

from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import Rows
from eval.logs.faults.reading import TIMES, option

PAUSE_S = 5.0
"""After a longer pause there may be another flight [s]."""
CUT = "if another flight follows, cut it off with --end of suite import"
"""What to do about a pause."""
STEPS_S = (5e-5, 0.25)
"""Possible time between rows of a log [s]."""
LEAST_S = 5e-4
"""Least jitter that is a fault, root mean square [s]."""
SMOOTHER = 0.7
"""Even times must lower the squared roughness of a signal to this share."""
LEAST_ROWS, FIRST = 100, 32
"""Least number of samples for the test, and number of those that the clock is first fitted to."""
BLOCKS, LEAST_BLOCKS = 8, 7
"""Number of parts of a flight, and in how many of them even times must be smoother."""
BURST, LASTS = 16, 0.45
"""Number of samples over which the errors of arrival cancel, and the largest share of the errors
that may remain in a mean over them. Where more remains, the rate of the sampling changed."""
WANDER_S = 1.0
"""Time over which the true sampling may wander against a constant rate [s]."""
STRIDES = (1, 2, 3)
"""Distances between compared samples. Within a burst, and at distances that are multiples of its
length, samples seem to be even."""
MOST_ROUGH = 0.9
"""Quantile of the roughness above which samples count as outliers."""
MEASURED = ("pos", "quat", "vel", "rate")
"""Signals by which stamps are tested."""
FIX = "suite import of the log that it was made of spaces the stamps evenly"


def check_time(rows: Rows, fastest: float | None = None) -> list[Finding]:
    """Return a finding where the time between rows is impossible in seconds.

    `time` (T,) is that of the slowest signal. `fastest` is the time between samples of the fastest,
    in the same unit; None: of the rows.
    """
    step = float(np.median(np.diff(rows["time"])))
    fastest, (low, high) = step if fastest is None else fastest, STEPS_S

    def fitting(*steps: float) -> list[str]:
        return [u for u, factor in TIMES.items() if all(low <= s * factor <= high for s in steps)]

    # A signal may be slower than any row, so the fastest one decides where no unit fits both.
    possible_units = fitting(step, fastest) or fitting(fastest)
    if "s" in possible_units:
        return []
    figures = f"rows are {step:.3g} apart, which is no distance in s"
    if len(possible_units) != 1:
        return [Finding("doubt", "time", f"{figures}, ms, us or ns", "time_unit", step, 0.95)]
    text = f"{figures}: time is in {possible_units[0]}"
    return [Finding("corrected", "time", text, "time_unit", 1.0 / TIMES[possible_units[0]], 0.99,
                    option(("time", possible_units[0])))]  # fmt: skip


def check_pause(time_s: np.ndarray) -> list[Finding]:
    """Return a note on the longest pause between the rows of a log at `time_s` (T,) [s]."""
    steps = np.diff(time_s)
    if np.max(steps, initial=0.0) <= PAUSE_S:
        return []
    k = int(np.argmax(steps))
    text = f"none for {steps[k]:.3g} s after t = {time_s[k]:.2f} s: {CUT}"
    return [Finding("note", "rows", text)]


def check_stamps(rows: Rows) -> list[Finding]:
    """Return the finding on stamps that jitter; none if they do not."""
    even_s = even_stamps(rows["time"], measured_in(rows))
    return [] if even_s is None else [finding_of(rows["time"], even_s, "all signals", FIX)]


def with_even_stamps(rows: Rows) -> dict[str, np.ndarray]:
    """Return the rows with their times spaced evenly, if their stamps jitter."""
    even_s = even_stamps(rows["time"], measured_in(rows))
    return dict(rows) if even_s is None else {**rows, "time": even_s}


def measured_in(signals: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Return the values (T, C) of the signals that show how even the sampling was."""
    return [signals[name] for name in MEASURED if name in signals]


def finding_of(time_s: np.ndarray, even_s: np.ndarray, names: str, fix: str = "") -> Finding:
    """Return the finding on stamps `time_s` (T,) of signals that were sampled at `even_s` (T,).

    `names` are those of the signals. Without a `fix` (what to do) the stamps are corrected.
    """
    jitter = jitter_s(time_s, even_s)
    text = (
        f"stamps of {names} jitter by {1e3 * jitter:.1f} ms: the motion is smooth in evenly spaced "
        "times"
    )
    return Finding("doubt" if fix else "corrected", "time", text, "clock_jitter", jitter, 0.95, fix)


def jitter_s(time_s: np.ndarray, even_s: np.ndarray) -> float:
    """Return the root mean square of the stamps' errors [s]."""
    return float(np.std(time_s - even_s))


def even_stamps(time_s: np.ndarray, signals: Sequence[np.ndarray]) -> np.ndarray | None:
    """Return the even times (T,) [s] of `signals` (T, C) whose stamps `time_s` (T,) jitter.

    None if the stamps do not jitter by `LEAST_S`, or no signal shows that the sampling is even.
    """
    if len(time_s) < LEAST_ROWS:
        return None
    best, least = None, SMOOTHER
    for number in (np.arange(len(time_s)), _number_with_lost(time_s)):
        even_s = _even(time_s, number)
        jitter = jitter_s(time_s, even_s)
        if jitter < LEAST_S or np.min(np.diff(even_s)) <= 0.0:
            continue
        if np.std(uniform_filter1d(time_s - even_s, BURST)) > LASTS * jitter:
            continue
        shares = [_share(time_s, even_s, x, stride) for x in signals for stride in STRIDES]
        share = min(shares, default=1.0)
        if share < least:
            best, least = even_s, share
    return best


def _number_with_lost(time_s: np.ndarray) -> np.ndarray:
    """Return the number (T,) of each sample, counting lost ones, by a clock of constant rate.

    The clock is fitted to ever more samples, so that its error stays far below a row.
    """
    count = FIRST
    step_s = float(np.median(time_s[count:] - time_s[:-count])) / count
    start_s = float(np.median(time_s[:count] - step_s * np.arange(count)))
    while True:
        number = np.round((time_s[:count] - start_s) / step_s)
        if count == len(time_s) or not np.ptp(number):
            return number if count == len(time_s) else np.arange(len(time_s))
        step_s, start_s = np.polyfit(number, time_s[:count], 1)
        count = min(2 * count, len(time_s))


def _even(time_s: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return times (T,) that grow evenly with the samples' `number` (T,), or wander slowly."""
    step_s, start_s = np.polyfit(number, time_s, 1)
    line_s = start_s + step_s * number
    size = int(np.clip(round(0.5 * WANDER_S / step_s), 3, len(number)))
    wander_s = time_s - line_s
    for _ in range(2):  # once leaves ripples of bursts
        wander_s = uniform_filter1d(wander_s, size, mode="mirror")
    return line_s + wander_s


def _share(time_s: np.ndarray, even_s: np.ndarray, signal: np.ndarray, stride: int) -> float:
    """Return the squared roughness of `signal` (T, C) in even times, as a share of that as stamped.

    Compared samples are `stride` samples apart. It is 1 if even times are not smoother in nearly
    all parts of the flight.
    """
    rough = np.stack([_roughness(at_s, signal, stride) for at_s in (time_s, even_s)])
    reach = 4 * stride
    is_whole = even_s[reach:] - even_s[:-reach] < 2.0 * reach * np.median(np.diff(even_s))
    usual = np.isfinite(rough).all(axis=0) & is_whole
    if usual.sum() < LEAST_ROWS // 2:
        return 1.0
    rough = rough[:, usual]
    rough = rough[:, rough[0] <= np.quantile(rough[0], MOST_ROUGH)]
    parts = np.array([part.sum(axis=1) for part in np.array_split(rough, BLOCKS, axis=1)])
    if (parts[:, 1] < parts[:, 0]).sum() < LEAST_BLOCKS:
        return 1.0
    return float(rough[1].sum() / max(rough[0].sum(), 1e-300))


def _roughness(time_s: np.ndarray, signal: np.ndarray, stride: int) -> np.ndarray:
    """Return the squared distance of each sample from the cubic through its neighbours.

    Neighbours are `stride` samples apart, and the result is (T - 4 * stride,). It is divided by its
    expectation for white noise, which is larger where times are uneven.
    """
    window, reach = np.lib.stride_tricks.sliding_window_view, 4 * stride + 1
    at_s, value = window(time_s, reach)[:, ::stride], window(signal, reach, axis=0)[..., ::stride]
    others, predicted, gain = (0, 1, 3, 4), 0.0, 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        for j in others:
            weight = np.ones(len(at_s))
            for k in others:
                if k != j:
                    weight = weight * (at_s[:, 2] - at_s[:, k]) / (at_s[:, j] - at_s[:, k])
            predicted = predicted + weight[:, None] * value[:, :, j]
            gain = gain + weight**2
        return np.sum((value[:, :, 2] - predicted) ** 2, axis=1) / gain
