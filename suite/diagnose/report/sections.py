"""Builds the folded sections of a diagnosis report, from its logs to its evidence.

Each function returns one section, from the diagnosis or from its JSON (`result`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.common.report import Details, Part, Picture, Section
from suite.diagnose.data.windows import SLICES, UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.report.charts import (
    AFTER,
    BEFORE,
    WRONG,
    black_box_chart,
    gains_chart,
    gap_chart,
    labelled_gaps,
)
from suite.diagnose.report.summary import cells, grid, short_name
from suite.diagnose.sources.rollout_source import of_rollouts
from tracks.common.grid import Cell, Grid

SHOWN = 12
"""Largest number of logs in the table of logs."""
RIVALS = 6
"""Largest number of alternatives ("rivals") to each effect in the table of alternatives."""


def logs_section(logs: Sequence[FlightLog]) -> Section:
    """Return a table of the logs."""
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "others"]
    others = len(logs) - SHOWN
    rows = [_facts(log) for log in logs[:SHOWN]]
    return Section(
        "The logs", [grid("", headers, rows, f"And {others} more." if others > 0 else "")]
    )


def _facts(log: FlightLog) -> tuple[str, ...]:
    """Return the table row of a log.

    The row has the share of the log's rows that are incomplete: they lack a state or a command.
    """
    optional = {
        "commands": log.thrust_cmd is not None,
        "velocity": not log.velocity_derived,
        "rotor speeds": log.rotor_speed is not None,
        "rotor commands": log.rotor_speed_cmd is not None,
        "accelerometer": log.acc_b is not None,
        "voltage": log.voltage is not None,
    }
    steps, speed = np.diff(log.time_s), log.speed[np.isfinite(log.speed)]
    return (
        short_name(log.name),
        f"{log.duration_s:.1f} s",
        f"{len(log.time_s)}",
        f"{1.0 / float(np.median(steps)):.0f} Hz",
        f"{1e3 * float(steps.max()):.0f} ms",
        f"{100 * float(1.0 - log.whole.mean()):.1f} %",
        f"{speed.max():.1f} m/s" if len(speed) else "",
        ", ".join(name for name, is_logged in optional.items() if is_logged) or "none",
    )


def noise_section(diagnosis: Diagnosis) -> Section:
    """Return a table of the measurement noise of every channel."""
    sigma = of_rollouts(diagnosis.main.search.last).noise.sigma
    rows = [
        (f"{name} [{UNITS[name]}]", ", ".join(f"{v:.3g}" for v in values))
        for name, place in SLICES.items()
        if np.isfinite(values := sigma[place]).any()
    ]
    words = (
        "Standard deviation by axis, estimated from measured minus simulated values without their "
        "slow part. Squared errors below are in units of it. If the gap does not exceed that of "
        "the noise, the verdict is no_gap."
    )
    return Section("The measurement noise", [words, grid("", ["measured", "noise"], rows)])


def actuators_section(result: Mapping[str, Any]) -> list[Section]:
    """Return a section that compares measured and commanded rotor speeds.

    The list is empty if the logs have no measured speeds.
    """
    if not result.get("actuators"):
        return []
    words = (
        f"The input of the model is {result['driven_by']}. The flight controller and the motors "
        "cause the difference between commanded and measured rotor speeds, not the air. It shows "
        "integrators and filters that the nominal rate loop lacks."
    )
    grids = [_mismatch(mismatch) for mismatch in result["actuators"]]
    return [Section("Actuators, apart from the air", [words, *grids])]


def _mismatch(mismatch: Mapping[str, Any]) -> Grid:
    """Return a table that compares measured rotor speeds with one kind of command."""

    def spread(pair: Sequence[float]) -> str:
        """Return a mean and a standard deviation as text."""
        return f"{pair[0]:.2f} ± {pair[1]:.2f}"

    explained = f"{100 * max(mismatch['followed'], 0.0):.0f} % of the variance is explained"
    turn = ", ".join(map(spread, mismatch["turn"]))
    rows = [
        ("standard deviation of the speeds", f"{mismatch['spread']:.1f} rad/s"),
        ("difference, with the vehicle file's lag", f"{mismatch['rms']:.1f} rad/s ({explained})"),
        ("lag that fits best", f"{1e3 * mismatch['time_constant']:.1f} ms"),
        ("delay before it", f"{1e3 * mismatch['delay']:.1f} ms"),
        ("measured over commanded, by rotor", ", ".join(f"{s:.4f}" for s in mismatch["scale"])),
        ("difference with these", f"{mismatch['rms_fitted']:.1f} rad/s"),
        ("excess thrust", f"{spread(mismatch['thrust'])} m/s²"),
        ("excess angular acceleration, x y z", f"{turn} rad/s²"),
    ]
    note = "± is the spread over the flights."
    return grid(f"Compared with the {mismatch['commanded_by']}", ["", ""], rows, note)


HORIZON = "0.5 s"
"""Length of the rollouts in the comparison with the black box."""
BLACK_BOX = (
    "For comparison, a Delta Action Model was fitted to the same flights: a recurrent network that "
    "corrects the body's acceleration and angular acceleration from velocity, attitude and "
    "command. It is fitted by gradients through the same rollouts. It names no cause, and has no "
    "number to write into a vehicle file."
)
"""Explanation of the black box."""
LEAST_P = 0.0005
"""P-values up to this are not printed. The null distribution (without any effect) has about two
thousand draws, so smaller values are not resolved."""


def candidates_section(diagnosis: Diagnosis) -> Section:
    """Return the gain of each candidate when it is fitted alone, for each source of evidence."""
    parts: list[Part] = []
    for finding in diagnosis.findings:
        scores, limits = finding.search.first, finding.source.limits
        if not scores:
            continue
        named = {candidate.label for candidate in finding.search.candidates}
        rows = [
            f"{s.candidate.label:32}{s.gain:>12.1f}"
            + (f"{s.p_value:>8.4f}  " if s.p_value > LEAST_P else " " * 10)
            + ("named" if s.candidate.label in named else "")
            for s in scores
        ]
        head = f"{'effect':32}{'gain':>12}{'p':>8}"
        parts += [
            f"{finding.source.name.capitalize()}: all {len(scores)} candidates, each fitted alone "
            "before anything was named. The gain is the fall of the whitened squared error on "
            "stretches that were left out of its fit; p is the probability that the best of all "
            f"candidates gains as much by chance, left out up to {LEAST_P:g}. Effects are named "
            f"one after another while p is at most {limits.name_p_value:g}; then all are refitted "
            "jointly.",
            Picture(
                gains_chart(scores, scores[0].chance, named), "The best fourteen; blue were named."
            ),
            Details("all candidates", "\n".join([head, *rows])),
        ]
    return Section("The candidates", parts)


def rivals_section(diagnosis: Diagnosis, result: Mapping[str, Any]) -> Section:
    """Return a table of other effects that were fitted in place of each named one."""
    rows = []
    for _, named in diagnosis.named:
        ordered = sorted(named.worse_by.items(), key=lambda item: item[1])
        for label, worse_by in ordered[:RIVALS]:
            is_rival = label.rstrip(" 1234") in named.rivals  # a label may end in a motor's number
            verdict = Cell("not separable", "bad") if is_rival else Cell("ruled out")
            rows.append([*cells(named.candidate.label, label, f"{worse_by:.1f}"), verdict])
    headers = ["named", "alternative", "worse by", ""]
    note = (
        "Worse by: squared error in units of the noise, plus one for each fitted parameter; 9 is "
        "three standard errors. Effects without a row were too far off to be fitted."
    )
    parts: list[Part] = [Grid("", headers, rows, note=note)] if rows else []
    if not diagnosis.named:
        parts.append("Nothing was named, so there are no alternatives.")
    elif not result["separate_with"]:
        parts.append("No other effect explains the same flights as well.")
    return Section("Alternatives to the named effects", parts)


def residual_section(result: Mapping[str, Any]) -> Section:
    """Return the error that remains with the named effects, and its structure."""
    remaining = result["unexplained"]
    words = "No structure beyond the measurement noise remains."
    if remaining["where"]:
        words = f"{100 * remaining['share']:.0f} % of the gap remains: {remaining['where']}."
    parts: list[Part] = [words]
    if remaining.get("shapes"):
        shapes = remaining["shapes"]
        rows = [(s["label"], f"{s['gain']:.1f}", f"{s['p_value']:.3f}") for s in shapes]
        note = (
            "A force or torque outside the catalogue, as a simple function of the state: its gain "
            "on left-out stretches, and its p-value."
        )
        headers = ["remaining error as a", "gain", "p"]
        parts.append(grid("Functions of the state", headers, rows, note))
        rows = [(axis, f"{p:.2g}") for axis, p in remaining["coloured"].items()]
        note = "P-value: probability that noise alone has as much energy in a smooth disturbance."
        parts.append(grid("Random disturbances", ["axis", "p"], rows, note))
    return Section("Remaining error", parts)


def evidence_section(diagnosis: Diagnosis, result: Mapping[str, Any]) -> Section:
    """Return the gaps on held-out flights, in a chart and a table.

    They are those of the vehicle as given, with the named effects, and with a wrong effect.
    """
    seed, main = diagnosis.seed, diagnosis.main
    gaps = [("as given", main.before, BEFORE)]
    if main.control is not None:
        gaps.append((f"wrong: {main.control[0]}", main.control[1], WRONG))
    if len(main.without) > 1:
        gaps += [(f"without {label}", gap, BEFORE) for label, gap in main.without.items()]
    if main.names:
        gaps.append(("with the named effects", main.after, AFTER))
    before, floor = main.before.rms, main.before.floor
    rows = [
        (label, *_gap_cells(gap.rms, gap.ci95(seed), before, floor, 3)) for label, gap, _ in gaps
    ]
    held = ", ".join(result["gap"]["held_out"])
    words = f"{main.source.measure}. Held out of search and fits: {held}."
    note = (
        "95 %: bootstrap over blocks of neighbouring stretches. Wrong: the best effect that is "
        "neither named nor an alternative, fitted to the same flights in the same way."
    )
    flown, start_speed = main.source.rollouts, None
    if flown is not None:
        start_speed = np.linalg.norm(np.asarray(flown.held.vel_w), axis=1)
    parts: list[Part] = [
        words,
        Picture(gap_chart(gaps, start_speed, seed), "Bars are 95 %; dots are rollouts."),
        grid("", ["vehicle", "gap", "95 %", "of the gap removed"], rows, note),
    ]
    if flown is not None:
        parts += _black_box(result.get("black_box"))
    return Section("The evidence", parts)


def _black_box(result: Mapping[str, Any] | None) -> list[Part]:
    """Return the comparison with a Delta Action Model; `result` is its JSON, None without one."""
    if result is None:
        return [
            "suite diagnose --compare-delta compares this with a black box, on the same flights "
            "and on faster ones than those of its fit."
        ]
    sides = [side for side in (result["held_out"], result["outside"]) if side]
    chart = Picture(black_box_chart(sides), "Bars are 95 %; 1 is the noise floor.")
    parts: list[Part] = [BLACK_BOX, chart, *map(_comparison, sides)]
    if result["outside"] is None:
        parts.append("There are too few stretches to fit slow ones and test on fast ones.")
    return parts


AGREEMENT = (
    "The fall of the squared error of each flight with parameters that were fitted to the others, "
    "in units of independent noise. An effect is named only if all flights but one agree."
)
"""Explanation of the table of flights."""


def agreement_section(diagnosis: Diagnosis) -> Section:
    """Return what each source compares, and how much each flight supports the named effects."""
    parts: list[Part] = [
        f"{finding.source.name}: {finding.source.about}, in means or stretches of "
        f"{finding.source.horizon_s:g} s; driven by {diagnosis.flights.driven_by}."
        for finding in diagnosis.findings
    ]
    for finding, named in diagnosis.named:
        if named.gains:
            rows = [(f"{k + 1}", f"{gain:.1f}") for k, gain in enumerate(named.gains)]
            title = f"{finding.source.name}: {named.candidate.label}"
            parts.append(grid(title, ["fitted flight", "gain"], rows, AGREEMENT))
    return Section("Do the flights agree", [*parts, *diagnosis.flights.compares])


def _comparison(side: Mapping[str, Any]) -> Grid:
    """Return a table of the gaps of the given vehicle, the named effects and the black box.

    `side` is one of the two comparisons in `black_box` of diagnosis.json.
    """
    before = side["before"]["gap"]
    rows = [
        (
            label,
            *_gap_cells(gap["gap"], gap["ci95"], before, 1.0, 2),
            *(f"{error:.3g}" for error in gap["rollouts"][HORIZON].values()),
        )
        for label, gap, _ in labelled_gaps(side)
    ]
    names = [f"{group} [{UNITS[group]}]" for group in side["before"]["rollouts"][HORIZON]]
    headers = ["", "gap", "95 %", "removed", *names]
    count = side["stretches"]
    note = (
        f"{count['fitted']} stretches fitted, {count['judged']} tested. The last columns: RMS "
        f"errors of rollouts of {HORIZON}."
    )
    return grid(f"On {side['judged_on']}", headers, rows, note)


def _gap_cells(
    gap: float, ci95: Sequence[float], before: float, floor: float, digits: int
) -> tuple[str, str, str]:
    """Return as texts a gap, its interval, and the share of the gap that was removed.

    The share is that of the gap `before` minus the noise floor.
    """
    removed = ""
    if gap != before and before > floor:
        removed = f"{100 * (before - gap) / (before - floor):.0f} %"
    return f"{gap:.{digits}f}", f"{ci95[0]:.{digits}f} to {ci95[1]:.{digits}f}", removed
