"""Check whether position and attitude have the same heading.

Acceleration minus gravity is thrust, so it points along body z. Across body z, in axes j = x, y,
this gives a linear equation in the path's acceleration a and velocity v:

    -g . b_j = cos(h) a . b_j + sin(h) (e_z x a) . b_j + drag_j v . b_j + constant_j

h is the angle by which the path must be turned about the vertical. With a wrong scale of the path,
both of its factors are divided by that scale. Standard errors come from estimates that leave out
one block of the flight at a time (jackknife).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.faults.clocks.delay import BLOCKS
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import CALM_ACC, GOOD, Rows, axes_of, is_usual, path_of
from eval.logs.faults.relation import jackknife_error, rms

LEAST_DEG, SURE = 5.0, 4.0
"""Least angle that is a fault: in degrees, and in standard errors. In 19 real logs it is at most
4 deg, and at most 4 standard errors where it exceeds 2 deg."""
SEEN_DEG = 15.0
"""The angle is not identifiable where `SURE` standard errors exceed this [deg]."""
LEAST_SCALE = 0.05
"""Least error of the path's scale that is a note. In 7 of 20 real logs it is larger, as attitude
filters cause as much."""
LEAST_ROWS = 200
"""Least rows for the fit."""


def check_heading(rows: Rows) -> list[Finding]:
    """Return the finding on the heading of the path against the attitude; [] without both."""
    if not {"pos", "quat"} <= rows.keys():
        return []
    found = heading_of_path(
        axes_of(rows["time"], rows["quat"]), *path_of(rows["time"], rows["pos"])
    )
    if found is None or SURE * found.error_deg > SEEN_DEG:
        text = "the flight accelerates too little to compare its directions with the attitude"
        return unseen("heading", text, "heading")
    turn, error, scale, scale_error = found
    figures = f"its path is turned by {-turn:+.0f} deg (± {error:.1f} deg) against the attitude"
    if abs(turn) < max(LEAST_DEG, SURE * error):
        notes = [Finding("ok", "heading", figures)]
        if abs(scale - 1.0) > max(LEAST_SCALE, SURE * scale_error):
            text = f"the path's acceleration is {scale:.3g} times (± {scale_error:.2g}) what the "
            text += "attitude shows: a scale, the rate of a clock (squared), or a filter"
            notes.append(Finding("note", "position", text))
        return notes
    fix = "align the world axes of position and attitude (declination, or axes of a motion capture)"
    return [Finding("doubt", "position", figures, "heading", -turn, 0.95, fix)]


class PathFit(NamedTuple):
    """How the path must be changed so that its acceleration fits the attitude."""

    turn_deg: float
    """Angle by which it must be turned about the vertical [deg]."""
    error_deg: float
    """Standard error of `turn_deg` [deg]."""
    scale: float
    """Its acceleration over the one that fits; 1 is correct."""
    scale_error: float
    """Standard error of `scale`."""


def heading_of_path(axes: np.ndarray, vel_w: np.ndarray, acc_w: np.ndarray) -> PathFit | None:
    """Return angle and scale of the path against the attitude.

    None: the flight is too short, hardly accelerates, or no angle fits.

    Args:
        axes: (T, 3, 3) averaged body axes in the world; `[:, :, k]` is body axis k.
        vel_w: (T, 3) averaged velocity of the path [m/s].
        acc_w: (T, 3) averaged acceleration of the path [m/s^2].
    """
    is_known = np.isfinite(np.concatenate([vel_w, acc_w, axes[:, 2]], axis=1)).all(axis=1)
    if is_known.sum() < LEAST_ROWS:
        return None
    known = np.flatnonzero(is_known)
    known = known[is_usual(np.linalg.norm(acc_w[known], axis=1))]
    across, vel, acc = axes[known][:, :, :2], vel_w[known], acc_w[known]
    tilt = -GRAVITY * across[:, 2]
    level = rms(tilt - tilt.mean(axis=0))
    if len(known) < LEAST_ROWS or level < CALM_ACC:
        return None

    def in_body(vectors: np.ndarray) -> np.ndarray:
        return np.einsum("tij,ti->tj", across, vectors)

    turned = np.stack([-acc[:, 1], acc[:, 0], np.zeros(len(acc))], axis=1)
    columns = np.zeros((len(acc), 2, 6))
    columns[:, :, 0], columns[:, :, 1] = in_body(acc), in_body(turned)
    for axis, drag in enumerate(in_body(vel).T):
        columns[:, axis, 2 + axis], columns[:, axis, 4 + axis] = drag, 1.0
    block = np.arange(len(acc)) * BLOCKS // len(acc)
    parts = [(columns[block == k].reshape(-1, 6), tilt[block == k].ravel()) for k in range(BLOCKS)]
    hessians = np.stack([x.T @ x for x, _ in parts])
    slopes = np.stack([x.T @ y for x, y in parts])

    def solution(hessian: np.ndarray, slope: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(hessian, slope, rcond=None)[0]

    def change(values: np.ndarray) -> tuple[float, float]:
        """Return the angle [deg] and the scale of a solution."""
        size = float(np.hypot(values[0], values[1]))
        return float(np.degrees(np.arctan2(values[1], values[0]))), 1.0 / max(size, 1e-9)

    total, slope = hessians.sum(axis=0), slopes.sum(axis=0)
    best = solution(total, slope)
    if rms(tilt - columns @ best) > GOOD * level:
        return None
    turn, scale = change(best)
    without = [
        change(solution(total - h, slope - s)) for h, s in zip(hessians, slopes, strict=True)
    ]
    turns, scales = np.transpose(without)
    apart = (turns - turn + 180.0) % 360.0 - 180.0
    return PathFit(turn, jackknife_error(apart), scale, jackknife_error(scales))
