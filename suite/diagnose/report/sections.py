"""A report's sections: logs, noise, actuators, candidates, rivals, remaining error, evidence."""

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
"""Logs in the table."""


def logs_section(logs: Sequence[FlightLog]) -> Section:
    """Return what the logs hold."""
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "others"]
    more = len(logs) - SHOWN
    rows = [_facts(log) for log in logs[:SHOWN]]
    return Section("The logs", [grid("", headers, rows, f"And {more} more." if more > 0 else "")])


def _facts(log: FlightLog) -> tuple[str, ...]:
    """Return the row of a log; rows are incomplete where a part of state or command is missing."""
    there = {
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
        ", ".join(name for name, is_there in there.items() if is_there) or "none",
    )


def noise_section(diagnosis: Diagnosis) -> Section:
    """Return the noise of every channel."""
    sigma = of_rollouts(diagnosis.main.search.last).noise.sigma
    rows = [
        (f"{name} [{UNITS[name]}]", ", ".join(f"{v:.3g}" for v in values))
        for name, place in SLICES.items()
        if np.isfinite(values := sigma[place]).any()
    ]
    words = (
        "Standard deviation by axis, estimated from the residual of measured minus simulated "
        "without its slow part. Everything below is in units of it; where the gap does not exceed "
        "that of the noise, the verdict is no_gap."
    )
    return Section("The measurement noise", [words, grid("", ["measured", "noise"], rows)])


def actuators_section(found: Mapping[str, Any]) -> list[Section]:
    """Return measured rotor speeds compared with commanded ones; nothing without measured ones.

    `found` is the JSON.
    """
    if not found.get("actuators"):
        return []
    words = (
        f"The model is driven by {found['driven_by']}. The difference between commanded and "
        "measured rotor speeds is caused by the flight controller and the motors, not by the air: "
        "integrators and filters which the nominal rate loop lacks are visible here."
    )
    grids = [_mismatch(one) for one in found["actuators"]]
    return [Section("Actuators, apart from the air", [words, *grids])]


def _mismatch(one: Mapping[str, Any]) -> Grid:
    def spread(pair: Sequence[float]) -> str:
        return f"{pair[0]:.2f} ± {pair[1]:.2f}"

    given = f"{100 * max(one['followed'], 0.0):.0f} % of the change is given"
    rows = [
        ("speeds change by", f"{one['spread']:.1f} rad/s"),
        ("difference, with the vehicle file's lag", f"{one['rms']:.1f} rad/s ({given})"),
        ("lag that fits best", f"{1e3 * one['time_constant']:.1f} ms"),
        ("delay before it", f"{1e3 * one['delay']:.1f} ms"),
        ("measured over commanded, by rotor", ", ".join(f"{s:.4f}" for s in one["scale"])),
        ("difference with these", f"{one['rms_fitted']:.1f} rad/s"),
        ("excess thrust", f"{spread(one['thrust'])} m/s²"),
        ("excess angular acceleration, x y z", f"{', '.join(map(spread, one['turn']))} rad/s²"),
    ]
    note = "± is the spread over the flights."
    return grid(f"Against the {one['commanded_by']}", ["", ""], rows, note)


HORIZON = "0.5 s"
"""Of the rollouts in the comparison with the black box."""
BLACK_BOX = (
    "Next to it a Delta Action Model: a recurrent network that corrects the body's acceleration "
    "and turning from velocity, attitude and command, fitted by gradients through the same "
    "rollouts of the same flights. It has no name and no number to write into a vehicle file."
)


RIVALS = 6
"""Largest number of alternatives to an effect in the table."""


def candidates_section(diagnosis: Diagnosis) -> Section:
    """Return the gain of each candidate alone, by source."""
    parts: list[Part] = []
    for one in diagnosis.findings:
        scores, limits = one.search.first, one.source.limits
        if not scores:
            continue
        named, least = {candidate.label for candidate in one.search.candidates}, 0.0005
        rows = [
            f"{s.candidate.label:32}{s.gain:>12.1f}"
            + (f"{s.p_value:>8.4f}  " if s.p_value > least else " " * 10)
            + ("named" if s.candidate.label in named else "")
            for s in scores
        ]
        head = f"{'effect':32}{'gain':>12}{'p':>8}"
        parts += [
            f"{one.source.name.capitalize()}: all {len(scores)} candidates, each fitted alone "
            "before anything was named. The gain is the fall of the whitened squared error on "
            "stretches that its fit did not see; p is how often the best of all candidates gains "
            f"as much by chance, left out below {least:g}. One name follows another while p is at "
            f"most {limits.name_p_value:g}; then all are refitted jointly.",
            Picture(
                gains_chart(scores, scores[0].chance, named), "The best fourteen; blue were named."
            ),
            Details("all candidates", "\n".join([head, *rows])),
        ]
    return Section("The candidates", parts)


def rivals_section(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    """Return what was fitted in place of each named effect; `found` is the JSON."""
    rows = []
    for _, one in diagnosis.named:
        ordered = sorted(one.worse_by.items(), key=lambda item: item[1])
        for label, worse_by in ordered[:RIVALS]:
            same = label.rstrip(" 1234") in one.rivals
            verdict = Cell("not separable", "bad") if same else Cell("ruled out")
            rows.append([*cells(one.candidate.label, label, f"{worse_by:.1f}"), verdict])
    headers = ["named", "in its place", "worse by", ""]
    note = (
        "Worse by: squared error in units of the noise, with one for each parameter that is "
        "fitted; 9 is three standard errors. What was not fitted in a name's place was too far off."
    )
    parts: list[Part] = [Grid("", headers, rows, note=note)] if rows else []
    if not diagnosis.named:
        parts.append("Nothing was named, so that nothing has a rival.")
    elif not found["separate_with"]:
        parts.append("No other name explains the same flights as well.")
    return Section("What could stand in its place", parts)


def residual_section(found: Mapping[str, Any]) -> Section:
    """Return the residual after the named effects; `found` is the JSON."""
    left = found["unexplained"]
    words = "No structure beyond the measurement noise remains."
    if left["where"]:
        words = f"{100 * left['share']:.0f} % of the gap remains: {left['where']}."
    parts: list[Part] = [words]
    if left.get("shapes"):
        rows = [(s["label"], f"{s['gain']:.1f}", f"{s['p_value']:.3f}") for s in left["shapes"]]
        note = (
            "A force or torque outside the catalogue, as a simple function of the state: its gain "
            "on left-out stretches, and its p-value."
        )
        parts.append(
            grid("Shapes without a name", ["remaining error as a", "gain", "p"], rows, note)
        )
        rows = [(axis, f"{p:.2g}") for axis, p in left["coloured"].items()]
        note = "P-value: how often noise alone has as much energy in a smooth disturbance."
        parts.append(grid("Random disturbances", ["axis", "p"], rows, note))
    return Section("Remaining error", parts)


def evidence_section(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    """Return the gap on held-out flights, with controls; `found` is the JSON."""
    seed, main = diagnosis.seed, diagnosis.main
    gaps = [("as given", main.before, BEFORE)]
    if main.control is not None:
        gaps.append((f"wrong: {main.control[0]}", main.control[1], WRONG))
    if len(main.without) > 1:
        gaps += [(f"without {label}", gap, BEFORE) for label, gap in main.without.items()]
    if main.names:
        gaps.append(("with what was named", main.after, AFTER))
    before, floor = main.before.rms, main.before.floor
    rows = [
        (label, *_gap_cells(gap.rms, gap.ci95(seed), before, floor, 3)) for label, gap, _ in gaps
    ]
    held = ", ".join(found["gap"]["held_out"])
    words = (
        f"{main.source.measure}. Held out: {held}; they took no part in finding or fitting "
        "anything."
    )
    note = (
        "95 % by drawing neighbouring stretches in blocks. Wrong: the best effect that is neither "
        "named nor a rival, fitted to the same flights in the same way."
    )
    flown, speed = main.source.rollouts, None
    if flown is not None:
        speed = np.linalg.norm(np.asarray(flown.held.vel_w), axis=1)
    parts: list[Part] = [
        words,
        Picture(gap_chart(gaps, speed, seed), "Bars are 95 %; dots are rollouts."),
        grid("", ["vehicle", "gap", "95 %", "of the gap removed"], rows, note),
    ]
    if flown is not None:
        parts += _black_box(found.get("black_box"))
    return Section("The evidence", parts)


def _black_box(found: Mapping[str, Any] | None) -> list[Part]:
    """Return the comparison with a Delta Action Model; `found` is its JSON, None without one."""
    if found is None:
        return [
            "A black box on the same split, and outside the speeds of its fit: "
            "suite diagnose --compare-delta."
        ]
    sides = [side for side in (found["held_out"], found["outside"]) if side]
    chart = Picture(black_box_chart(sides), "Bars are 95 %; 1 is the noise floor.")
    parts: list[Part] = [BLACK_BOX, chart, *map(_comparison, sides)]
    if found["outside"] is None:
        parts.append("There are too few stretches to fit slow ones and judge fast ones.")
    return parts


AGREEMENT = (
    "The fall of the squared error of each flight with parameters that were fitted to the others, "
    "in units of independent noise. An effect is named only if all flights but one agree."
)


def agreement_section(diagnosis: Diagnosis) -> Section:
    """Return what each source compares, and whether the flights agree on the names."""
    parts: list[Part] = [
        f"{one.source.name}: {one.source.about}, in means or stretches of "
        f"{one.source.horizon_s:g} s; driven by {diagnosis.flights.driven_by}."
        for one in diagnosis.findings
    ]
    for one, name in diagnosis.named:
        if name.gains:
            rows = [(f"{k + 1}", f"{gain:.1f}") for k, gain in enumerate(name.gains)]
            title = f"{one.source.name}: {name.candidate.label}"
            parts.append(grid(title, ["fitted flight", "gain"], rows, AGREEMENT))
    return Section("Do the flights agree", [*parts, *diagnosis.flights.compares])


def _comparison(side: Mapping[str, Any]) -> Grid:
    before = side["before"]["gap"]
    rows = [
        (
            label,
            *_gap_cells(one["gap"], one["ci95"], before, 1.0, 2),
            *(f"{error:.3g}" for error in one["rollouts"][HORIZON].values()),
        )
        for label, one, _ in labelled_gaps(side)
    ]
    names = [f"{group} [{UNITS[group]}]" for group in side["before"]["rollouts"][HORIZON]]
    headers = ["", "gap", "95 %", "removed", *names]
    count = side["stretches"]
    note = (
        f"{count['fitted']} stretches fitted, {count['judged']} judged. The last columns: RMS "
        f"errors of rollouts of {HORIZON}."
    )
    return grid(f"On {side['judged_on']}", headers, rows, note)


def _gap_cells(
    gap: float, ci95: Sequence[float], before: float, floor: float, digits: int
) -> tuple[str, str, str]:
    """Return a gap, its interval, and the share of `before` above the floor that it removes."""
    removed = ""
    if gap != before and before > floor:
        removed = f"{100 * (before - gap) / (before - floor):.0f} %"
    return f"{gap:.{digits}f}", f"{ci95[0]:.{digits}f} to {ci95[1]:.{digits}f}", removed
