"""What the report of a diagnosis shows: the answer first, then the eight steps that led to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from eval.effects import EFFECTS
from suite.common.report import Details, Links, Part, Picture, Report, Section
from suite.diagnose.checks.checks import Checks
from suite.diagnose.data.windows import UNITS
from suite.diagnose.estimate.composites import in_words
from suite.diagnose.report.charts import disagreement_chart, drift_chart, gains_chart
from suite.diagnose.report.parameters_json import cells, components, grid, short_name, size_words
from suite.diagnose.report.sections import (
    actuators_section,
    held_out_section,
    logs_section,
    noise_section,
    residual_section,
)
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
    ("plan/plan.json", "flights that would tell apart what these could not"),
)
"""Beside the report, where they were written."""
RIVALS = 6
"""Other names in the table of what fits as well."""


def page(
    diagnosis: Diagnosis, found: Mapping[str, Any], checks: Checks, toml: str, files: set[str]
) -> Report:
    """Return the report of a diagnosis; `found` is its JSON, and the words are taken from there.

    `toml` is the vehicle file that was written, `files` which of `FILES` there are.
    """
    gap = found["gap"]
    sections = [
        Section("The answer", _answer(found)),
        logs_section(diagnosis, checks),
        noise_section(diagnosis),
        _disagreement(found, checks),
        *actuators_section(checks, diagnosis.input_source),
        _candidates(diagnosis),
        _identity(diagnosis, found),
        residual_section(diagnosis, found),
        held_out_section(diagnosis, found, checks),
        _written(found, toml, files),
    ]
    if found["warnings"]:
        sections.append(
            Section("Warnings", [Details("what was odd", "\n".join(found["warnings"]))])
        )
    return Report(
        title=f"Diagnosis: {found['verdict']}",
        lead=_lead(found),
        facts={
            "gap before": f"{gap['before']:.2f}",
            "gap after": f"{gap['after']:.2f}",
            "noise floor": "1",
            "held out": _few(gap["held_out"]),
            "driven by": found["driven_by"],
            "took": f"{found['seconds']:.0f} s",
        },
        sections=sections,
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


def _answer(found: Mapping[str, Any]) -> list[Part]:
    if not found["effects"]:
        return [VERDICTS[found["verdict"]]]
    rows = [
        (
            effect["name"],
            ", ".join(effect["alternatives"]) or "none",
            one.label,
            *one.shown(),
            "exempt" if effect["gap_removed"] is None else f"{100 * effect['gap_removed']:.0f} %",
        )
        for effect in found["effects"]
        for one in sorted(components(effect), key=lambda one: not one.found)
    ]
    headers = ["effect", "not distinguishable from", "parameter", "total", "95 %", "of the gap"]
    words = [
        f"{effect['name']}: {EFFECTS[effect['name']].summary}: {EFFECTS[effect['name']].equation}."
        for effect in found["effects"]
    ]
    words += [f"{size_words(effect)}." for effect in found["effects"]]
    words += in_words([(e["name"], *e["alternatives"]) for e in found["effects"]])
    note = (
        "Values are totals: what the vehicle file had of an effect is replaced. Of the gap: the "
        "share that this effect takes away when it is added last. Chance gives a false name with "
        f"a probability of at most {max(effect['p_value'] for effect in found['effects']):.1g}."
    )
    return [*words, grid("", headers, rows, note)]


LEAST_FLOOR = 1e-9
"""A noise floor below this is that of what no log measured, in any unit."""


def _disagreement(found: Mapping[str, Any], checks: Checks) -> Section:
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
    told = found["disagreement"]
    words = [
        "Rollouts start from measured states; the noise floor is what the noise of the start and "
        "of the row compared would make of a perfect model."
    ]
    if told["before"]:
        words.append(f"As given, errors stand out most in {told['before']}.")
    else:
        words.append("As given, no error stands out from the noise.")
    if told["after"]:
        words.append(f"With what was named, most in {told['after']}.")
    return Section(
        "3. Where they disagree",
        [
            *words,
            Picture(disagreement_chart(checks.disagreement), ERRORS),
            Picture(drift_chart(checks.disagreement), DRIFT),
            Grid("On held-out flights", headers, rows),
        ],
    )


ERRORS = (
    "Errors of rollouts of 0.5 s over their noise floor, all flights, against what was flown at "
    "their starts. A line that stays at the dotted one is noise; one that rises says with what the "
    "disagreement grows."
)
DRIFT = (
    "Measured minus simulated in the body axes of the start: the mean acceleration over 0.5 s that "
    "the model lacks, and the turn that it lacks. Dots are rollouts; lines are means with 95 %."
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
        "4. The candidates",
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
            verdict = Cell("cannot be told apart", "bad") if same else Cell("ruled out")
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
    parts += [f"What would tell {line}." for line in found["separate_with"]]
    if found["separate_with"]:
        parts.append("suite diagnose --plan writes such flights as commanded trajectories.")
    return Section("5. What could stand in its place", parts)


def _written(found: Mapping[str, Any], toml: str, files: set[str]) -> Section:
    links = [(path, words) for path, words in FILES if path in files]
    named = bool(found["effects"])
    words = (
        "The vehicle file with the named effects, for every other command (--vehicle)."
        if named
        else "Nothing was named: the vehicle file is as it was."
    )
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
    return Section("8. What was written", parts)
