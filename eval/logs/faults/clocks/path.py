"""Check whether the position is late or early against the attitude.

Acceleration minus gravity is thrust, so it points along body z, except for drag. The path is
shifted by trial delays, and the least force across body z gives the delay. A late position comes
from another clock or a slow link, an early one is a set point. The standard error comes from
estimates that leave out one block of the flight at a time (jackknife).
"""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.faults.clocks.delay import BLOCKS, best_delay, block_sums, delay_of
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import (
    CALM_ACC,
    GOOD,
    WIDTH_S,
    Rows,
    axes_of,
    is_usual,
    path_of,
    without_drag,
)
from eval.logs.faults.relation import rms, shifted

REACH_S, STEP_S = 0.5, 0.02
"""Largest delay that is tried, in both directions, and about the step between trials [s]."""
LEAST_S, SURE = 0.05, 8.0
"""Least delay that is a fault: in seconds, and in standard errors. In 37 real logs it is at most
0.02 s where its error is that small."""
CLEARER = 0.85
"""With a delay the squared force across body z is at most this share of that without one. In slow
flights drag explains about the same."""
SEEN_S = 0.2
"""The delay is not identifiable where `SURE` standard errors exceed this [s]."""
LEAST_ROWS, POINTS = 200, 2000
"""Least rows, and about how many of them are compared."""
ALIKE = 0.3
"""Largest difference of two delays that have one cause, as a share of the delay."""
MEASURED = "give the measured signal"
"""What to do if a signal is a set point."""


def check_position_delay(rows: Rows) -> list[Finding]:
    """Return the finding on the delay of the position against the attitude; [] without both."""
    if not {"pos", "quat"} <= rows.keys():
        return []
    axes, (vel, acc) = axes_of(rows["time"], rows["quat"]), path_of(rows["time"], rows["pos"])
    found = delay_of_path(rows["time"], axes, vel, acc)
    if found is None or found[1] * SURE > SEEN_S:
        text = "the flight does not accelerate enough, or as the attitude says"
        return unseen("position delay", text, "position_delay")
    late_s, error_s = found
    size = f"{1e3 * abs(late_s):.0f} ms (± {1e3 * error_s:.1f} ms)"
    figures = f"it is {size} {'late' if late_s > 0.0 else 'early'} against the attitude"
    if abs(late_s) < max(LEAST_S, SURE * error_s):
        return [Finding("ok", "position delay", figures)]
    if late_s > 0.0 and _is_early(rows, late_s):
        text = f"it is {size} early against path and gyro, as a set point is"
        return [Finding("doubt", "attitude", text, "attitude", late_s, 0.95, MEASURED)]
    fix = "stamp positions with the time of their measurement"
    if late_s < 0.0:
        figures, fix = f"{figures}, as a set point is", MEASURED
    return [Finding("doubt", "position", figures, "position_delay", late_s, 0.95, fix)]


def _is_early(rows: Rows, late_s: float) -> bool:
    """Return whether the attitude is early against the gyro by about `late_s` [s]."""
    if "rate" not in rows:
        return False
    late = delay_of(rows["time"], rows["quat"], rows["time"], rows["rate"])
    return late is not None and abs(late.delay_s + late_s) < ALIKE * late_s


def delay_of_path(
    time_s: np.ndarray, axes: np.ndarray, vel_w: np.ndarray, acc_w: np.ndarray
) -> tuple[float, float] | None:
    """Return by how much the path is later than the attitude, and its standard error [s].

    None: the flight is too short, hardly accelerates, no delay up to `REACH_S` fits, or the best
    one fits hardly better than none.

    Args:
        time_s: (T,) increasing times.
        axes: (T, 3, 3) averaged body axes in the world; `[:, :, k]` is body axis k.
        vel_w: (T, 3) averaged velocity of the path [m/s].
        acc_w: (T, 3) averaged acceleration of the path [m/s^2].
    """
    is_known = np.isfinite(vel_w).all(axis=1) & np.isfinite(acc_w).all(axis=1)
    if is_known.sum() < LEAST_ROWS:
        return None
    known = np.flatnonzero(is_known)
    known = known[is_usual(np.linalg.norm(acc_w[known], axis=1))]
    edge_s = REACH_S + WIDTH_S
    inside = (time_s > time_s[0] + edge_s) & (time_s < time_s[-1] - edge_s)
    inside &= np.isfinite(axes).all(axis=(1, 2))
    if min(len(known), inside.sum()) < LEAST_ROWS:
        return None
    every = max(1, int(inside.sum()) // POINTS)
    at_s, body = time_s[inside][::every], axes[inside][::every]
    level = rms(GRAVITY * (body[:, 2, :2] - body[:, 2, :2].mean(axis=0)))
    if level < CALM_ACC:
        return None
    known_s, path = time_s[known], np.concatenate([vel_w, acc_w], axis=1)[known]
    sides = np.ascontiguousarray(body[:, :, :2].transpose(1, 2, 0))[:, :, None]  # (3, 2, 1, N)
    # Whole rows only: between rows an interpolated path has less noise, and would fit better.
    spacing_s = float(np.median(np.diff(known_s)))
    step_s = spacing_s * max(1, round(STEP_S / spacing_s))
    count = max(1, round(REACH_S / step_s))
    trials = step_s * np.arange(-count, count + 1)
    cost = np.empty((BLOCKS, len(trials)))
    for some, values in shifted(at_s, trials, known_s, path):
        vel, force = values[:3], values[3:] + [[[0.0]], [[0.0]], [[GRAVITY]]]
        # Along two axes of the body: (2, trials, N).
        side = without_drag(*(np.sum(sides * x[:, None], axis=0) for x in (force, vel)))
        cost[:, some] = block_sums(np.sum(side**2, axis=0))
    total = cost.sum(axis=0)
    misfit = float(np.sqrt(total.min() / len(at_s))) / level
    best = best_delay(trials, cost) if misfit < GOOD else None
    is_as_good_without = total.min() > CLEARER * total[count]
    return None if best is None or (abs(best[0]) >= LEAST_S and is_as_good_without) else best
