"""The conditions of a flight and its schedule: rows, rate loop ticks, delayed commands, steps.

Every event is the end of a step, so that nothing jumps within a step. The steps of N flights are
aligned row by row; a flight with fewer steps between two rows has steps of zero length at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

STEP_S = 1e-3
"""Longest step [s]."""
SAME_S = 1e-9
"""Events closer than this are merged [s]."""


class Schedule(NamedTuple):
    """R rows and S steps of N flights."""

    stamp_s: np.ndarray
    """(R + 1, N) times of rows and their commands; the last is the end of the flight [s]."""
    block: np.ndarray
    """(R + 1,) index of the first step after each row."""
    start_s: np.ndarray
    """(S, N) start of each step [s]."""
    length_s: np.ndarray
    """(S, N) length of each step [s]."""
    is_tick: np.ndarray
    """(S, N) whether the rate loop runs at the start of the step."""
    acting: np.ndarray
    """(S, N) row of the command that acts in the step; -1 before the first."""


def jittered_stamps(
    rng: np.random.Generator, count: int, start_s: float, end_s: float, rate_hz: float,
    jitter: float,
) -> np.ndarray:  # fmt: skip
    """Return the stamps (R + 1, N) of rows from `start_s` past `end_s` [s].

    Rows are nominally 1 / rate apart. The one at 0 has no jitter; the others have a uniform one of
    up to `jitter` rows.
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
        stamp_s: times of the rows [s].
        loop_s: period of the rate loop, which restarts at every row [s].
        delay_s: delay of commands [s].
        step_s: longest step [s].
    """
    flights = [_one(stamps, loop_s, delay_s, step_s) for stamps in stamp_s.T]
    rows = len(stamp_s) - 1
    counts = np.stack([np.bincount(row, minlength=rows) for row, *_ in flights], axis=1)
    most = counts.max(axis=1)
    block = np.concatenate([[0], np.cumsum(most)])
    # Steps of zero length are at the end of a row.
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
    """Return the steps of one flight: row, start, length, loop tick, row of the acting command."""
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
"""Range of the rate loops' frequency [Hz]."""
ROW_HZ = (50.0, 1000.0)
"""Range of the rows' rate, at most the loop's frequency [Hz]."""
USUAL_LOOPS = (200.0, 250.0, 400.0, 500.0, 800.0, 1000.0, 1600.0, 2000.0)
"""Frequencies of half of the cases [Hz]."""
USUAL_ROWS = (50.0, 100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0)
"""Row rates of half of the cases, if the loop is fast enough [Hz]."""
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
    """Conditions of one case, which are in its answer."""

    loop_hz: float
    """Frequency of the rate loop, which is in the vehicle file [Hz]."""
    row_hz: float
    """Nominal rate of commands and rows [Hz]."""
    jitter: float
    """Largest jitter of the true stamps, uniform to both sides [rows]."""
    clock_s: float
    """Largest error of a logged stamp, uniform to both sides [s]."""
    dropped: float
    """Share of lost rows; their commands act."""
    coloured: float
    """Coloured share (first-order Gauss-Markov) of the noise of poses and velocities; the other
    part is white."""
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
