"""The page of a report: answer, picture and next steps first, then folded sections of evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from eval.effects import EFFECTS
from suite.common.report import Details, Links, Part, Picture, Report, Section, Steps
from suite.diagnose.data.windows import UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.estimate.composites import in_words
from suite.diagnose.report.charts import series_chart
from suite.diagnose.report.sections import (
    actuators_section,
    agreement_section,
    candidates_section,
    evidence_section,
    logs_section,
    noise_section,
    residual_section,
    rivals_section,
)
from suite.diagnose.report.summary import cells, components, grid, next_steps, short_name
from tracks.common.grid import Cell, Grid

TITLES = {
    "no_gap": "no gap",
    "named": "cause named",
    "partly": "partly explained",
    "unknown": "cause unknown",
}
"""By verdict."""
FILES = (
    ("vehicle.toml", "the vehicle with what was named; every command takes it"),
    ("diagnosis.json", "all numbers of this page"),
    ("recording.rrd", "held-out flights measured and simulated, before and after, for rerun"),
    ("plan/plan.json", "flights that separate what these could not"),
)
"""Next to the report, where they were written."""
LEAST_FLOOR = 1e-9
"""A noise floor below this is that of what no log measured, in any unit."""
TOTALS = (
    "Values are totals: what the vehicle file had of an effect is replaced. Of the gap: the "
    "share that this effect takes away when it is added last. Chance gives a false name with "
    "a probability of at most {chance:.1g}."
)
CHANNELS = (
    "RMS errors on flights that took no part in finding or fitting anything. Noise floor: what the "
    "measurement noise alone gives, in rollouts that of the start and of the row compared. "
    "Repeatability: how far the means of flights of the unchanged vehicle lie apart. Closed: the "
    "share of the variance within a flight that the named effects explain; black box: the share "
    "that a regression without physics explains, fitted to the same flights."
)


def page(diagnosis: Diagnosis, found: Mapping[str, Any], toml: str, files: set[str]) -> Report:
    """Return the report of a diagnosis; `found` is its JSON, and the words are taken from there.

    `toml` is the text of the vehicle file that was written, `files` lists which of `FILES` exist.
    """
    gap, flown = found["gap"], diagnosis.main.source.rollouts
    after = f" → {gap['after']:.3g}" if found["effects"] else ""
    facts = {
        "verdict": found["verdict"],
        "gap on held-out flights": f"{gap['before']:.3g}{after} {diagnosis.main.source.unit}",
        "noise floor": f"{gap['noise_floor']:.3g}",
        "held out": _few(gap["held_out"]),
        "driven by": found["driven_by"],
        "took": f"{found['seconds']:.0f} s",
    }
    if diagnosis.references:
        facts["reference"] = f"{len(diagnosis.references)} flights"
    details = [
        Section("Errors on held-out flights", [channels_grid(gap["channels"])]),
        *([logs_section(flown.logs), noise_section(diagnosis)] if flown else []),
        *actuators_section(found),
        candidates_section(diagnosis),
        rivals_section(diagnosis, found),
        residual_section(found),
        evidence_section(diagnosis, found),
        agreement_section(diagnosis),
    ]
    return Report(
        title=f"Diagnosis: {TITLES[found['verdict']]}",
        lead=found["headline"],
        facts=facts,
        sections=[
            Section("What to do next", [Steps(next_steps(found))]),
            *_measured(diagnosis),
            *([Section("Warnings", found["warnings"])] if found["warnings"] else []),
            *_findings(found.get("findings", ())),
            Section("The answer in numbers", _answer(found)),
            _written(found, toml, files),
            *(replace(section, folded=True) for section in details),
        ],
    )


def _few(names: list[str]) -> str:
    short = [short_name(name) for name in names]
    return ", ".join(short[:3]) + (f" and {len(short) - 3} more" if len(short) > 3 else "")


def _measured(diagnosis: Diagnosis) -> list[Section]:
    """Return measured, simulated, and simulated with what was named, as a picture."""
    main = diagnosis.main
    series = main.source.series(main.search)
    if series is None:
        return []
    return [Section("Measured and simulated", [Picture(series_chart(series), series.caption)])]


def _findings(findings: Sequence[Mapping[str, Any]]) -> list[Section]:
    """Return the faults of the logs that were corrected, or that may be there."""
    rows = [
        tuple(
            str(one[key] or "")
            for key in ("flight", "signal", "status", "fault", "evidence", "fix")
        )
        for one in findings
        if one["status"] in ("corrected", "doubt")
    ]
    headers = ["log", "signal", "status", "fault", "evidence", "fix"]
    return [Section("Findings about the logs", [grid("", headers, rows)])] if rows else []


def channels_grid(channels: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Grid:
    """Return the gap by channel; a channel that no log measured has no row."""
    more = {"repeatability": ".3g", "closed": ".0%", "explainable": ".0%"}
    every = [one for values in channels.values() for one in values.values()]
    shown = [key for key in more if any(key in one for one in every)]
    rows = []
    for group, values in channels.items():
        for channel, one in values.items():
            floor = one["noise_floor"]
            if floor < LEAST_FLOOR:
                continue
            unit = f" [{UNITS[channel]}]" if channel in UNITS else ""
            tone = "good" if one["after"] < 1.2 * floor else ""
            row = cells(group, f"{channel}{unit}", f"{one['before']:.4g}")
            row += [Cell(f"{one['after']:.4g}", tone), *cells(f"{floor:.4g}")]
            texts = ["" if one.get(k) is None else format(one[k], more[k]) for k in shown]
            rows.append([*row, *cells(*texts)])
    names = {"explainable": "black box"}
    headers = ["", "channel", "as given", "with what was named", "noise floor"]
    headers += [names.get(key, key) for key in shown]
    return Grid("", headers, rows, note=CHANNELS)


def _answer(found: Mapping[str, Any]) -> list[Part]:
    """Return the named effects, their equations and their parameters."""
    effects = found["effects"]
    if not effects:
        return ["Nothing was named: the vehicle file is as it was."]
    rows = [
        (
            effect["name"],
            ", ".join(effect["alternatives"]) or "none",
            effect["view"],
            one.label,
            *one.shown(),
            "exempt" if effect["gap_removed"] is None else f"{100 * effect['gap_removed']:.0f} %",
        )
        for effect in effects
        for one in sorted(components(effect), key=lambda one: not one.found)
    ]
    about = [EFFECTS[effect["name"]] for effect in effects]
    words: list[Part] = [f"{one.name}: {one.equation}." for one in about]
    words += in_words([(e["name"], *e["alternatives"]) for e in effects])
    headers = [
        "effect", "not distinguishable from", "view", "parameter", "total", "95 %", "of the gap"
    ]  # fmt: skip
    note = TOTALS.format(chance=max(effect["p_value"] for effect in effects))
    return [*words, grid("", headers, rows, note)]


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
