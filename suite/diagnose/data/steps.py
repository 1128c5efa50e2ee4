"""Where the model's steps begin and end: at the rows of a log, whatever their spacing.

A row's command acts from its stamp on and the rate loop starts its period there, so every step lies
between two rows. Between them the loop looks about as often as the vehicle's own does, or every
`LONGEST_S` where that is rarer, and carries the rates on by what that leaves out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LONGEST_S = 0.002
"""A step is about so long at most [s]; the integrator's error over a second is far below noise."""
LOST = 1.75
"""Rows further apart than so many of their usual spacings have lost some between them."""


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
