"""The report on real flights: a sentence, a picture, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eval.effects import EFFECTS
from suite.common.charts import png, titled
from suite.common.report import Details, Links, Part, Picture, Report, Section
from suite.diagnose.by_views import ViewsDiagnosis
from suite.diagnose.estimate.composites import in_words
from suite.diagnose.report.charts import AFTER, BEFORE, FLOOR
from suite.diagnose.report.parameters_json import components, grid, size_words
from tracks.common.grid import Grid

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


def views_page(found: ViewsDiagnosis, told: Mapping[str, Any], toml: str) -> Report:
    """Return the report; `told` is the JSON, `toml` the vehicle file that was written."""
    gap = told["gap"]
    sections = [
        Section("What was measured, and what the model says", _picture(found, told)),
        Section("The answer in numbers", _answer(told)),
        Section("Each view, axis by axis", [_channels(told)]),
        Section("Do the flights agree", _agreement(found)),
        Section("What the views compare", _views(found)),
        Section(
            "What was written",
            [
                "The vehicle file with the named effects, for every other command (--vehicle).",
                Details("vehicle.toml", toml),
                Links([("vehicle.toml", "the vehicle"), ("diagnosis.json", "all numbers")]),
            ],
        ),
    ]
    if told["warnings"]:
        sections.append(Section("Warnings", list(told["warnings"])))
    return Report(
        title=f"Diagnosis: {told['verdict']}",
        lead=told["headline"],
        facts={
            "flights": str(len(found.flights.names)),
            "reference": str(len(found.references)) if found.references else "none",
            "held out": ", ".join(gap["held_out"]),
            "rotors by": told["driven_by"],
            "took": f"{told['seconds']:.0f} s",
        },
        sections=sections,
    )


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


def _answer(told: Mapping[str, Any]) -> list[Part]:
    rows = [
        (
            effect["name"],
            ", ".join(effect["alternatives"]) or "none",
            effect["view"],
            one.label,
            *one.shown(),
        )
        for effect in told["effects"]
        for one in sorted(components(effect), key=lambda one: not one.found)
    ]
    if not rows:
        return ["Nothing was named: the vehicle file is as it was."]
    words: list[Part] = [
        f"{effect['name']}: {EFFECTS[effect['name']].summary}: {EFFECTS[effect['name']].equation}."
        for effect in told["effects"]
    ]
    words += [f"{size_words(effect)}." for effect in told["effects"]]
    words += in_words([(e["name"], *e["alternatives"]) for e in told["effects"]])
    headers = ["effect", "not distinguishable from", "view", "parameter", "total", "95 %"]
    note = "Totals: what the vehicle file had of an effect is replaced. 95 % with flights as draws."
    words.append(grid("", headers, rows, note))
    words += [f"What would tell {line}." for line in told["separate_with"]]
    return words


def _channels(told: Mapping[str, Any]) -> Grid:
    def short(value: float | None, percent: bool = False) -> str:
        if value is None:
            return "not told"
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
            "beside that. A change is named where it stands out of them."
        )
    return parts or ["Nothing was named on which flights could agree."]


def _views(found: ViewsDiagnosis) -> list[Part]:
    words: list[Part] = [
        f"{one.view.name}: {one.view.about} ({found.flights.source}), smoothed over "
        f"{one.view.width_s:g} s, along body {', '.join('xyz'[axis] for axis in one.view.axes)}."
        for one in found.results
    ]
    return words
