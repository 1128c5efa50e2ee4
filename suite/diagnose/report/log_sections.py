"""The report's part about the logs: what they hold, their faults, their noise, the actuators."""

from __future__ import annotations

import numpy as np

from eval.effects import EFFECTS
from suite.common.report import Part, Section
from suite.diagnose.checks.actuators import ActuatorMismatch
from suite.diagnose.checks.checks import Checks
from suite.diagnose.checks.kinematics import Kinematics
from suite.diagnose.data.windows import SLICES, UNITS
from suite.diagnose.report.parameters_json import grid, short_name
from suite.diagnose.verdict.diagnosis import Diagnosis
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
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "besides"]
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
