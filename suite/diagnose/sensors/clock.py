"""The reference's clock against the gyro's, and the reference at the gyro's times.

Motion capture and telemetry have clocks of their own, and telemetry arrives with a varying delay.
The shift between them is modelled as a random walk in time. It is the most probable path over a
grid of shifts (Viterbi 1967) that makes the rates of the reference's attitude match the gyro's. The
on-board estimate is not used. A shift that is not significant, or smaller than a row, is set to 0.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.identify.grid import attitude_at, interpolated
from suite.diagnose.sensors.errors import rotation_between
from tracks.geometry.rotation import rot_to_quat

STEP_S = 0.01
"""Of the grid of times [s]."""
LARGEST_S, FINE_S = 0.25, 0.005
"""Largest shift that is tried, and the steps between shifts [s]."""
BLOCK_S = 0.25
"""A shift is constant over this time [s]."""
SPAN_ROWS = 6
"""Rates are means over so many grid steps before and after."""
WANDERS = 0.03
"""Standard deviation of the shift's change in a second [s]."""
ROUNDS = 3
"""Of the path, each with the noise of the one before."""


class Clock(NamedTuple):
    """How far the gyro's times are behind the reference's in one flight."""

    time_s: np.ndarray
    """(M,)."""
    shift_s: np.ndarray
    """(M,) all zeros where no shift is significant."""

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Return the shift [s] at the gyro's times (T,)."""
        return np.interp(time_s, self.time_s, self.shift_s)


def clock_of(log: FlightLog) -> Clock:
    """Return the shift between the gyro's times and the reference's in a flight."""
    none = Clock(np.zeros(1), np.zeros(1))
    grid = np.arange(log.time_s[0], log.time_s[-1], STEP_S)
    size = round(BLOCK_S / STEP_S)
    blocks = len(grid) // size
    quat_there = np.isfinite(log.quat_wxyz).all(axis=1).sum() > 1
    if not blocks or not quat_there or not (np.isfinite(log.rate_b).sum(axis=0) > 1).all():
        return none
    shifts_s = np.arange(-LARGEST_S, LARGEST_S + 0.5 * FINE_S, FINE_S)
    misfit, rows = _misfits(log, grid[: blocks * size], shifts_s, size)
    if not rows.any():
        return none
    still = len(shifts_s) // 2
    path, every = np.full(blocks, still), np.arange(blocks)
    change = (shifts_s[:, None] - shifts_s) ** 2 / (2.0 * WANDERS**2 * BLOCK_S)
    cost = misfit
    for _ in range(ROUNDS):
        variance = max(misfit[every, path].sum() / (3.0 * rows.sum()), 1e-12)
        # Rates that are means over several rows are independent that far apart only.
        cost = misfit / (2.0 * variance * 2 * SPAN_ROWS)
        path = _most_probable(cost, change)
    gain = (cost[:, still] - cost[every, path]).sum()
    shift_s = shifts_s[path]
    row_s = float(np.median(np.diff(log.time_s)))
    # Chance gives a gain of the log-likelihood below 1 a block.
    if gain < blocks or np.sqrt((shift_s**2).mean()) < row_s:
        return none
    return Clock(grid[: blocks * size].reshape(blocks, size).mean(axis=1), shift_s)


def _misfits(
    log: FlightLog, grid: np.ndarray, shifts_s: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return squared rate differences (M, S) of blocks at shifts, and the blocks' rows (M,)."""
    half_s = SPAN_ROWS * STEP_S
    rot_w = attitude_at(log.time_s, log.quat_wxyz, grid)
    turn = rotation_between(rot_w[: -2 * SPAN_ROWS], rot_w[2 * SPAN_ROWS :])
    reference = np.full((len(grid), 3), np.nan)
    reference[SPAN_ROWS:-SPAN_ROWS] = turn / (2.0 * half_s)
    gyro = interpolated(log.time_s, log.rate_b, grid)
    angle = np.cumsum(np.nan_to_num(gyro), axis=0) * STEP_S
    # The trapezoidal rule; half of the first row, which is too much, cancels in differences.
    angle = angle - 0.5 * STEP_S * np.nan_to_num(gyro)
    mean = np.full_like(gyro, np.nan)
    mean[SPAN_ROWS:-SPAN_ROWS] = (angle[2 * SPAN_ROWS :] - angle[: -2 * SPAN_ROWS]) / (2.0 * half_s)
    mean[~np.isfinite(gyro)] = np.nan
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
    """Return the path (M,) of least cost: `cost` (M, S) of each state, `change` (S, S) between."""
    total, before = cost[0], list[np.ndarray]()
    for own in cost[1:]:
        reached = total[:, None] + change
        before.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + own
    path = [int(total.argmin())]
    for origin in reversed(before):
        path.append(int(origin[path[-1]]))
    return np.array(path[::-1])


def on_gyro_clock(log: FlightLog, clock: Clock) -> FlightLog:
    """Return the flight with the reference's pose and velocity at the gyro's times."""
    if not clock.shift_s.any():
        return log
    then = log.time_s - clock.at(log.time_s)
    return replace(
        log,
        pos_w=interpolated(log.time_s, log.pos_w, then),
        quat_wxyz=rot_to_quat(attitude_at(log.time_s, log.quat_wxyz, then)),
        vel_w=interpolated(log.time_s, log.vel_w, then),
    )
