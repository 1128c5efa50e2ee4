"""How a gyro follows commanded rates: delay, gain at low frequency, and bend of the gain."""

from __future__ import annotations

from itertools import product

import numpy as np

from eval.logs.faults.pose import CALM_RATE, WIDTH_S
from eval.logs.faults.relation import smooth

REACH_S, STEP_S = 0.3, 0.01
"""Largest delay that is tried, and the step between trials [s]."""
STEADY_S = 0.1
"""Time before and after within which a steady command changes little [s]."""
LOOP_HZ = (1.2, 2.0, 3.0, 4.5, 7.0, 12.0)
"""Natural frequencies of a rate loop that are tried [Hz] ..."""
DAMPING = (0.5, 0.7, 1.0, 1.5)
"""... and its damping ratios."""
LOOP_LATE_S = (0.0, 0.02, 0.04, 0.06, 0.09, 0.13)
"""Delays before the loop that are tried [s]."""
EXPLAINED = 0.9
"""Least share of a rate's variance that a loop explains, for its gain to be reliable."""


def delayed(time_s: np.ndarray, command: np.ndarray, rate: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the delay [s] with the best correlation of command and rates, and that command."""
    step = float(np.median(np.diff(time_s)))
    value = smooth(time_s, command, WIDTH_S)
    best, delay, kept = -1.0, 0.0, value
    for late in np.arange(0.0, REACH_S + 1e-9, max(STEP_S, step)):
        count = round(late / step)
        moved = np.full_like(value, np.nan)
        moved[count:] = value[: len(value) - count]
        both = np.isfinite(moved).all(axis=1) & np.isfinite(rate).all(axis=1)
        if both.sum() < 30:
            break
        a, b = moved[both] - moved[both].mean(axis=0), rate[both] - rate[both].mean(axis=0)
        size = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
        alike = float(
            np.sum(b.std(axis=0) * np.abs(np.sum(a * b, axis=0)) / np.maximum(size, 1e-12))
        )
        if alike > best + 1e-6:
            best, delay, kept = alike, float(late), moved
    return delay, kept


def bend(time_s: np.ndarray, command: np.ndarray, rate: np.ndarray) -> float:
    """Return by what share the gain of large commands exceeds that of small ones.

    Only commands that hardly change within the loop's response count, since the body never reaches
    short large ones. The result is the least over moving axes and both halves of the flight. It is
    0 where one of them has too few commands, or less gain for large ones (motors at their limits).
    """
    both = np.isfinite(command).all(axis=1) & np.isfinite(rate).all(axis=1)
    time_s, command, rate = time_s[both], command[both], rate[both]
    before, after = (
        np.column_stack([np.interp(time_s + shift, time_s, c) for c in command.T])
        for shift in (-STEADY_S, STEADY_S)
    )
    steady, half = np.abs(after - before) < 0.3 * np.abs(command), len(time_s) // 2
    limits = np.quantile(np.abs(command), 0.9, axis=0)
    bends = []
    for axis in np.flatnonzero(limits > 3.0 * CALM_RATE):
        for part in (slice(None, half), slice(half, None)):
            c, r = command[part, axis][steady[part, axis]], rate[part, axis][steady[part, axis]]
            share = np.abs(c) / limits[axis]
            large, small = share > 0.6, (share > 0.15) & (share < 0.4)
            if min(large.sum(), small.sum()) < 30:
                return 0.0
            slopes = [float(np.median(r[m] / c[m])) for m in (large, small)]
            bends.append(slopes[0] / slopes[1] - 1.0 if slopes[1] > 0.0 else 0.0)
    return max(0.0, min(bends, default=0.0))


def loop_gain(
    time_s: np.ndarray, command: np.ndarray, rate: np.ndarray
) -> tuple[float, float] | None:
    """Return by which factor the gyro exceeds a steady rate command, and the ratio between axes.

    The second is the largest gain of an axis over the smallest. None where no axis shows it.

    A rate loop has a gain of 1 at low frequency. The gain is fitted with a delay and a loop of
    second order, as most commands are too short for a steady rate.

    Args:
        time_s: (T,) [s].
        command: (T, 3) commanded body rates [rad/s].
        rate: (T, 3) of the gyro [rad/s].
    """
    from scipy.signal import bilinear, lfilter

    known = np.isfinite(command).all(axis=1) & np.isfinite(rate).all(axis=1)
    step = float(np.median(np.diff(time_s)))
    if known.sum() < 200:
        return None
    grid = np.arange(time_s[known][0], time_s[known][-1], step)
    command, rate = (
        np.column_stack([np.interp(grid, time_s[known], column) for column in value[known].T])
        for value in (command, rate)
    )
    axes = np.flatnonzero(command.std(axis=0) > CALM_RATE)
    if not len(axes):
        return None
    command, rate = command[:, axes], rate[:, axes] - rate[:, axes].mean(axis=0)
    least, gains = np.full(len(axes), np.inf), np.zeros(len(axes))
    settled = slice(min(round(0.5 / step), len(grid) // 4), None)
    for hz, ratio, late_s in product(LOOP_HZ, DAMPING, LOOP_LATE_S):
        omega, count = 2.0 * np.pi * hz, round(late_s / step)
        filters = bilinear([omega**2], [1.0, 2.0 * ratio * omega, omega**2], 1.0 / step)
        late = np.concatenate([np.repeat(command[:1], count, axis=0), command])[: len(grid)]
        wanted = np.asarray(lfilter(*filters, late - command[0], axis=0))[settled]
        wanted = wanted - wanted.mean(axis=0)
        gain = np.sum(wanted * rate[settled], axis=0) / np.sum(wanted**2, axis=0)
        left = np.sum((rate[settled] - gain * wanted) ** 2, axis=0)
        gains = np.where(left < least, gain, gains)
        least = np.minimum(left, least)
    sure = least < (1.0 - EXPLAINED) * np.sum(rate[settled] ** 2, axis=0)
    if not sure.any() or (gains[sure] <= 0.0).any():
        return None
    logs = np.log(gains[sure])
    return float(np.exp(np.median(logs))), float(np.exp(np.ptp(logs)))
