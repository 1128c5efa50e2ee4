"""The report's parts about the logs, their noise, the actuators, what is left and the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.common.report import Part, Picture, Section
from suite.diagnose.data.windows import SLICES, UNITS
from suite.diagnose.report.charts import (
    AFTER,
    BEFORE,
    WRONG,
    black_box_chart,
    gap_chart,
    labelled_gaps,
)
from suite.diagnose.report.parameters_json import grid, short_name
from suite.diagnose.verdict.actuators import ActuatorMismatch
from suite.diagnose.verdict.black_box import BlackBoxComparison
from suite.diagnose.verdict.checks import Checks, Kinematics
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import MEASURE, Gap
from tracks.common.grid import Grid

SHOWN = 12
"""Logs in the table."""


def logs_section(diagnosis: Diagnosis, checks: Checks) -> Section:
    """Return what the logs hold, and what pose and gyro say about each other."""
    rows = [
        (
            short_name(fact.name),
            f"{fact.duration_s:.1f} s",
            f"{fact.rows}",
            f"{fact.rate_hz:.0f} Hz",
            f"{1e3 * fact.longest_hole_s:.0f} ms",
            f"{100 * fact.missing:.1f} %",
            f"{fact.top_speed:.1f} m/s",
            fact.channels,
        )
        for fact in checks.facts[:SHOWN]
    ]
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "others"]
    more = len(checks.facts) - SHOWN
    parts: list[Part] = [grid("", headers, rows, f"And {more} more." if more > 0 else "")]
    if checks.kinematics is None:
        parts.append("Too little of pose and gyro is there to hold them against each other.")
    else:
        parts.append(_kinematics(checks.kinematics, diagnosis.limits.clock_resolution_s))
    parts.append(_faults(diagnosis))
    return Section("1. The logs and their faults", parts)


def _kinematics(found: Kinematics, resolution_s: float) -> Grid:
    bias = ", ".join(
        f"{1e3 * b:.2f} ± {1e3 * h:.2f}" for b, h in zip(found.bias, found.bias_ci, strict=True)
    )
    sure = bool((np.abs(found.bias) > found.bias_ci).any())
    rows = [("gyro less the attitude's turn", f"{bias} mrad/s", "not zero" if sure else "")]
    late, said = "rates change too little", ""
    if np.isfinite(found.offset_ci):
        late = f"{1e3 * found.offset:.2f} ± {1e3 * found.offset_ci:.2f} ms"
        said = "not zero" if abs(found.offset) > max(found.offset_ci, resolution_s) else ""
    rows.append(("pose later than gyro", late, said))
    if found.velocity_scale is not None:
        rows.append(("velocity over the path's slope", f"{found.velocity_scale:.4f}", ""))
    note = (
        "From pose and gyro alone, without any model of forces, 95 %. Faults of a log imitate "
        "physics, so that they are looked at first."
    )
    return grid("Pose, gyro and path among themselves", ["", "value", ""], rows, note)


def _faults(diagnosis: Diagnosis) -> Grid:
    named = {candidate.name for candidate in diagnosis.search.candidates}
    rows = [
        (
            s.candidate.label,
            f"{s.gain:.1f}",
            f"{s.p_value:.4f}",
            "named" if s.candidate.name in named else "not named",
        )
        for s in diagnosis.search.first
        if all(EFFECTS[name].of_log for name in s.candidate.effects)
    ]
    note = (
        "In the search they compete with the physics that they imitate, in one model; the gain "
        "alone is not the verdict."
    )
    return grid("As candidates, alone", ["fault", "gain", "p", "verdict"], rows, note)


def noise_section(diagnosis: Diagnosis) -> Section:
    """Return the noise of every channel."""
    rows = [
        (f"{name} [{UNITS[name]}]", ", ".join(f"{v:.3g}" for v in values))
        for name, place in SLICES.items()
        if np.isfinite(values := diagnosis.sigma[place]).any()
    ]
    words = (
        "Standard deviation by axis, from the data: what is left of measured minus simulated when "
        "all that changes slowly is taken off. Everything below is in units of it; where the gap "
        "does not exceed what it gives, the verdict is no_gap."
    )
    return Section("2. The measurement noise", [words, grid("", ["measured", "noise"], rows)])


def actuators_section(checks: Checks, input_source: str) -> list[Section]:
    """Return what measured rotor speeds say of the actuators; nothing where there are none."""
    if not checks.actuators:
        return []
    words = (
        f"The model is driven by {input_source}. The difference between rotor speeds that are "
        "asked for and measured is the flight controller's and the motors', no physics of the air: "
        "integrators and filters that the nominal rate loop has not show here."
    )
    return [Section("Actuators, apart from the air", [words, *map(_mismatch, checks.actuators)])]


def _mismatch(found: ActuatorMismatch) -> Grid:
    scale = ", ".join(f"{s:.4f}" for s in found.scale)
    turn = ", ".join(f"{mean:.2f} ± {spread:.2f}" for mean, spread in found.turn)
    given = f"{100 * max(found.followed, 0.0):.0f} % of the change is given"
    rows = [
        ("speeds change by", f"{found.spread:.1f} rad/s"),
        ("off what is asked for, with the vehicle file's lag", f"{found.rms:.1f} rad/s ({given})"),
        ("lag that fits best", f"{1e3 * found.time_constant:.1f} ms"),
        ("delay before it", f"{1e3 * found.delay:.1f} ms"),
        ("measured over asked, by rotor", scale),
        ("what these leave", f"{found.rms_fitted:.1f} rad/s"),
        ("thrust more than asked for", f"{found.thrust[0]:.2f} ± {found.thrust[1]:.2f} m/s²"),
        ("turning more than asked for, x y z", f"{turn} rad/s²"),
    ]
    note = "± is the spread over the flights."
    return grid(f"Against the {found.asked_by}", ["", ""], rows, note)


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
    return Section("5. Remaining error", parts)


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
    return Section("6. The evidence", parts)


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
