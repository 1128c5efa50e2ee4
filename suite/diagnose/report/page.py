"""What the report of a diagnosis shows: the answer first, then the eight steps that led to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from eval.effects import EFFECTS
from suite.common.report import Cell, Details, Grid, Links, Part, Picture, Report, Section
from suite.diagnose.data.windows import UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.fit.permutation import FLIPS
from suite.diagnose.fit.search import P_VALUE
from suite.diagnose.report.answer import components
from suite.diagnose.report.charts import drift_chart, gains_chart, where_chart
from suite.diagnose.report.logs import actuators_section, logs_section, noise_section
from suite.diagnose.report.proof import evidence_section, rest_section
from suite.diagnose.verdict.proof import Proof

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
    diagnosis: Diagnosis, found: Mapping[str, Any], proof: Proof, toml: str, files: set[str],
    seed: int,
) -> Report:  # fmt: skip
    """Return the report of a diagnosis.

    Args:
        diagnosis: the diagnosis.
        found: its JSON.
        proof: what stands beside the names.
        toml: the vehicle file that was written.
        files: which of `FILES` there are.
        seed: of the intervals' draws.
    """
    gap = found["gap"]
    sections = [
        Section("The answer", _answer(found)),
        logs_section(diagnosis, proof),
        noise_section(diagnosis),
        _where(found, proof),
        *actuators_section(proof, diagnosis.driven_by),
        _candidates(diagnosis),
        _identity(diagnosis, found),
        rest_section(diagnosis, found),
        evidence_section(diagnosis, found, proof, seed),
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
    short = [name.replace("\\", "/").rsplit("/", 1)[-1] for name in names]
    return ", ".join(short[:3]) + (f" and {len(short) - 3} more" if len(short) > 3 else "")


def _answer(found: Mapping[str, Any]) -> list[Part]:
    if not found["effects"]:
        return [VERDICTS[found["verdict"]]]
    rows = []
    for effect in found["effects"]:
        removed, chance = effect["gap_removed"], effect["p_value"]
        for label, value, span in components(effect["parameters"]):
            rows.append(
                [
                    Cell(effect["name"]),
                    Cell(", ".join(effect["alternatives"]) or "none"),
                    Cell(label),
                    Cell("not seen" if value is None else _number(value)),
                    Cell("" if span is None else f"{_number(span[0])} to {_number(span[1])}"),
                    Cell("exempt" if removed is None else f"{100 * removed:.0f} %"),
                    Cell(f"{chance:.2g}"),
                ]
            )
    headers = ["effect", "cannot be told from", "parameter", "total", "95 %", "of the gap", "p"]
    words = [
        f"{effect['name']}: {EFFECTS[effect['name']].summary}: {EFFECTS[effect['name']].equation}."
        for effect in found["effects"]
    ]
    note = (
        "Values are totals: what the vehicle file had of an effect is replaced. Of the gap: the "
        "share that this effect takes away when it is added last."
    )
    return [*words, Grid("", headers, rows, note=note)]


def _where(found: Mapping[str, Any], proof: Proof) -> Section:
    rows = []
    for horizon, groups in found["gap"]["channels"].items():
        for group, values in groups.items():
            floor = values["noise_floor"]
            cells = [Cell(horizon), Cell(f"{group} [{UNITS[group]}]")]
            for key in ("before", "after"):
                tone = "good" if key == "after" and values[key] < 1.2 * floor else ""
                cells.append(Cell(f"{values[key]:.4g}", tone))
            rows.append([*cells, Cell(f"{floor:.4g}")])
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
            Picture(where_chart(proof.where), WHERE),
            Picture(drift_chart(proof.where), DRIFT),
            Grid("On held-out flights", headers, rows),
        ],
    )


WHERE = (
    "Errors of rollouts of 0.5 s over their noise floor, all flights, against what was flown at "
    "their starts. A line that stays at the dotted one is noise; one that rises says with what the "
    "disagreement grows."
)
DRIFT = (
    "Measured minus simulated in the body axes of the start: the mean acceleration over 0.5 s that "
    "the model lacks, and the turn that it lacks. Dots are rollouts; lines are means with 95 %."
)


def _candidates(diagnosis: Diagnosis) -> Section:
    scores = diagnosis.finding.first
    named = {n.candidate.label for n in diagnosis.finding.named}
    chance = scores[0].chance if scores else None
    rows = [
        [
            Cell(s.candidate.label),
            Cell(f"{s.gain:.1f}"),
            Cell(f"{s.p_value:.3f}"),
            Cell("named" if s.candidate.label in named else ""),
        ]
        for s in scores
    ]
    words = (
        f"All {len(scores)} candidates, each fitted alone before anything was named. The gain is "
        "the fall of the whitened squared error on stretches that its fit did not see. The null: "
        f"the signs of whole stretches are shuffled {FLIPS} times, and the best gain of all "
        "candidates is taken each time; p is how often that is as large. One name follows another "
        f"while p is at most {P_VALUE:g}; then all are refitted jointly."
    )
    table = "\n".join(f"{c[0].text:24}{c[1].text:>12}{c[2].text:>8}  {c[3].text}" for c in rows)
    return Section(
        "4. The candidates",
        [
            words,
            Picture(gains_chart(scores, chance, named), "The best fourteen; blue were named."),
            Details("all candidates", f"{'effect':24}{'gain':>12}{'p':>8}\n{table}"),
        ],
    )


def _identity(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Section:
    rows = []
    for one in diagnosis.finding.named:
        ordered = sorted(one.apart.items(), key=lambda item: item[1])
        for label, apart in ordered[:RIVALS]:
            same = label.split()[0] in one.rivals
            verdict = Cell("cannot be told apart", "bad") if same else Cell("ruled out")
            rows.append([Cell(one.candidate.label), Cell(label), Cell(f"{apart:.1f}"), verdict])
    headers = ["named", "in its place", "worse by", ""]
    note = (
        "Worse by: squared error in units of the noise, with one for each number that is fitted; "
        "9 is three standard errors. What was not fitted in a name's place was too far off."
    )
    parts: list[Part] = [Grid("", headers, rows, note=note)] if rows else []
    if not diagnosis.finding.named:
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
            [
                Cell(way["file"]),
                Cell(way["trajectory"]["kind"]),
                Cell(f"{way['trajectory']['duration_s']:g} s"),
                Cell(f"{way['top_speed']:.1f} m/s"),
                Cell(f"{way['top_acceleration']:.1f} m/s²"),
                Cell(" x ".join(f"{size:.1f}" for size in way["room"]) + " m"),
                Cell(way["flown"] or ""),
            ]
            for way in plan["flights"]
        ]
        headers = ["flight", "kind", "lasts", "speed", "acceleration", "needs", "flown as"]
        note = " ".join(plan["words"])
        parts.append(Grid("Flights to fly next", headers, rows, note=note))
    return Section("8. What was written", parts)


def _number(value: float) -> str:
    return f"{value:.4g}"
