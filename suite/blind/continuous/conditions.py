"""Under which conditions a case is flown and logged: rates, jitter, lost rows, colour of noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    return Conditions(
        loop_hz=loop_hz,
        row_hz=row_hz,
        jitter=float(jitter * keep[0]),
        clock_s=float(clock_s * keep[1]),
        dropped=float(dropped * keep[2]),
        coloured=float(coloured) if is_coloured else 0.0,
        colour_s=float(colour_s),
    )


def _rate(rng: np.random.Generator, usual: tuple[float, ...], span: tuple[float, float]) -> float:
    one, between = float(rng.choice(usual)), float(np.exp(rng.uniform(*np.log(span))))
    return one if rng.random() < 0.5 else round(between, 1)
