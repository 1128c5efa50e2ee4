"""Finds the time shift between the reference and the gyro, and moves the reference to gyro times.

The reference is a pose such as that of motion capture, in the same log as the gyro. It has its own
clock, and it may arrive with a varying delay. The shift between the two is modelled as a random
walk in time. The fit compares body rates by the reference's attitude with those of the gyro, and
finds the most probable path over a grid of shifts (Viterbi 1967). The on-board estimate is not
used. A shift that is not significant, or smaller than the time between two rows, is set to 0.

A flight has M blocks of time with a constant shift each, and S shifts are tried.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import convolve1d

from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import attitude_at, interpolate
from suite.diagnose.sensors.errors import rotation_between
from tracks.geometry.rotation import rot_to_quat

STEP_S = 0.01
"""Step of the grid of times on which rates are compared [s]."""
LARGEST_S, FINE_S = 0.25, 0.005
"""Largest shift that is tried, and the step between shifts [s]."""
BLOCK_S = 0.25
"""Length of a block; the shift is constant in it [s]."""
SPAN_ROWS = 6
"""Rates are means from this many grid steps before a time to as many after it."""
WANDERS = 0.03
"""Standard deviation of the change of the shift in one second [s]."""
ROUNDS = 3
"""Number of searches for the path; each uses the noise that the path before it leaves."""


class Clock(NamedTuple):
    """Shift between gyro and reference in one flight: by how much the gyro is later."""

    time_s: np.ndarray
    """(M,) middle of each block, on the gyro's clock [s]."""
    shift_s: np.ndarray
    """(M,) shift in each block [s]; all zeros if it is not significant."""


def clock_of(log: FlightLog) -> Clock:
    """Return the shift between the times of gyro and reference in a flight."""
    no_shift = Clock(np.zeros(1), np.zeros(1))
    grid = np.arange(log.time_s[0], log.time_s[-1], STEP_S)
    size = round(BLOCK_S / STEP_S)
    blocks = len(grid) // size
    if not blocks:
        return no_shift
    shifts_s = np.arange(-LARGEST_S, LARGEST_S + 0.5 * FINE_S, FINE_S)
    misfit, rows = _misfits(log, grid[: blocks * size], shifts_s, size)
    if not rows.any():
        return no_shift
    # Search for the most probable path. Costs are negative log-likelihoods: `cost` of a shift in a
    # block, and `change` from one shift to another in the next block.
    zero = len(shifts_s) // 2  # index of the shift 0
    path, all_blocks = np.full(blocks, zero), np.arange(blocks)
    change = (shifts_s[:, None] - shifts_s) ** 2 / (2.0 * WANDERS**2 * BLOCK_S)
    cost = misfit
    for _ in range(ROUNDS):
        variance = max(misfit[all_blocks, path].sum() / (3.0 * rows.sum()), 1e-12)
        # A rate is a mean over 2 * SPAN_ROWS grid steps, so only one of so many is independent.
        cost = misfit / (2.0 * variance * 2 * SPAN_ROWS)
        path = _most_probable(cost, change)
    gain = (cost[:, zero] - cost[all_blocks, path]).sum()
    shift_s = shifts_s[path]
    row_s = float(np.median(np.diff(log.time_s)))
    # By chance the log-likelihood rises by less than 1 for each block.
    if gain < blocks or np.sqrt((shift_s**2).mean()) < row_s:
        return no_shift
    return Clock(grid[: blocks * size].reshape(blocks, size).mean(axis=1), shift_s)


def _misfits(
    log: FlightLog, grid: np.ndarray, shifts_s: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of squared differences of the rates (M, S), and numbers of compared times (M,).

    They are for blocks of `size` of the times `grid`, and for each shift of `shifts_s` (S,) [s].
    """
    half_s = SPAN_ROWS * STEP_S
    rot_w = attitude_at(grid, log.time_s, log.quat_wxyz)
    turn = rotation_between(rot_w[: -2 * SPAN_ROWS], rot_w[2 * SPAN_ROWS :])
    reference = np.full((len(grid), 3), np.nan)
    reference[SPAN_ROWS:-SPAN_ROWS] = turn / (2.0 * half_s)
    # The mean rate of the gyro over the same span, by the trapezoidal rule.
    gyro = interpolate(grid, log.time_s, log.rate_b, holes=True)
    weight = np.append(0.5, np.append(np.ones(2 * SPAN_ROWS - 1), 0.5)) / (2 * SPAN_ROWS)
    mean = convolve1d(gyro, weight, axis=0, mode="constant", cval=np.nan)
    known = np.isfinite(mean + reference).all(axis=1)
    if known.any():
        mean -= np.median((mean - reference)[known], axis=0)  # bias of the gyro
    squares = np.empty((len(grid), len(shifts_s)))
    for k, shift_s in enumerate(shifts_s.tolist()):
        then = np.stack([np.interp(grid - shift_s, grid, axis) for axis in reference.T], axis=1)
        squares[:, k] = ((mean - then) ** 2).sum(axis=1)
        known &= np.isfinite(squares[:, k])
    squares[~known] = 0.0
    return squares.reshape(-1, size, len(shifts_s)).sum(axis=1), known.reshape(-1, size).sum(axis=1)


def _most_probable(cost: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the path of least cost: the index of the shift in each block, (M,).

    `cost` (M, S) is that of a shift in a block, `change` (S, S) that of another in the next block.
    """
    # Forward: the least cost of a path to each shift, and the shift in the block before it.
    total, origins = cost[0], list[np.ndarray]()
    for block_cost in cost[1:]:
        reached = total[:, None] + change
        origins.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + block_cost
    # Backward: from the best last shift through the shifts before it.
    path = [int(total.argmin())]
    for origin in reversed(origins):
        path.append(int(origin[path[-1]]))
    return np.array(path[::-1])


def on_gyro_clock(log: FlightLog, clock: Clock) -> FlightLog:
    """Return the flight with pose and velocity of the reference moved to the gyro's times."""
    if not clock.shift_s.any():
        return log
    reference_s = log.time_s - np.interp(log.time_s, *clock)
    return replace(
        log,
        pos_w=interpolate(reference_s, log.time_s, log.pos_w, holes=True),
        quat_wxyz=rot_to_quat(attitude_at(reference_s, log.time_s, log.quat_wxyz)),
        vel_w=interpolate(reference_s, log.time_s, log.vel_w, holes=True),
    )
