"""Charts of a loop as PNG: success and speed by cell, training curves, the Delta Action Model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import Interval
from suite.common.charts import curves_chart, dots, legend, png, titled
from suite.delta.run import errors_by_name
from suite.loop.compare import BEFORE, WITH, WITHOUT, Line
from suite.loop.standings import Standing

COLOURS = {BEFORE: "#8b93a1", WITHOUT: "#e0892b", WITH: "#2463c9"}
LABELS = {BEFORE: "before", WITHOUT: "tuned without delta", WITH: "tuned with delta"}
SEVERAL = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""
ONE_ROW_MOST = 8
"""Cells that have room for their names in two charts side by side."""


def comparison_chart(lines: Sequence[Line]) -> bytes:
    """Return success rates and mean speeds of the three policies by track and level."""
    one_row = len(lines) <= ONE_ROW_MOST
    figure = Figure(figsize=(10.4, 3.9 if one_row else 6.6), layout="constrained")
    panels = figure.subplots(1, 2) if one_row else figure.subplots(2, 1)
    cells = [line.track if line.difficulty is None else f"{line.track}\nlevel {line.difficulty}"
             for line in lines]  # fmt: skip
    titles = {"success": "Success [%]", "v_mean": "Mean speed, median over trials [m/s]"}
    for axes, (field, title) in zip(panels, titles.items(), strict=True):
        policies = [
            (LABELS[variant], colour, [getattr(line, field)[number] for line in lines])
            for number, (variant, colour) in enumerate(COLOURS.items())
        ]
        _panel(axes, title, cells, policies, apart=0.2, ms=5.5, lw=1.8)
    legend(figure, panels[0])
    return png(figure)


def success_chart(stand: Sequence[Standing], labels: Mapping[str, str]) -> bytes:
    """Return the success rates of any policies by track and level, and over all."""
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    cells = [cell.replace(" ", "\nlevel ") for cell in (*stand[0].by_cell, "all")]
    policies = [
        (labels[one.name], colour, [*one.by_cell.values(), one.success])
        for one, colour in zip(stand, SEVERAL, strict=False)
    ]
    axes = figure.subplots()
    _panel(axes, "Success [%]", cells, policies, apart=0.13, ms=5, lw=1.6)
    legend(figure, axes)
    return png(figure)


def _panel(
    axes: Axes,
    title: str,
    cells: Sequence[str],
    policies: Sequence[tuple[str, str, Sequence[Interval]]],
    *,
    apart: float,
    ms: float,
    lw: float,
) -> None:
    """Draw each policy (label, colour, intervals by cell); the last cell is that of all trials.

    Dots of neighbouring policies are `apart` of a cell's width from each other.
    """
    percent = title.endswith("[%]")
    for number, (label, colour, intervals) in enumerate(policies):
        at = np.arange(len(cells)) + apart * (number - 0.5 * (len(policies) - 1))
        dots(axes, at, intervals, 100 if percent else 1, color=colour, label=label, ms=ms, lw=lw)
    titled(axes, title)
    axes.set_xticks(range(len(cells)), cells, fontsize=8)
    if len(cells) > 1:
        axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    axes.set_ylim(*((-3, 103) if percent else (0, None)))


def training_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return a training's curve and those of the fine-tunings after it, rows by variant."""
    labels = {**LABELS, BEFORE: "training"}
    named = {labels[name]: rows for name, rows in curves.items()}
    return curves_chart(named, tuple(COLOURS.values()), follow=True)


def delta_chart(fitted: Mapping[str, Any]) -> bytes:
    """Return the Delta Action Model's error over its fit next to its rivals' (from delta.json)."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    at = [row["iteration"] for row in fitted["curve"]]
    for key, label, style in (
        ("held_out_m", "with Delta Action Model, held-out flights", "-"),
        ("fit_m", "with Delta Action Model, fitted flights", ":"),
    ):
        errors = [row[key] for row in fitted["curve"]]
        axes.plot(at, errors, style, color=COLOURS[WITH], lw=1.8, label=label)
    *rivals, _ = errors_by_name(fitted).items()
    for (name, error), role in zip(rivals, (BEFORE, WITHOUT), strict=False):
        label = f"{name}, held-out flights"
        axes.axhline(error["position_m"], color=COLOURS[role], lw=1.8, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("iteration of the fit", fontsize=9)
    titled(axes, f"Position error after {fitted['horizon_s']:g} s [m]")
    legend(figure, axes, 2, 8)
    return png(figure)
