"""What the report of a diagnosis shows, step by step."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.windows import SLICES, UNITS
from suite.report import Cell, Details, Grid, Links, Picture, Report, Section

VERDICTS = {
    "no_gap": "Simulation and flights agree within the measurement noise.",
    "named": "The gap is explained.",
    "partly": "The gap is explained in part; a structured rest remains.",
    "unknown": "There is a gap that nothing in the catalogue explains.",
}


def page(diagnosis: Diagnosis, found: Mapping[str, Any]) -> Report:
    """Return the report of `diagnosis`, whose JSON is `found`."""
    names = ", ".join(
        " or ".join([effect["name"], *effect["alternatives"]]) for effect in found["effects"]
    )
    gap = found["gap"]
    lead = VERDICTS[found["verdict"]] + (f" Named: {names}." if names else "")
    sections = [
        Section("The effects", [_effects(found)]),
        Section("Where they disagree", [_gap_table(found), Picture(_chart(diagnosis), CHART)]),
        Section("The candidates", [_scores(diagnosis)]),
        Section("The measurement noise", [_noise(diagnosis)]),
        Section("What is left", [_rest(found)]),
        Section("Files", [Links([("diagnosis.json", "all numbers"),
                                 ("vehicle.toml", "the vehicle with the named effects")])]),
    ]  # fmt: skip
    if found["warnings"]:
        sections.append(
            Section("Warnings", [Details("what was odd", "\n".join(found["warnings"]))])
        )
    return Report(
        title=f"Diagnosis: {found['verdict']}",
        lead=lead,
        facts={
            "gap before": f"{gap['before']:.2f}",
            "gap after": f"{gap['after']:.2f}",
            "noise floor": "1",
            "held out": ", ".join(gap["held_out"]),
            "driven by": found["driven_by"],
        },
        sections=sections,
    )


CHART = (
    "Slow error of 1 s rollouts on held-out data over its noise floor, by speed at the start: "
    "with the vehicle file as given, and with what was named."
)


def _effects(found: Mapping[str, Any]) -> Grid:
    rows = []
    for effect in found["effects"]:
        for name, entry in effect["parameters"].items():
            rows.append(
                [
                    Cell(effect["name"]),
                    Cell(", ".join(effect["alternatives"]) or "none"),
                    Cell(f"{name} [{entry['unit']}]"),
                    Cell(_number(entry["value"])),
                    Cell(_number(entry["ci95"])),
                    _share(effect["gap_removed"]),
                    Cell(f"{effect['p_value']:.3g}"),
                ]
            )
    note = " ".join(f"To tell {line}." for line in found["separate_with"])
    headers = ["effect", "cannot be told from", "parameter", "value", "95 %", "of the gap", "p"]
    return Grid("", headers, rows, note=note or "Nothing to tell apart.")


def _gap_table(found: Mapping[str, Any]) -> Grid:
    rows = []
    for horizon, groups in found["gap"]["channels"].items():
        for group, values in groups.items():
            near = values["after"] < 1.2 * values["noise_floor"]
            rows.append(
                [
                    Cell(horizon),
                    Cell(f"{group} [{UNITS[group]}]"),
                    Cell(f"{values['before']:.4g}"),
                    Cell(f"{values['after']:.4g}", "good" if near else ""),
                    Cell(f"{values['noise_floor']:.4g}"),
                ]
            )
    control = found["control"]
    note = "" if control is None else (
        f"A wrong effect fitted in the same way ({control['effect']}) leaves a gap of "
        f"{control['after']:.2f}; what was named leaves {found['gap']['after']:.2f}."
    )  # fmt: skip
    headers = ["rollout of", "RMS error", "before", "after", "noise floor"]
    return Grid("Rollouts from measured states on held-out data", headers, rows, note=note)


def _scores(diagnosis: Diagnosis) -> Grid:
    rows = [
        [Cell(s.candidate.label), Cell(f"{s.gain:.1f}"), Cell(f"{s.p_value:.3f}")]
        for s in diagnosis.finding.first[:12]
    ]
    note = (
        "Gain: fall of the whitened squared error on stretches that were left out. p: how often "
        "the best of all candidates gains as much when the signs of the stretches are shuffled."
    )
    return Grid("Alone, before anything was named", ["effect", "gain", "p"], rows, note=note)


def _noise(diagnosis: Diagnosis) -> Grid:
    rows = [
        [Cell(f"{name} [{UNITS[name]}]"), Cell(", ".join(f"{v:.3g}" for v in values))]
        for name, place in SLICES.items()
        if np.isfinite(values := diagnosis.finding.sigma[place]).any()
    ]
    return Grid("Standard deviation by axis, from the data", ["measurement", "noise"], rows)


def _rest(found: Mapping[str, Any]) -> str:
    rest = found["unexplained"]
    if rest["where"]:
        return (
            f"{100 * rest['share']:.0f} % of the structured gap is left, most in {rest['where']}."
        )
    return "No structure beyond the measurement noise is left."


def _chart(diagnosis: Diagnosis) -> bytes:
    speed = np.linalg.norm(np.asarray(diagnosis.held.vel_w), axis=1)
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes = figure.subplots()
    for gap, colour, label in (
        (diagnosis.before, "#8b93a1", "before"),
        (diagnosis.after, "#2463c9", "after"),
    ):
        axes.plot(speed, np.sqrt(gap.score), "o", ms=4, color=colour, label=label)
    axes.axhline(1.0, color="#b8bec8", lw=1.0)
    axes.set_xlabel("speed [m/s]")
    axes.set_ylabel("error over noise floor")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _number(value: Any) -> str:
    if value is None:
        return "not seen"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_number(v) for v in value) + "]"
    return f"{value:.4g}"


def _share(value: float | None) -> Cell:
    return Cell("–" if value is None else f"{100 * value:.0f} %")
