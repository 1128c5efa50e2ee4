"""Assembles the report of a diagnosis: answer, chart and next steps, then folded details."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from eval.effects import EFFECTS
from suite.common.console import counted
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
from suite.diagnose.report.summary import components, figure, next_steps, superscripts
from suite.diagnose.sources.rollout_source import Rollouts, rollouts_of
from suite.diagnose.sources.source import FITTED, GIVEN
from tracks.common.grid import Cell, Grid, table, table_of

TITLES = {
    "no_gap": "no gap",
    "named": "cause named",
    "partly": "partly explained",
    "unknown": "cause unknown",
}
"""Part of the page's title, by verdict."""
FILES = (
    ("vehicle.toml", "the vehicle file, with the named effects if there are any"),
    ("diagnosis.json", "all numbers of this page"),
    ("recording.rrd", "held-out flights measured and simulated, before and after, for rerun"),
    ("plan/plan.json", "flights that separate effects which these flights do not"),
)
"""Files next to the report, and their description."""
CHANNELS = (
    "RMS errors on held-out flights. Noise floor: the error by measurement noise alone (in "
    "rollouts, noise of the start and of the compared row). Errors of force and torque are "
    "those within a flight, without its constant offset. Repeatability: the spread of the means "
    "of flights of the unchanged vehicle. Closed: the share of the variance within a flight that "
    "the named effects explain. Black box: the share that a regression without physics "
    "explains; it is fitted to the same flights."
)


def page(
    diagnosis: Diagnosis,
    result: Mapping[str, Any],
    toml: str,
    files: set[str],
    rollouts: Rollouts | None = None,
) -> Report:
    """Return the report of a diagnosis with the diagnosis.json `result` and vehicle file `toml`.

    `files` are the paths of those of `FILES` that exist. `rollouts` are those for the chart.
    """
    gap, flown, main = result["gap"], rollouts_of(diagnosis.main), diagnosis.main
    held = gap["held_out"]
    # The values of a held-out stretch: measured, and simulated without and with the named effects.
    # If an error remains, the chart shows it.
    worst = FITTED if result["verdict"] == "partly" and main.search.named else GIVEN
    if flown:
        series = flown.series(main.search, rollouts, worst)
    else:
        series = main.source.series(main.search)
    chart = [Picture(series_chart(series), series.caption)] if series else []
    after = f" → {figure(gap['after'])}" if result["effects"] else ""
    facts = {
        "gap on held-out flights": superscripts(f"{figure(gap['before'])}{after} {gap['unit']}"),
        "noise floor": f"{gap['noise_floor']:.3g}",
        "held out": ", ".join(held[:3]) + (f" and {len(held) - 3} more" if held[3:] else ""),
        "driven by": result["driven_by"],
    }
    if result["not_examined"]:
        facts["not examined"] = ", ".join(result["not_examined"])
    if result["reference"]:
        facts["reference"] = counted(len(result["reference"]), "flight")
    units = {one.source.name: one.source.unit for one in diagnosis.findings}
    details = [
        Section("Errors on held-out flights", [channels_grid(gap["channels"], units)]),
        *([logs_section(flown.logs), noise_section(diagnosis)] if flown else []),
        *([actuators_section(result)] if result.get("actuators") else []),
        candidates_section(diagnosis),
        rivals_section(diagnosis, result),
        residual_section(result),
        evidence_section(diagnosis, result),
        agreement_section(diagnosis),
    ]
    sections = [
        Section("What to do next", [Steps(next_steps(result))]),
        Section("Measured and simulated", chart),
        Section("Warnings", result["warnings"]),
        _findings(result.get("findings", ())),
        _answer(result),
        _written(result, toml, files),
    ]
    sections += [replace(section, folded=True) for section in details]
    shown = [section for section in sections if section.parts]
    return Report(f"Diagnosis: {TITLES[result['verdict']]}", result["headline"], facts, shown)


def _findings(findings: Sequence[Mapping[str, Any]]) -> Section:
    """Return a section on faults of the logs (such as wrong units), corrected or suspected."""
    keys = ("flight", "signal", "status", "fault", "evidence", "fix")
    rows = [
        [str(finding[key] or "") for key in keys]
        for finding in findings
        if finding["status"] in ("corrected", "doubt")
    ]
    headers = ["log", *keys[1:]]
    return Section("Findings about the logs", [table(headers, rows)] if rows else [])


def channels_grid(
    channels: Mapping[str, Mapping[str, Mapping[str, Any]]], units: Mapping[str, str]
) -> Grid:
    """Return a table of the gap by channel, without channels that no log measured.

    `units` are those of the groups whose channels are axes (force, torque).
    """
    optional = {"repeatability": ".3g", "closed": ".0%", "explainable": ".0%"}
    errors = [error for values in channels.values() for error in values.values()]
    shown = [key for key in optional if any(error.get(key) is not None for error in errors)]
    rows = []
    for group, values in channels.items():
        for channel, error in values.items():
            floor = error["noise_floor"]
            if floor < 1e-9:  # in any unit; no log measured this channel
                continue
            unit = superscripts(UNITS.get(channel) or units[group])
            tone = "good" if error["after"] < 1.2 * floor else ""
            # The channel, then errors (green if about as small as the noise), then the shares.
            after = Cell(f"{error['after']:.4g}", tone)
            row = [group, f"{channel} [{unit}]", f"{error['before']:.4g}", after, f"{floor:.4g}"]
            texts = ["" if error.get(k) is None else format(error[k], optional[k]) for k in shown]
            rows.append([*row, *texts])
    headers = ["", "channel", "as given", "with the named effects", "noise floor"]
    headers += ["black box" if key == "explainable" else key for key in shown]
    return table(headers, rows, note=CHANNELS)


def _answer(result: Mapping[str, Any]) -> Section:
    """Return a section with the named effects, their equations and their parameters, if any."""
    effects, title, rows = result["effects"], "The answer in numbers", []
    if not effects:
        return Section(title, [])
    for effect in effects:
        removed = effect["gap_removed"]
        share = "exempt" if removed is None else f"{100 * removed:.0f} %"
        first = [effect["name"], ", ".join(effect["alternatives"]) or "none", effect["view"]]
        for component in components(effect):
            label, texts = superscripts(component.label), component.texts()
            rows.append((*first, label, component.file_text, *texts, share))
            # What holds for the whole effect is in its first row only.
            first, share = ["", "", ""], ""
    names = [effect["name"] for effect in effects]
    words: list[Part] = [f"{name}: {EFFECTS[name].equation}." for name in names]
    words += in_words([(e["name"], *e["alternatives"]) for e in effects])
    headers = [
        "effect", "not distinguishable from", "view", "parameter", "vehicle file", "total", "95 %",
        "of the gap",
    ]  # fmt: skip
    note = (
        "Values are totals: they replace those of the vehicle file. Of the gap: the share that "
        "this effect removes when it is added last. Chance gives each name with a probability "
        f"of at most {max(effect['p_value'] for effect in effects):.1g}."
    )
    return Section(title, [*words, table(headers, rows, note=note)])


def _written(result: Mapping[str, Any], toml: str, files: set[str]) -> Section:
    """Return the section on written files and planned flights."""
    words = "Nothing was named: the vehicle file is unchanged."
    if result["effects"]:
        words = "The vehicle file with the named effects, for every other command (--vehicle)."
    links = [(path, words) for path, words in FILES if path in files]
    parts: list[Part] = [words, Details("vehicle.toml", toml), Links(links)]
    if plan := result.get("plan"):
        grid = table_of(
            plan["flights"],
            ("flight", lambda flight: flight["file"]),
            ("kind", lambda flight: flight["trajectory"]["kind"]),
            ("lasts", lambda flight: f"{flight['trajectory']['duration_s']:g} s"),
            ("speed", lambda flight: f"{flight['top_speed']:.1f} m/s"),
            ("acceleration", lambda flight: f"{flight['top_acceleration']:.1f} m/s²"),
            ("needs", lambda flight: " x ".join(f"{s:.1f}" for s in flight["room"]) + " m"),
            title="Flights to fly next",
            note=" ".join(plan["words"]),
        )
        parts.append(grid)
    return Section("What was written", parts)
