"""Timing in the continuous-time engine: random rates and jitter, and the schedule of the steps.

A step ends at every event (see `engine`), so that nothing jumps within a step. N flights are
computed together, so they have the same number of steps between two rows. A flight that needs fewer
gets steps of zero length before the next row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

STEP_S = 1e-3
"""Longest step [s]."""
SAME_S = 1e-9
"""Events whose times differ by less than this are one event [s]."""


class Schedule(NamedTuple):
    """The times of R rows and S steps of N flights."""

    stamp_s: np.ndarray
    """(R + 1, N) times of the rows, at which commands are given; the last is the end of the flight
    [s]."""
    block: np.ndarray
    """(R + 1,) index of the first step after each row; the last is S."""
    start_s: np.ndarray
    """(S, N) start of each step [s]."""
    length_s: np.ndarray
    """(S, N) length of each step [s]."""
    is_tick: np.ndarray
    """(S, N) whether the rate loop runs at the start of the step."""
    acting: np.ndarray
    """(S, N) index of the row whose command acts in the step; -1 before the first command acts."""


def jittered_stamps(
    rng: np.random.Generator, count: int, start_s: float, end_s: float, rate_hz: float,
    jitter: float,
) -> np.ndarray:  # fmt: skip
    """Return the time stamps (R + 1, N) of rows from `start_s` past `end_s` [s].

    Rows are nominally 1 / `rate_hz` apart. The row at time 0 has no jitter. The other rows are
    early or late by up to `jitter` times the distance of rows, with a uniform distribution.
    """
    period = 1.0 / rate_hz
    number = np.arange(int(np.ceil(start_s / period)), int(np.ceil(end_s / period)) + 2)
    offset = jitter * rng.uniform(-1.0, 1.0, (len(number), count))
    offset[number == 0] = 0.0
    return (number[:, None] + offset) * period


def schedule(
    stamp_s: np.ndarray, loop_s: float, delay_s: float, step_s: float = STEP_S
) -> Schedule:
    """Return the steps of flights with rows at `stamp_s` (R + 1, N).

    Args:
        stamp_s: (R + 1, N) times of the rows [s].
        loop_s: period of the rate loop, which restarts at every row [s].
        delay_s: delay of commands [s].
        step_s: longest step [s].
    """
    flights = [_steps_of_flight(stamps, loop_s, delay_s, step_s) for stamps in stamp_s.T]
    rows = len(stamp_s) - 1
    # The number of steps after a row is that of the flight that needs most.
    counts = np.stack([np.bincount(row, minlength=rows) for row, *_ in flights], axis=1)
    padded = counts.max(axis=1)
    block = np.concatenate([[0], np.cumsum(padded)])
    start_s = np.repeat(stamp_s[1:], padded, axis=0)  # steps of zero length start at the next row
    length_s = np.zeros_like(start_s)
    is_tick, acting = np.zeros(start_s.shape, bool), np.zeros(start_s.shape, int)
    for index, (row, start, length, tick, command) in enumerate(flights):
        first = np.concatenate([[0], np.cumsum(counts[:-1, index])])
        steps = block[row] + np.arange(len(row)) - first[row]
        start_s[steps, index], length_s[steps, index] = start, length
        is_tick[steps, index], acting[steps, index] = tick, command
        # In steps of zero length the command of the step before continues to act.
        is_padding = np.ones(len(start_s), bool)
        is_padding[steps] = False
        last_real_step = np.maximum.accumulate(np.where(is_padding, 0, np.arange(len(start_s))))
        acting[is_padding, index] = acting[last_real_step[is_padding], index]
    return Schedule(stamp_s, block, start_s, length_s, is_tick, acting)


def _steps_of_flight(
    stamps: np.ndarray, loop_s: float, delay_s: float, step_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the steps of one flight, as five arrays with an entry per step.

    They are the row before the step, its start [s], its length [s], whether the rate loop has a
    tick at its start, and the row whose command acts.
    """
    # 1. Ticks: the loop starts again at every row.
    ticks = np.maximum(np.ceil(np.diff(stamps) / loop_s - SAME_S / loop_s), 1.0).astype(int)
    tick_s = np.repeat(stamps[:-1], ticks) + _rank(ticks) * loop_s
    # 2. Times at which commands begin to act, unless a tick is at the same time.
    acting_s = stamps[:-1] + delay_s
    acting_s = acting_s[acting_s < stamps[-1]]
    after = np.searchsorted(tick_s, acting_s)
    distance_s = np.minimum(
        np.abs(acting_s - tick_s[np.maximum(after - 1, 0)]),
        np.abs(acting_s - tick_s[np.minimum(after, len(tick_s) - 1)]),
    )
    event_s = np.concatenate([tick_s, acting_s[distance_s > SAME_S]])
    is_tick = np.arange(len(event_s)) < len(tick_s)
    order = np.argsort(event_s, kind="stable")
    event_s, is_tick = event_s[order], is_tick[order]
    # 3. The time between two events is divided into equal steps.
    between_s = np.diff(np.append(event_s, stamps[-1]))
    steps = np.maximum(np.ceil(between_s / step_s - 1e-6), 1.0).astype(int)
    rank = _rank(steps)
    length = np.repeat(between_s / steps, steps)
    start = np.repeat(event_s, steps) + rank * length
    row = np.searchsorted(stamps[:-1], start + SAME_S, side="right") - 1
    acting = np.searchsorted(stamps[:-1] + delay_s, start + SAME_S, side="right") - 1
    return row, start, length, np.repeat(is_tick, steps) & (rank == 0), acting


def _rank(counts: np.ndarray) -> np.ndarray:
    """Return 0, 1, ..., count - 1 for each of `counts`, one after the other."""
    first = np.concatenate([[0], np.cumsum(counts)])[:-1]
    return np.arange(counts.sum()) - np.repeat(first, counts)


LOOP_HZ = (200.0, 2000.0)
"""Range of the frequency of the rate loop [Hz]."""
ROW_HZ = (50.0, 1000.0)
"""Range of the rate of rows, which is at most the frequency of the loop [Hz]."""
USUAL_LOOPS = (200.0, 250.0, 400.0, 500.0, 800.0, 1000.0, 1600.0, 2000.0)
"""Common frequencies of rate loops; half of the cases have one of them [Hz]."""
USUAL_ROWS = (50.0, 100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0)
"""Common rates of rows; half of the cases have one of them that the loop allows [Hz]."""
JITTER = 0.3
"""Largest jitter of a time stamp, as a share of the distance of two rows."""
CLOCK_S = 1e-4
"""Largest error of a logged stamp [s]."""
DROPPED = 0.01
"""Largest share of rows that the log lacks."""
COLOUR_S = (0.02, 0.2)
"""Range of the correlation time of the errors of a state estimator [s]."""


@dataclass(frozen=True)
class Conditions:
    """Rates and errors of the log of one case; the answer of the case records them."""

    loop_hz: float
    """Frequency of the rate loop, which the vehicle file has too [Hz]."""
    row_hz: float
    """Nominal rate of commands and rows [Hz]."""
    jitter: float
    """Largest jitter of the true times of rows, to both sides, as a share of the distance of two
    rows."""
    clock_s: float
    """Largest error of a logged stamp, uniform to both sides [s]."""
    dropped: float
    """Share of the rows that the log lacks; their commands act all the same."""
    coloured: float
    """Share of the noise of poses and velocities that is coloured (correlated in time, a
    first-order Gauss-Markov process); the other part is white."""
    colour_s: float
    """Correlation time of the coloured noise [s]."""


def draw_conditions(rng: np.random.Generator) -> Conditions:
    """Draw the conditions of a case.

    Half of the cases have coloured noise. One in five has no jitter, one in five no errors of the
    time stamps, and two in five lose no rows.
    """
    loop_hz = _rate(rng, USUAL_LOOPS, LOOP_HZ)
    max_row_hz = min(ROW_HZ[1], loop_hz)
    usual = tuple(rate for rate in USUAL_ROWS if rate <= max_row_hz)
    row_hz = _rate(rng, usual, (ROW_HZ[0], max_row_hz))
    jitter, clock_s, dropped = rng.uniform(0.0, (JITTER, CLOCK_S, DROPPED))
    is_present = rng.random(3) < (0.8, 0.8, 0.6)
    is_coloured = rng.random() < 0.5
    coloured, colour_s = rng.uniform(0.5, 0.9), np.exp(rng.uniform(*np.log(COLOUR_S)))
    jitter, clock_s, dropped = (float(value) for value in (jitter, clock_s, dropped) * is_present)
    share = float(coloured) if is_coloured else 0.0
    return Conditions(loop_hz, row_hz, jitter, clock_s, dropped, share, float(colour_s))


def _rate(rng: np.random.Generator, usual: tuple[float, ...], span: tuple[float, float]) -> float:
    """Draw a rate [Hz]: one of the usual ones, or log-uniform within the span."""
    usual_hz, between_hz = float(rng.choice(usual)), float(np.exp(rng.uniform(*np.log(span))))
    return usual_hz if rng.random() < 0.5 else round(between_hz, 1)
