"""The report's part about the logs: what they hold, their faults, their noise, the actuators."""

from __future__ import annotations

import numpy as np

from eval.effects import EFFECTS
from suite.common.report import Cell, Grid, Part, Section
from suite.diagnose.data.actuators import Apart
from suite.diagnose.data.kinematics import Kinematics
from suite.diagnose.data.windows import SLICES, UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.verdict.proof import Proof

RESOLUTION_S = 0.002
"""Offsets below this are left unsaid: sampling and a simulator's steps shift pose and gyro so far
against each other [s]."""
SHOWN = 12
"""Logs in the table."""


def logs_section(diagnosis: Diagnosis, proof: Proof) -> Section:
    """Return what the logs hold, and what pose and gyro say about each other."""
    rows = [
        [
            Cell(fact.name.replace("\\", "/").rsplit("/", 1)[-1]),
            Cell(f"{fact.duration_s:.1f} s"),
            Cell(f"{fact.rows}"),
            Cell(f"{fact.rate_hz:.0f} Hz"),
            Cell(f"{1e3 * fact.longest_hole_s:.0f} ms"),
            Cell(f"{100 * fact.missing:.1f} %"),
            Cell(f"{fact.top_speed:.1f} m/s"),
            Cell(fact.channels),
        ]
        for fact in proof.facts[:SHOWN]
    ]
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "besides"]
    more = len(proof.facts) - SHOWN
    note = f"And {more} more." if more > 0 else ""
    parts: list[Part] = [Grid("", headers, rows, note=note)]
    if proof.kinematics is None:
        parts.append("Too little of pose and gyro is there to hold them against each other.")
    else:
        parts += _kinematics(proof.kinematics)
    parts.append(_faults(diagnosis))
    return Section("1. The logs and their faults", parts)


def _kinematics(found: Kinematics) -> list[Part]:
    bias = ", ".join(
        f"{1e3 * b:.2f} ± {1e3 * h:.2f}" for b, h in zip(found.bias, found.bias_ci, strict=True)
    )
    sure = bool((np.abs(found.bias) > found.bias_ci).any())
    rows = [[Cell("gyro less the attitude's turn"), Cell(f"{bias} mrad/s"),
             Cell("not zero" if sure else "")]]  # fmt: skip
    if np.isfinite(found.offset_ci):
        off = abs(found.offset) > max(found.offset_ci, RESOLUTION_S)
        value = f"{1e3 * found.offset:.2f} ± {1e3 * found.offset_ci:.2f} ms"
        rows.append([Cell("pose later than gyro"), Cell(value), Cell("not zero" if off else "")])
    else:
        rows.append([Cell("pose later than gyro"), Cell("rates change too little"), Cell("")])
    if found.velocity_scale is not None:
        value = f"{found.velocity_scale:.4f}"
        rows.append([Cell("velocity over the path's slope"), Cell(value), Cell("")])
    note = (
        "From pose and gyro alone, without any model of forces, 95 %. Faults of a log imitate "
        "physics, so that they are looked at first."
    )
    return [Grid("Pose, gyro and path among themselves", ["", "value", ""], rows, note=note)]


def _faults(diagnosis: Diagnosis) -> Grid:
    named = {n.candidate.name for n in diagnosis.finding.named}
    rows = [
        [
            Cell(s.candidate.label),
            Cell(f"{s.gain:.1f}"),
            Cell(f"{s.p_value:.3f}"),
            Cell("named" if s.candidate.name in named else "not named"),
        ]
        for s in diagnosis.finding.first
        if EFFECTS[s.candidate.name].of_log
    ]
    note = (
        "In the search they compete with the physics that they imitate, in one model; the gain "
        "alone is not the verdict."
    )
    return Grid("As candidates, alone", ["fault", "gain", "p", "verdict"], rows, note=note)


def noise_section(diagnosis: Diagnosis) -> Section:
    """Return the noise of every channel."""
    rows = [
        [Cell(f"{name} [{UNITS[name]}]"), Cell(", ".join(f"{v:.3g}" for v in values))]
        for name, place in SLICES.items()
        if np.isfinite(values := diagnosis.finding.sigma[place]).any()
    ]
    words = (
        "Standard deviation by axis, from the data: what is left of measured minus simulated when "
        "all that changes slowly is taken off. Everything below is in units of it; where the gap "
        "does not exceed what it gives, the verdict is no_gap."
    )
    return Section("2. The measurement noise", [words, Grid("", ["measured", "noise"], rows)])


def actuators_section(proof: Proof, driven_by: str) -> list[Section]:
    """Return what measured rotor speeds say of the actuators; nothing where there are none."""
    if not proof.actuators:
        return []
    words = (
        f"The model is driven by {driven_by}. The difference between rotor speeds that are asked "
        "for and measured is the flight controller's and the motors', no physics of the air: "
        "integrators and filters that the nominal rate loop has not show here."
    )
    parts: list[Part] = [words]
    for apart in proof.actuators:
        parts.append(_apart(apart))
    return [Section("Actuators, apart from the air", parts)]


def _apart(apart: Apart) -> Grid:
    scale = ", ".join(f"{s:.4f}" for s in apart.scale)
    turn = ", ".join(f"{mean:.2f} ± {spread:.2f}" for mean, spread in apart.turn)
    rows = [
        ("speeds change by", f"{apart.spread:.1f} rad/s"),
        ("off what is asked for, with the vehicle file's lag",
         f"{apart.rms:.1f} rad/s ({100 * max(apart.followed, 0.0):.0f} % of the change is given)"),
        ("lag that fits best", f"{1e3 * apart.time_constant:.1f} ms"),
        ("delay before it", f"{1e3 * apart.delay:.1f} ms"),
        ("measured over asked, by rotor", scale),
        ("what these leave", f"{apart.rms_fitted:.1f} rad/s"),
        ("thrust more than asked for", f"{apart.thrust[0]:.2f} ± {apart.thrust[1]:.2f} m/s²"),
        ("turning more than asked for, x y z", f"{turn} rad/s²"),
    ]  # fmt: skip
    note = "± is the spread over the flights."
    title = f"Against the {apart.asked_by}"
    return Grid(title, ["", ""], [[Cell(a), Cell(b)] for a, b in rows], note=note)
