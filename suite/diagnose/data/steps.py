"""Where the model's steps begin and end: at the rows of a log, whatever their spacing.

A row's command acts from its stamp on and the rate loop starts its period there, so every step lies
between two rows. Between them the loop looks about as often as the vehicle's own does, or every
`LONGEST_S` where that is rarer, and carries the rates on by what that leaves out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle

LONGEST_S = 0.002
"""A step is about so long at most [s]; the integrator's error over a second is far below noise."""
LOST = 1.75
"""Rows further apart than so many of their usual spacings have lost some between them."""

LEAST_START_ERROR = 1e-3
"""Rotor speeds at a window's start are never known better than this [rad/s]."""


class StepGrid(NamedTuple):
    """T steps one after the other."""

    edge_s: np.ndarray
    """(T + 1,) ends of steps [s]."""
    look_s: np.ndarray
    """(T,) until the rate loop's next look; 0 where it does not look at the step's start [s]."""
    lead_s: np.ndarray
    """(T,) by how much later than the steps' looks those of the vehicle are, on average [s]."""


def step_grid(row_s: np.ndarray, period_s: float, longest_s: float = LONGEST_S) -> StepGrid:
    """Return steps from the first to the last of `row_s` (R,), R >= 2.

    Args:
        row_s: times at which commands may change [s], increasing.
        period_s: of the rate loop, which starts anew at each row.
        longest_s: about the longest step.
    """
    row_s = np.asarray(row_s, dtype=float)
    spacing = np.diff(row_s)
    kept = _kept(row_s, 0.75 * longest_s)
    # The rates that the loop knows are old by this, as the mean over a row.
    whole = np.floor(spacing / period_s + 1e-6)
    rest = np.maximum(spacing - whole * period_s, 0.0)
    old = np.add.reduceat(0.5 * (whole * period_s**2 + rest**2), kept[:-1])
    length = np.diff(row_s[kept])
    looks = np.maximum(np.rint(length / max(period_s, longest_s)), 1).astype(int)
    hold = length / looks
    parts = np.maximum(np.rint(hold / longest_s), 1).astype(int)
    count = looks * parts
    of_row = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(of_row)) - np.repeat(np.cumsum(count) - count, count)
    edge_s = row_s[kept][of_row] + number * (length / count)[of_row]
    lead = 0.5 * hold - old / length
    return StepGrid(
        np.append(edge_s, row_s[-1]),
        np.where(number % parts[of_row] == 0, hold[of_row], 0.0),
        lead[of_row],
    )


def with_lost_rows(time_s: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `time_s` (R,) and `command` (R, K) with what was lost put in on a straight line.

    The vehicle was given a command at each row that was lost; holding the last one that is known
    would act a row late.
    """
    spacing = np.diff(time_s)
    if not len(spacing):
        return time_s, command
    usual = float(np.median(spacing))
    missing = np.where(spacing > LOST * usual, np.rint(spacing / usual) - 1.0, 0.0).astype(int)
    if not missing.any():
        return time_s, command
    count = missing + 1
    share = np.concatenate([np.arange(n) / n for n in count] + [[0.0]])
    before = np.append(np.repeat(np.arange(len(spacing)), count), len(spacing))
    after = np.minimum(before + 1, len(spacing))
    filled_s = time_s[before] + share * (time_s[after] - time_s[before])
    return filled_s, command[before] + share[:, None] * (command[after] - command[before])


def padded_grid(grid: StepGrid, count: int, at_front: bool = False) -> StepGrid:
    """Return `grid` with steps of no length, which move nothing, up to `count` steps."""
    missing = count - len(grid.look_s)
    ends = (missing, 0) if at_front else (0, missing)
    return StepGrid(
        np.pad(grid.edge_s, ends, mode="edge"),
        np.pad(grid.look_s, ends),
        np.pad(grid.lead_s, ends),
    )


def _kept(row_s: np.ndarray, shortest_s: float) -> np.ndarray:
    """Return the rows that end steps, first and last among them, `shortest_s` apart or more."""
    if len(row_s) < 3 or np.diff(row_s).min() >= shortest_s:
        return np.arange(len(row_s))
    kept = [0]
    for place in range(1, len(row_s) - 1):
        if row_s[place] - row_s[kept[-1]] >= shortest_s:
            kept.append(place)
    if len(kept) > 1 and row_s[-1] - row_s[kept[-1]] < shortest_s:
        kept.pop()
    return np.array([*kept, len(row_s) - 1])


def rotors_at(
    at_s: np.ndarray,
    time_s: np.ndarray,
    speed: np.ndarray,
    vehicle: Vehicle,
    smooth: bool,
    every: int = 1,
) -> np.ndarray:
    """Return rotor speeds (S, 4) at `at_s` (S,) [s] from `every` so many of each rotor's own rows.

    Between rows they run along the first-order response to one command. What a firmware's loop
    asks for changes all the time, by filtered slopes of rates: a `smooth` curve is nearer then.
    """
    columns = []
    for column in speed.T:
        good = np.flatnonzero(np.isfinite(column))[::every]
        if smooth:
            columns.append(CubicSpline(time_s[good], column[good])(at_s))
            continue
        row = np.clip(np.searchsorted(time_s[good], at_s, side="right") - 1, 0, len(good) - 2)
        before, after = good[row], good[row + 1]
        span, passed = time_s[after] - time_s[before], at_s - time_s[before]
        lag = max(vehicle.rotors.time_constant, 1e-4)
        share = (1.0 - np.exp(-passed / lag)) / (1.0 - np.exp(-span / lag))
        columns.append(column[before] + share * (column[after] - column[before]))
    return np.stack(columns, axis=1)


def start_rotor_error(time_s: np.ndarray, rate_b: np.ndarray, vehicle: Vehicle) -> float:
    """Return the RMS error [rad/s] of rotor speeds that follow commands at measured rates (N, 3).

    Between rows the rates are not known. By how far a line between every second row misses the row
    in the middle, the loop is asked for other rotor speeds; a line between neighbours misses by a
    quarter of it where rates are smooth and by about all of it where they are noise: half is taken.
    """
    if len(time_s) < 3:
        return LEAST_START_ERROR
    share = ((time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2]))[:, None]
    missed = rate_b[1:-1] - (rate_b[:-2] + share * (rate_b[2:] - rate_b[:-2]))
    missed = missed[np.isfinite(missed).all(axis=1)]
    if not len(missed):
        return LEAST_START_ERROR
    plant = make_plant(vehicle, LONGEST_S)
    hover = Command(np.full(4, GRAVITY), np.zeros((4, 3)))
    rates = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
    asked = np.asarray(wanted_speed(plant, hover, rates))
    error = 0.5 * missed @ ((asked[1:] - asked[0]) / 0.1)
    return max(float(np.sqrt((error**2).mean())), LEAST_START_ERROR)
