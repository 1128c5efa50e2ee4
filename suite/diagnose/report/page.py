"""What a report shows: the answer in a sentence, what it does and means, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eval.effects import EFFECTS
from suite.common.charts import png, titled
from suite.common.report import Details, Links, Part, Picture, Report, Section
from suite.diagnose.by_views import ViewsDiagnosis
from suite.diagnose.data.windows import UNITS
from suite.diagnose.estimate.composites import in_words
from suite.diagnose.report.charts import (
    AFTER,
    BEFORE,
    FLOOR,
    gains_chart,
    held_out_chart,
    held_out_rollouts,
)
from suite.diagnose.report.parameters_json import cells, components, grid, short_name, size_words
from suite.diagnose.report.sections import (
    actuators_section,
    held_out_section,
    logs_section,
    noise_section,
    residual_section,
)
from suite.diagnose.verdict.checks import Checks
from suite.diagnose.verdict.diagnosis import Diagnosis
from tracks.common.grid import Cell, Grid

VERDICTS = {
    "no_gap": "Simulation and flights agree within the measurement noise.",
    "named": "The gap is explained.",
    "partly": "The gap is explained in part; a structured rest remains.",
    "unknown": "There is a gap that nothing in the catalogue explains.",
}
FILES = (
    ("vehicle.toml", "the vehicle with what was named; every command takes it"),
    ("diagnosis.json", "all numbers of this page"),
    ("recording.rrd", "held-out flights measured and simulated, before and after, for rerun"),
    ("plan/plan.json", "flights that separate what these could not"),
)
"""Beside the report, where they were written."""
RIVALS = 6
"""Other names in the table of what fits as well."""
STRETCH_S = 10.0
"""Length of the stretch in the picture [s]."""
WHAT = {"force": "acceleration", "torque": "angular acceleration"}
CHANNELS = (
    "As given and with what was named: what the model leaves, as RMS. Noise floor: what the noise "
    "of the measured velocities or rates alone would leave. Repeatability: how far the means of "
    "flights of the unchanged vehicle lie apart. Named: the share of the variance within a flight "
    "that the names close; black box: what a regression without any physics closes of it, fitted "
    "to the same flights. All on flights that took no part in finding or fitting anything."
)
FLIGHTS = (
    "The fall of the squared error of each flight under what the others' fit says, in units of "
    "independent noise. A name needs all flights but one."
)


def page(
    diagnosis: Diagnosis | ViewsDiagnosis,
    found: Mapping[str, Any],
    checks: Checks | None,
    toml: str,
    files: set[str],
) -> Report:
    """Return the report of a diagnosis; `found` is its JSON, and the words are taken from there.

    `checks` are there where rollouts were flown, `toml` is the vehicle file that was written, and
    `files` which of `FILES` there are.
    """
    if isinstance(diagnosis, Diagnosis):
        assert checks is not None
        gap = found["gap"]
        facts = {
            "gap before": f"{gap['before']:.2f}",
            "gap after": f"{gap['after']:.2f}",
            "noise floor": "1",
            "held out": _few(gap["held_out"]),
            "driven by": found["driven_by"],
        }
        picture, totals = _held_out(diagnosis, found), TOTALS
        details = [
            logs_section(diagnosis, checks),
            noise_section(diagnosis),
            *actuators_section(checks, diagnosis.input_source),
            _candidates(diagnosis),
            _identity(diagnosis, found),
            residual_section(diagnosis, found),
            held_out_section(diagnosis, found, checks),
        ]
    else:
        facts = {
            "flights": str(len(diagnosis.flights.names)),
            "reference": str(len(diagnosis.references)) if diagnosis.references else "none",
            "held out": ", ".join(found["gap"]["held_out"]),
            "rotors by": found["driven_by"],
        }
        picture, totals = _picture(diagnosis, found), VIEW_TOTALS
        details = [
            Section("Each view, axis by axis", [_channels(found)]),
            Section("Do the flights agree", _agreement(diagnosis)),
            Section("What the views compare", _views(diagnosis)),
        ]
    warnings = [Details("what was odd", "\n".join(found["warnings"]))]
    return Report(
        title=f"Diagnosis: {found['verdict']}",
        lead=found.get("headline") or _lead(found),
        facts={**facts, "took": f"{found['seconds']:.0f} s"},
        sections=[
            Section("What was measured, and what the model says", picture),
            Section("The answer in numbers", _answer(found, totals)),
            *details,
            _written(found, toml, files),
            *([Section("Warnings", warnings)] if found["warnings"] else []),
        ],
    )


def _lead(found: Mapping[str, Any]) -> str:
    names = " and ".join(
        " or ".join([effect["name"], *effect["alternatives"]]) for effect in found["effects"]
    )
    lead = VERDICTS[found["verdict"]]
    if names:
        lead += f" Named: {names}."
    if found["unexplained"]["where"]:
        lead += f" Unexplained: {found['unexplained']['where']}."
    return lead


def _few(names: list[str]) -> str:
    short = [short_name(name) for name in names]
    return ", ".join(short[:3]) + (f" and {len(short) - 3} more" if len(short) > 3 else "")


TOTALS = (
    "Values are totals: what the vehicle file had of an effect is replaced. Of the gap: the "
    "share that this effect takes away when it is added last. Chance gives a false name with "
    "a probability of at most {chance:.1g}."
)
VIEW_TOTALS = (
    "Totals: what the vehicle file had of an effect is replaced. 95 % with flights as draws."
)


def _answer(found: Mapping[str, Any], note: str) -> list[Part]:
    """Return the names, what they are and do, and their numbers."""
    effects = found["effects"]
    if not effects:
        return [f"{VERDICTS[found['verdict']]} Nothing was named: the vehicle file is as it was."]
    rows = [
        (
            effect["name"],
            ", ".join(effect["alternatives"]) or "none",
            effect.get("view", "whole"),
            one.label,
            *one.shown(),
            "exempt" if effect["gap_removed"] is None else f"{100 * effect['gap_removed']:.0f} %",
        )
        for effect in effects
        for one in sorted(components(effect), key=lambda one: not one.found)
    ]
    about = [EFFECTS[effect["name"]] for effect in effects]
    words: list[Part] = [f"{one.name}: {one.summary}: {one.equation}." for one in about]
    words += [f"{size_words(effect)}." for effect in effects]
    words += in_words([(e["name"], *e["alternatives"]) for e in effects])
    headers = [
        "effect", "not distinguishable from", "view", "parameter", "total", "95 %", "of the gap"
    ]  # fmt: skip
    note = note.format(chance=max(effect["p_value"] for effect in effects))
    words.append(grid("", headers, rows, note))
    return [*words, *(f"To separate {line}." for line in found["separate_with"])]


LEAST_FLOOR = 1e-9
"""A noise floor below this is that of what no log measured, in any unit."""


def _held_out(diagnosis: Diagnosis, found: Mapping[str, Any]) -> list[Part]:
    """Return measured, simulated, and simulated with what was named, as picture and numbers."""
    rows = []
    for horizon, groups in found["gap"]["channels"].items():
        for group, values in groups.items():
            floor = values["noise_floor"]
            if floor < LEAST_FLOOR:
                continue
            row = cells(horizon, f"{group} [{UNITS[group]}]")
            for key in ("before", "after"):
                tone = "good" if key == "after" and values[key] < 1.2 * floor else ""
                row.append(Cell(f"{values[key]:.4g}", tone))
            rows.append([*row, *cells(f"{floor:.4g}")])
    headers = ["rollout of", "RMS error", "as given", "with what was named", "noise floor"]
    picture = held_out_chart(*held_out_rollouts(diagnosis), diagnosis.sigma)
    return [Picture(picture, HELD_OUT), Grid("On held-out flights", headers, rows, note=FROM)]


HELD_OUT = (
    "A flight that took no part in finding or fitting anything, in rollouts of a second from "
    "measured states, along the axis where the model misses most."
)
FROM = (
    "Rollouts start from measured states; the noise floor is what the noise of the start and of "
    "the row compared would make of a perfect model."
)


def _candidates(diagnosis: Diagnosis) -> Section:
    scores, limits = diagnosis.search.first, diagnosis.limits
    named = {candidate.label for candidate in diagnosis.search.candidates}
    chance = scores[0].chance if scores else None
    least = 1.0 / (1 + limits.sign_draws)
    rows = [
        f"{s.candidate.label:32}{s.gain:>12.1f}"
        + (f"{s.p_value:>8.4f}  " if s.p_value > least else " " * 10)
        + ("named" if s.candidate.label in named else "")
        for s in scores
    ]
    words = (
        f"All {len(scores)} candidates, each fitted alone before anything was named. The gain is "
        "the fall of the whitened squared error on stretches that its fit did not see. The null: "
        f"the signs of whole stretches are shuffled {limits.sign_draws} times, and the best gain "
        "of all candidates is taken each time; p is how often that is as large, left out where it "
        f"never is (below {least:.2g}). One name follows another while p is at most "
        f"{limits.name_p_value:g}; then all are refitted jointly."
    )
    head = f"{'effect':32}{'gain':>12}{'p':>8}"
    return Section(
        "3. The candidates",
        [
            words,
            Picture(gains_chart(scores, chance, named), "The best fourteen; blue were named."),
            Details("all candidates", "\n".join([head, *rows])),
        ],
    )


def _identity(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    rows = []
    for one in diagnosis.search.named:
        ordered = sorted(one.worse_by.items(), key=lambda item: item[1])
        for label, worse_by in ordered[:RIVALS]:
            same = label.rstrip(" 1234") in one.rivals
            verdict = Cell("not separable", "bad") if same else Cell("ruled out")
            rows.append([*cells(one.candidate.label, label, f"{worse_by:.1f}"), verdict])
    headers = ["named", "in its place", "worse by", ""]
    note = (
        "Worse by: squared error in units of the noise, with one for each number that is fitted; "
        "9 is three standard errors. What was not fitted in a name's place was too far off."
    )
    parts: list[Part] = [Grid("", headers, rows, note=note)] if rows else []
    if not diagnosis.search.named:
        parts.append("Nothing was named, so that there is nothing to tell apart.")
    elif not found["separate_with"]:
        parts.append("No other name explains the same flights as well.")
    if found["separate_with"]:
        parts.append("suite diagnose --plan writes such flights as commanded trajectories.")
    return Section("4. What could stand in its place", parts)


def _written(found: Mapping[str, Any], toml: str, files: set[str]) -> Section:
    words = "Nothing was named: the vehicle file is as it was."
    if found["effects"]:
        words = "The vehicle file with the named effects, for every other command (--vehicle)."
    links = [(path, words) for path, words in FILES if path in files]
    parts: list[Part] = [words, Details("vehicle.toml", toml), Links(links)]
    plan = found.get("plan")
    if plan:
        rows = [
            (
                way["file"],
                way["trajectory"]["kind"],
                f"{way['trajectory']['duration_s']:g} s",
                f"{way['top_speed']:.1f} m/s",
                f"{way['top_acceleration']:.1f} m/s²",
                " x ".join(f"{size:.1f}" for size in way["room"]) + " m",
                way["flown"] or "",
            )
            for way in plan["flights"]
        ]
        headers = ["flight", "kind", "lasts", "speed", "acceleration", "needs", "flown as"]
        parts.append(grid("Flights to fly next", headers, rows, " ".join(plan["words"])))
    return Section("What was written", parts)


def _picture(found: ViewsDiagnosis, told: Mapping[str, Any]) -> list[Part]:
    """Return measured, simulated, and simulated with what was named, over a held-out stretch."""
    one = found.main
    before = one.held.left(one.search.start.theta)
    after = one.held.left(one.search.estimate.theta)
    axis = max(one.view.axes, key=lambda k: float(one.gap.closed[k] * one.gap.variance[k]))
    rows = before.flight == before.flight[0]
    middle = before.middle_s[rows]
    moved = np.abs(before.residual[rows, axis] - after.residual[rows, axis])
    count = max(int((middle < middle[0] + STRETCH_S).sum()), 2)
    sums = np.convolve(moved, np.ones(min(count, len(moved))), "valid")
    first = int(sums.argmax())
    shown = slice(first, first + count)
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots()
    measured = (before.value + before.residual)[rows, axis][shown]
    time_s = middle[shown] - middle[shown][0]
    axes.plot(time_s, measured, color=FLOOR, lw=1.6, label="measured")
    axes.plot(time_s, before.value[rows, axis][shown], color=BEFORE, lw=1.4, label="simulated")
    named = bool(one.names)
    if named:
        with_it = measured - after.residual[rows, axis][shown]
        axes.plot(time_s, with_it, color=AFTER, lw=1.4, label="with what was named")
    axes.set_xlabel("time [s]", fontsize=8)
    axes.legend(fontsize=8, frameon=False, ncols=3)
    titled(axes, f"{WHAT[one.view.name].capitalize()} along body {'xyz'[axis]} [{one.view.unit}]")
    name = told["gap"]["held_out"][0]
    caption = f"A stretch of {name}, which took no part in finding or fitting anything."
    return [Picture(png(figure), caption)]


def _channels(told: Mapping[str, Any]) -> Grid:
    def short(value: float | None, percent: bool = False) -> str:
        if value is None:
            return "not identifiable"
        return f"{100 * value:.0f} %" if percent else f"{value:.3g}"

    rows = [
        (
            f"{view} {axis}",
            short(one["before"]),
            short(one["after"]),
            short(one["noise_floor"]),
            short(one["repeatability"]),
            short(one["closed"], percent=True),
            short(one["explainable"], percent=True),
        )
        for view, axes in told["gap"]["channels"].items()
        for axis, one in axes.items()
    ]
    headers = ["", "as given", "with names", "noise floor", "repeatability", "named", "black box"]
    return grid("", headers, rows, CHANNELS)


def _agreement(found: ViewsDiagnosis) -> list[Part]:
    parts: list[Part] = []
    for result, name in found.named:
        if name.gains:
            rows = [(f"{k + 1}", f"{gain:.1f}") for k, gain in enumerate(name.gains)]
            title = f"{result.view.name}: {name.candidate.label}"
            parts.append(grid(title, ["fitted flight", "gain"], rows, FLIGHTS))
    if found.spread is not None:
        parts.append(
            f"The {len(found.references)} reference flights differ as though each rotor's thrust "
            f"were off by {100 * found.spread.share:.1f} % from flight to flight "
            f"({found.spread.freedom} degrees of freedom); along an axis its own differences count "
            "next to that. A change is named where it stands out of them."
        )
    return parts or ["Nothing was named on which flights could agree."]


def _views(found: ViewsDiagnosis) -> list[Part]:
    words: list[Part] = [
        f"{one.view.name}: {one.view.about} ({found.flights.source}), smoothed over "
        f"{one.view.width_s:g} s, along body {', '.join('xyz'[axis] for axis in one.view.axes)}."
        for one in found.results
    ]
    return words
