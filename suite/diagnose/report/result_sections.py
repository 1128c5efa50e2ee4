"""The report's part about the result: what is left over, and the gap on flights left out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from suite.common.report import Part, Picture, Section
from suite.diagnose.checks.black_box import BlackBoxComparison
from suite.diagnose.checks.checks import Checks
from suite.diagnose.data.windows import UNITS
from suite.diagnose.report.charts import (
    AFTER,
    BEFORE,
    WRONG,
    black_box_chart,
    gap_chart,
    labelled_gaps,
)
from suite.diagnose.report.parameters_json import grid
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import MEASURE, Gap
from tracks.common.grid import Grid

SHAPES = 5
"""Shapes of the residual in the table."""
HORIZON_S = 0.5
"""Of the rollouts in the comparison with the black box [s]."""
BLACK_BOX = (
    "Beside it a Delta Action Model: a recurrent network that corrects the body's acceleration and "
    "turning from velocity, attitude and command, fitted by gradients through the same rollouts of "
    "the same flights. It has no name and no number to write into a vehicle file."
)


def residual_section(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    """Return what the named effects leave over; `found` is the JSON."""
    left, residual = found["unexplained"], diagnosis.residual
    words = "No structure beyond the measurement noise is left."
    if left["where"]:
        words = f"{100 * left['share']:.0f} % of the gap is left: {left['where']}."
    parts: list[Part] = [words]
    if residual.shapes:
        rows = [(s.label, f"{s.gain:.1f}", f"{s.p_value:.3f}") for s in residual.shapes[:SHAPES]]
        note = (
            "A force or torque that no effect describes, with a plain shape over the state: its "
            "gain on stretches left out, and how often chance gains as much."
        )
        parts.append(grid("Shapes without a name", ["the rest as a", "gain", "p"], rows, note))
        rows = [(axis, f"{p:.2g}") for axis, p in residual.coloured.items()]
        note = "How often noise alone has as much energy in a smooth push along the axis."
        parts.append(grid("A push that no shape follows", ["axis", "p"], rows, note))
    return Section("6. What is left", parts)


def held_out_section(diagnosis: Diagnosis, found: Mapping[str, Any], checks: Checks) -> Section:
    """Return the gap on flights that took no part, with its rivals; `found` is the JSON."""
    seed = diagnosis.seed
    gaps = [("as given", diagnosis.before, BEFORE)]
    if diagnosis.control is not None:
        gaps.append((f"wrong: {diagnosis.control[0]}", diagnosis.control[1], WRONG))
    if len(diagnosis.without) > 1:
        gaps += [(f"without {label}", gap, BEFORE) for label, gap in diagnosis.without.items()]
    if diagnosis.search.named:
        gaps.append(("with what was named", diagnosis.after, AFTER))
    rows = [(label, *_gap_cells(gap, diagnosis.before, seed, 3)) for label, gap, _ in gaps]
    held = ", ".join(found["gap"]["held_out"])
    words = f"{MEASURE}. Held out: {held}; they took no part in finding or fitting anything."
    note = (
        "95 % by drawing neighbouring rollouts in blocks of a second. Wrong: the best effect that "
        "is neither named nor a rival, fitted to the same flights in the same way."
    )
    speed = np.linalg.norm(np.asarray(diagnosis.held_windows.vel_w), axis=1)
    parts: list[Part] = [
        words,
        Picture(gap_chart(gaps, speed, seed), "Left: bars are 95 %. Right: dots are rollouts."),
        grid("", ["vehicle", "gap", "95 %", "of the gap removed"], rows, note),
    ]
    if checks.black_box is None:
        parts.append(
            "A black box on the same split, and outside the speeds of its fit: "
            "suite diagnose --compare-delta."
        )
    else:
        sides = [side for side in (checks.black_box.held_out, checks.black_box.outside) if side]
        caption = "Bars are 95 %; 1 is the noise floor."
        parts += [BLACK_BOX, Picture(black_box_chart(sides, seed), caption)]
        parts += [_comparison(side, seed) for side in sides]
        if checks.black_box.outside is None:
            parts.append("There are too few stretches to fit slow ones and judge fast ones.")
    return Section("7. The evidence", parts)


def _comparison(side: BlackBoxComparison, seed: int) -> Grid:
    rows = [
        (
            label,
            *_gap_cells(gap, side.before, seed, 2),
            *(f"{values[0]:.3g}" for values in gap.table[HORIZON_S].values()),
        )
        for label, gap in labelled_gaps(side)
        if gap is not None
    ]
    names = [f"{group} [{UNITS[group]}]" for group in side.before.table[HORIZON_S]]
    headers = ["", "gap", "95 %", "removed", *names]
    note = (
        f"{side.fitted} stretches fitted, {side.judged} judged. The last columns: RMS errors of "
        f"rollouts of {HORIZON_S:g} s."
    )
    return grid(f"On {side.judged_on}", headers, rows, note)


def _gap_cells(gap: Gap, before: Gap, seed: int, digits: int) -> tuple[str, str, str]:
    """Return a gap, its interval, and the share of `before` that it removes."""
    low, high = gap.ci95(seed)
    whole = before.rms - 1.0
    removed = ""
    if gap is not before and whole > 0.0:
        removed = f"{100 * (before.rms - gap.rms) / whole:.0f} %"
    return f"{gap.rms:.{digits}f}", f"{low:.{digits}f} to {high:.{digits}f}", removed
