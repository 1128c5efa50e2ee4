"""How the gyro follows commanded body rates: delay, gain, and change of the gain with the command.

The gain is the measured rate over the commanded one. The *rate loop* is the controller that makes
the body follow a commanded rate; it is modelled as a delay and a second-order filter.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from eval.logs.faults.pose import CALM_RATE, WIDTH_S
from eval.logs.faults.relation import CLEAR, interpolate, shift_rows, smooth

REACH_S, STEP_S = 0.3, 0.01
"""Largest delay that is tried, and the step between trials [s]."""
STEADY_S = 0.1
"""A command is steady if it changes little between this long before and after a row [s]."""
LOOP_HZ = (1.2, 2.0, 3.0, 4.5, 7.0, 12.0)
"""Natural frequencies of a rate loop that are tried [Hz] ..."""
DAMPING = (0.5, 0.7, 1.0, 1.5)
"""... and damping ratios that are tried."""
LOOP_LATE_S = (0.0, 0.02, 0.04, 0.06, 0.09, 0.13)
"""Delays before the loop that are tried [s]."""
EXPLAINED = 0.9
"""Share of the measured rate's variance that the fitted rate loop must explain for its gain to be
reliable."""


def delayed(time_s: np.ndarray, command: np.ndarray, rate: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the delay [s] with the best correlation of command and rate, and the delayed command.

    The command (T, 3) is also averaged over `WIDTH_S`; `rate` (T, 3) must already be averaged. If
    another order of the command's axes correlates clearly better, the delay is that of this order.
    """
    step = float(np.median(np.diff(time_s)))
    value = smooth(time_s, command, WIDTH_S)
    has_value, has_rate = (np.asarray(np.isfinite(x).all(axis=1)) for x in (value, rate))
    best: dict[tuple[int, ...], tuple[float, int]] = {}
    for late in np.arange(0.0, REACH_S + 1e-9, max(STEP_S, step)):
        count = round(late / step)
        before, after = slice(max(0, len(value) - count)), slice(count, None)
        both = has_value[before] & has_rate[after]
        if both.sum() < 30:
            break
        # Correlation of each axis, weighted by how much the axis turns.
        a, b = value[before][both].T, rate[after][both].T
        a, b = (part - part.mean(axis=1, keepdims=True) for part in (a, b))
        size_a, size_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        shares = (size_b / size_b.sum())[:, None]
        correlations = shares * np.abs(b @ a.T) / np.maximum(np.outer(size_b, size_a), 1e-12)
        table = correlations.tolist()
        for order in permutations(range(3)):
            score = sum(row[k] for row, k in zip(table, order, strict=True))
            if score > best.get(order, (-1.0,))[0] + 1e-6:
                best[order] = score, count
    order = max(best, key=lambda o: best[o][0] + CLEAR * (o == (0, 1, 2)), default=None)
    count = 0 if order is None else best[order][1]
    return count * step, shift_rows(value, count)


def bend(time_s: np.ndarray, command: np.ndarray, rate: np.ndarray) -> float:
    """Return by what share the gain of large commands exceeds the gain of small commands.

    Only steady commands count, since the body never reaches a large command that is short. The
    result is the smallest share over the axes that turn and over both halves of the flight. It is 0
    where one of these has too few commands, or a smaller gain for large commands than for small
    ones (motors at their limits).
    """
    both = np.isfinite(command).all(axis=1) & np.isfinite(rate).all(axis=1)
    time_s, command, rate = time_s[both], command[both], rate[both]
    command_before, command_after = (
        interpolate(time_s + shift, time_s, command) for shift in (-STEADY_S, STEADY_S)
    )
    steady = np.abs(command_after - command_before) < 0.3 * np.abs(command)
    middle = len(time_s) // 2
    limits = np.quantile(np.abs(command), 0.9, axis=0)
    bends = []
    for axis in np.flatnonzero(limits > 3.0 * CALM_RATE):
        for half_rows in (slice(None, middle), slice(middle, None)):
            used = steady[half_rows, axis]
            c, r = command[half_rows, axis][used], rate[half_rows, axis][used]
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
    """Return the gain at low frequency (median of the axes), and how far the axes' gains differ.

    The second value is the largest gain of an axis over the smallest. The result is None where no
    axis has a reliable gain.

    A correct rate loop has a gain of 1 at low frequency. Most commands are too short for a steady
    rate, so the gain is fitted together with a delay and a second-order filter.

    Args:
        time_s: (T,) time [s].
        command: (T, 3) commanded body rates [rad/s].
        rate: (T, 3) body rates of the gyro [rad/s].
    """
    from scipy.signal import bilinear, lfilter

    known = np.isfinite(command).all(axis=1) & np.isfinite(rate).all(axis=1)
    step = float(np.median(np.diff(time_s)))
    if known.sum() < 200:
        return None
    # Both signals on even steps, and only the axes that are commanded to turn.
    grid = np.arange(time_s[known][0], time_s[known][-1], step)
    command, rate = (interpolate(grid, time_s[known], v[known]) for v in (command, rate))
    axes = np.flatnonzero(command.std(axis=0) > CALM_RATE)
    if not len(axes):
        return None
    command, rate = command[:, axes], rate[:, axes] - rate[:, axes].mean(axis=0)
    least_residual, gains = np.full(len(axes), np.inf), np.zeros(len(axes))
    # Try every loop on a grid, and keep each axis' best gain. The first 0.5 s do not count: the
    # filter starts there.
    settled = slice(min(round(0.5 / step), len(grid) // 4), None)
    for hz, ratio in product(LOOP_HZ, DAMPING):
        omega = 2.0 * np.pi * hz
        top, bottom = bilinear([omega**2], [1.0, 2.0 * ratio * omega, omega**2], 1.0 / step)
        # The filter is at rest before the first command, so that a later command is filtered alike.
        filtered = np.asarray(lfilter(top, bottom, command - command[0], axis=0))
        for late_s in LOOP_LATE_S:
            count = min(round(late_s / step), len(grid))
            rest = np.zeros((count, len(axes)))
            wanted = np.concatenate([rest, filtered])[: len(grid)][settled]
            wanted = wanted - wanted.mean(axis=0)
            # The filtered command may be constant in these rows.
            squares = np.maximum(np.sum(wanted**2, axis=0), 1e-12)
            gain = np.sum(wanted * rate[settled], axis=0) / squares
            residual = np.sum((rate[settled] - gain * wanted) ** 2, axis=0)
            gains = np.where(residual < least_residual, gain, gains)
            least_residual = np.minimum(residual, least_residual)
    reliable = least_residual < (1.0 - EXPLAINED) * np.sum(rate[settled] ** 2, axis=0)
    if not reliable.any() or (gains[reliable] <= 0.0).any():
        return None
    logs = np.log(gains[reliable])
    return float(np.exp(np.median(logs))), float(np.exp(np.ptp(logs)))
