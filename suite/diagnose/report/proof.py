"""The report's part about the proof: what is left over, and the gap on flights left out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from suite.common.report import Cell, Grid, Part, Picture, Section
from suite.diagnose.data.windows import UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.report.charts import COLOURS, contest_chart, gap_chart
from suite.diagnose.verdict.black_box import Contest
from suite.diagnose.verdict.gap import MEASURE, Gap, interval
from suite.diagnose.verdict.proof import Proof

SHAPES = 5
"""Shapes of the rest in the table."""
HORIZON_S = 0.5
"""Of the rollouts in the comparison with the black box."""


def rest_section(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    """Return what the named effects leave over."""
    rest = found["unexplained"]
    if rest["where"]:
        words = f"{100 * rest['share']:.0f} % of the gap is left: {rest['where']}."
    else:
        words = "No structure beyond the measurement noise is left."
    parts: list[Part] = [words]
    if diagnosis.rest.shapes:
        rows = [
            [Cell(s.label), Cell(f"{s.gain:.1f}"), Cell(f"{s.p_value:.3f}")]
            for s in diagnosis.rest.shapes[:SHAPES]
        ]
        note = (
            "A force or torque that no effect describes, with a plain shape over the state: its "
            "gain on stretches left out, and how often chance gains as much."
        )
        headers = ["the rest as a", "gain", "p"]
        parts.append(Grid("Shapes without a name", headers, rows, note=note))
        rows = [[Cell(axis), Cell(f"{p:.2g}")] for axis, p in diagnosis.rest.coloured.items()]
        note = "How often noise alone has as much energy in a smooth push along the axis."
        parts.append(Grid("A push that no shape follows", ["axis", "p"], rows, note=note))
    return Section("6. What is left", parts)


def evidence_section(
    diagnosis: Diagnosis, found: Mapping[str, Any], proof: Proof, seed: int
) -> Section:
    """Return the gap on flights that took no part, with its rivals."""
    gaps = [("as given", diagnosis.before, COLOURS["before"])]
    if diagnosis.control is not None:
        gaps.append((f"wrong: {diagnosis.control[0]}", diagnosis.control[1], COLOURS["wrong"]))
    if len(diagnosis.without) > 1:
        gaps += [
            (f"without {label}", gap, COLOURS["before"]) for label, gap in diagnosis.without.items()
        ]
    if diagnosis.finding.named:
        gaps.append(("with what was named", diagnosis.after, COLOURS["after"]))
    rows = []
    for label, gap, _ in gaps:
        low, high = interval(gap.score, seed)
        rows.append([Cell(label), Cell(f"{gap.rms:.3f}"), Cell(f"{low:.3f} to {high:.3f}"),
                     Cell(_removed(diagnosis.before, gap))])  # fmt: skip
    held = ", ".join(found["gap"]["held_out"])
    words = f"{MEASURE}. Held out: {held}; they took no part in finding or fitting anything."
    note = (
        "95 % by drawing neighbouring rollouts in blocks of a second. Wrong: the best effect that "
        "is neither named nor a rival, fitted to the same flights in the same way."
    )
    speed = np.linalg.norm(np.asarray(diagnosis.held.vel_w), axis=1)
    headers = ["vehicle", "gap", "95 %", "of the gap removed"]
    parts: list[Part] = [
        words,
        Picture(gap_chart(gaps, speed, seed), "Left: bars are 95 %. Right: dots are rollouts."),
        Grid("", headers, rows, note=note),
    ]
    if proof.contests is None:
        parts.append(
            "A black box on the same split, and outside the speeds of its fit: "
            "suite diagnose --compare-delta."
        )
    else:
        contests = proof.contests
        parts += [
            BLACK_BOX,
            Picture(contest_chart(contests, seed), "Bars are 95 %; 1 is the noise floor."),
            _contest(contests.held_out, seed),
        ]
        if contests.outside is None:
            parts.append("There are too few stretches to fit slow ones and judge fast ones.")
        else:
            parts.append(_contest(contests.outside, seed))
    return Section("7. The evidence", parts)


BLACK_BOX = (
    "Beside it a Delta Action Model: a recurrent network that corrects the body's acceleration and "
    "turning from velocity, attitude and command, fitted by gradients through the same rollouts of "
    "the same flights. It has no name and no number to write into a vehicle file."
)


def _contest(side: Contest, seed: int) -> Grid:
    rows = []
    entries = [("as given", side.before), ("named effect", side.named),
               ("Delta Action Model", side.black_box)]  # fmt: skip
    for label, gap in entries:
        if gap is None:
            continue
        low, high = interval(gap.score, seed)
        rollouts = gap.table[HORIZON_S]
        rows.append(
            [
                Cell(label),
                Cell(f"{gap.rms:.2f}"),
                Cell(f"{low:.2f} to {high:.2f}"),
                Cell(_removed(side.before, gap)),
                *(Cell(f"{values[0]:.3g}") for values in rollouts.values()),
            ]
        )
    names = [f"{group} [{UNITS[group]}]" for group in side.before.table[HORIZON_S]]
    headers = ["", "gap", "95 %", "removed", *names]
    note = (
        f"{side.fitted} stretches fitted, {side.judged} judged. The last columns: RMS errors of "
        f"rollouts of {HORIZON_S:g} s."
    )
    return Grid(f"On {side.judged_on}", headers, rows, note=note)


def _removed(before: Gap, gap: Gap) -> str:
    whole = before.rms - 1.0
    if gap is before or whole <= 0.0:
        return ""
    return f"{100 * (before.rms - gap.rms) / whole:.0f} %"
