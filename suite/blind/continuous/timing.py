"""A flight's conditions, and when things happen: rows, rate loop ticks, late commands, and steps.

Every event is the end of a step, so that nothing jumps inside one. The steps of N flights are laid
side by side row by row; a flight with fewer steps between two rows waits in steps of no length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

STEP_S = 1e-3
"""Longest step [s]."""
SAME_S = 1e-9
"""Events nearer than this are one [s]."""


class Schedule(NamedTuple):
    """R rows and S steps of N flights."""

    stamp_s: np.ndarray
    """(R + 1, N) when each row is measured and its command given; the last entry ends the flight
    [s]."""
    block: np.ndarray
    """(R + 1,) the first step from each row on."""
    start_s: np.ndarray
    """(S, N) of each step [s]."""
    length_s: np.ndarray
    """(S, N) [s]."""
    is_tick: np.ndarray
    """(S, N) whether the rate loop measures at the start of the step."""
    acting: np.ndarray
    """(S, N) the row whose command acts in the step; -1 before the first."""


def jittered_stamps(
    rng: np.random.Generator, count: int, start_s: float, end_s: float, rate_hz: float,
    jitter: float,
) -> np.ndarray:  # fmt: skip
    """Return the stamps (R + 1, N) of rows from `start_s` past `end_s` [s].

    Rows are nominally 1 / rate apart, with one at 0, which does not jitter; the others do by up to
    `jitter` of a row, evenly.
    """
    period = 1.0 / rate_hz
    number = np.arange(int(np.ceil(start_s / period)), int(np.ceil(end_s / period)) + 2)
    off = jitter * rng.uniform(-1.0, 1.0, (len(number), count))
    off[number == 0] = 0.0
    return (number[:, None] + off) * period


def schedule(
    stamp_s: np.ndarray, loop_s: float, delay_s: float, step_s: float = STEP_S
) -> Schedule:
    """Return the steps of flights with rows at `stamp_s` (R + 1, N).

    Args:
        stamp_s: when rows are measured [s].
        loop_s: period of the rate loop, which starts anew at every row [s].
        delay_s: by which commands act late [s].
        step_s: longest step [s].
    """
    flights = [_one(stamps, loop_s, delay_s, step_s) for stamps in stamp_s.T]
    rows = len(stamp_s) - 1
    counts = np.stack([np.bincount(row, minlength=rows) for row, *_ in flights], axis=1)
    most = counts.max(axis=1)
    block = np.concatenate([[0], np.cumsum(most)])
    # What waits, waits at the end of its row.
    ends = np.repeat(stamp_s[1:], most, axis=0)
    parts = [ends, np.zeros_like(ends), np.zeros(ends.shape, bool), np.zeros(ends.shape, int)]
    for index, (row, start, length, tick, acting) in enumerate(flights):
        first = np.concatenate([[0], np.cumsum(counts[:-1, index])])
        at = block[row] + np.arange(len(row)) - first[row]
        for part, values in zip(parts, (start, length, tick, acting), strict=True):
            part[at, index] = values
        idle = np.ones(len(ends), bool)
        idle[at] = False
        before = np.maximum.accumulate(np.where(idle, 0, np.arange(len(ends))))
        parts[3][idle, index] = parts[3][before[idle], index]
    return Schedule(stamp_s, block, *parts)


def _one(
    stamps: np.ndarray, loop_s: float, delay_s: float, step_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return of one flight's steps: row, start, length, whether the loop ticks, acting row."""
    span = np.diff(stamps)
    ticks = np.maximum(np.ceil(span / loop_s - SAME_S / loop_s), 1.0).astype(int)
    first = np.concatenate([[0], np.cumsum(ticks)])[:-1]
    rank = np.arange(ticks.sum()) - np.repeat(first, ticks)
    tick_s = np.repeat(stamps[:-1], ticks) + rank * loop_s
    late_s = stamps[:-1] + delay_s
    late_s = late_s[late_s < stamps[-1]]
    after = np.searchsorted(tick_s, late_s)
    gap = np.minimum(
        np.abs(late_s - tick_s[np.maximum(after - 1, 0)]),
        np.abs(late_s - tick_s[np.minimum(after, len(tick_s) - 1)]),
    )
    event_s = np.concatenate([tick_s, late_s[gap > SAME_S]])
    is_tick = np.arange(len(event_s)) < len(tick_s)
    order = np.argsort(event_s, kind="stable")
    event_s, is_tick = event_s[order], is_tick[order]
    whole = np.diff(np.append(event_s, stamps[-1]))
    pieces = np.maximum(np.ceil(whole / step_s - 1e-6), 1.0).astype(int)
    begin = np.concatenate([[0], np.cumsum(pieces)])[:-1]
    rank = np.arange(pieces.sum()) - np.repeat(begin, pieces)
    length = np.repeat(whole / pieces, pieces)
    start = np.repeat(event_s, pieces) + rank * length
    row = np.searchsorted(stamps[:-1], start + SAME_S, side="right") - 1
    acting = np.searchsorted(stamps[:-1] + delay_s, start + SAME_S, side="right") - 1
    return row, start, length, np.repeat(is_tick, pieces) & (rank == 0), acting


LOOP_HZ = (200.0, 2000.0)
"""Rate loops run at these or between them."""
ROW_HZ = (50.0, 1000.0)
"""Rows come at these or between them, and no faster than the loop that they start."""
USUAL_LOOPS = (200.0, 250.0, 400.0, 500.0, 800.0, 1000.0, 1600.0, 2000.0)
"""Half of the cases have one of these."""
USUAL_ROWS = (50.0, 100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0)
"""Half of the cases have one of these, as far as the loop is fast enough."""
JITTER = 0.3
"""Largest jitter of a stamp, in rows."""
CLOCK_S = 1e-4
"""Largest error of a logged stamp [s]."""
DROPPED = 0.01
"""Largest share of rows that the log lacks."""
COLOUR_S = (0.02, 0.2)
"""Correlation times of an estimator's errors [s]."""


@dataclass(frozen=True)
class Conditions:
    """Of one case; the answer holds them."""

    loop_hz: float
    """Of the rate loop; the vehicle file says it."""
    row_hz: float
    """Nominal, of commands and rows."""
    jitter: float
    """Of the true stamps, evenly to both sides, in rows."""
    clock_s: float
    """Error of a logged stamp, evenly to both sides [s]."""
    dropped: float
    """Share of rows that the log lacks; their commands acted."""
    coloured: float
    """Share of the slow noise of poses and velocities that is first-order Gauss-Markov; the rest is
    white."""
    colour_s: float
    """Its correlation time [s]."""


def draw_conditions(rng: np.random.Generator) -> Conditions:
    """Return the conditions of a case: half of them with coloured noise, some with even stamps."""
    loop_hz = _rate(rng, USUAL_LOOPS, LOOP_HZ)
    fastest = min(ROW_HZ[1], loop_hz)
    usual = tuple(rate for rate in USUAL_ROWS if rate <= fastest)
    row_hz = _rate(rng, usual, (ROW_HZ[0], fastest))
    jitter, clock_s, dropped = rng.uniform(0.0, (JITTER, CLOCK_S, DROPPED))
    keep = rng.random(3) < (0.8, 0.8, 0.6)
    is_coloured = rng.random() < 0.5
    coloured, colour_s = rng.uniform(0.5, 0.9), np.exp(rng.uniform(*np.log(COLOUR_S)))
    jitter, clock_s, dropped = (float(value) for value in (jitter, clock_s, dropped) * keep)
    share = float(coloured) if is_coloured else 0.0
    return Conditions(loop_hz, row_hz, jitter, clock_s, dropped, share, float(colour_s))


def _rate(rng: np.random.Generator, usual: tuple[float, ...], span: tuple[float, float]) -> float:
    one, between = float(rng.choice(usual)), float(np.exp(rng.uniform(*np.log(span))))
    return one if rng.random() < 0.5 else round(between, 1)
