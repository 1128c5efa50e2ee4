"""Charts of a loop as PNG: success and speed by cell, training curves, the delta's error."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import Interval
from suite.common.charts import png, titled
from suite.delta.run import errors_by_name
from suite.loop.compare import BEFORE, WITH, WITHOUT, Line
from suite.loop.standings import Standing

COLOURS = {BEFORE: "#8b93a1", WITHOUT: "#e0892b", WITH: "#2463c9"}
LABELS = {BEFORE: "before", WITHOUT: "tuned without delta", WITH: "tuned with delta"}
SEVERAL = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""
ONE_ROW_MOST = 8
"""Cells that have room for their names in two charts side by side."""
PANELS = (
    ("gates", "Gates a rollout", 1),
    ("collided", "Worlds that collided [%]", 100),
    ("speed", "Mean speed [m/s]", 1),
)
"""Numbers of a training's curve, their titles and scales."""


def comparison_chart(lines: Sequence[Line]) -> bytes:
    """Return success rates and mean speeds of the three policies by track and level."""
    one_row = len(lines) <= ONE_ROW_MOST
    figure = Figure(figsize=(10.4, 3.9 if one_row else 6.6), layout="constrained")
    panels = figure.subplots(1, 2) if one_row else figure.subplots(2, 1)
    cells = [line.track if line.difficulty is None else f"{line.track}\nlevel {line.difficulty}"
             for line in lines]  # fmt: skip
    titles = {"success": "Success [%]", "v_mean": "Mean speed, median over trials [m/s]"}
    for axes, (field, title) in zip(panels, titles.items(), strict=True):
        dots = [
            (LABELS[variant], colour, [getattr(line, field)[number] for line in lines])
            for number, (variant, colour) in enumerate(COLOURS.items())
        ]
        _dots(axes, title, cells, dots, apart=0.2, ms=5.5, lw=1.8)
    return _with_legend(figure, 3)


def success_chart(stand: Sequence[Standing], labels: Mapping[str, str]) -> bytes:
    """Return the success rates of any policies by track and level, and over all."""
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    cells = [cell.replace(" ", "\nlevel ") for cell in (*stand[0].by_cell, "all")]
    dots = [
        (labels[one.name], colour, [*one.by_cell.values(), one.success])
        for one, colour in zip(stand, SEVERAL, strict=False)
    ]
    _dots(figure.subplots(), "Success [%]", cells, dots, apart=0.13, ms=5, lw=1.6)
    return _with_legend(figure, 3)


def _dots(
    axes: Axes,
    title: str,
    cells: Sequence[str],
    dots: Sequence[tuple[str, str, Sequence[Interval]]],
    *,
    apart: float,
    ms: float,
    lw: float,
) -> None:
    """Draw label, colour and intervals of all policies, `apart` of a cell; the last cell is all."""
    percent = title.endswith("[%]")
    for number, (label, colour, intervals) in enumerate(dots):
        value, low, high = (100 if percent else 1) * np.array(intervals).T
        at = np.arange(len(cells)) + apart * (number - 0.5 * (len(dots) - 1))
        reach = np.maximum([value - low, high - value], 0)
        axes.errorbar(at, value, reach, color=colour, label=label, fmt="o", ms=ms, lw=lw)
    titled(axes, title)
    axes.set_xticks(range(len(cells)), cells, fontsize=8)
    if len(cells) > 1:
        axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    axes.set_ylim(*((-3, 103) if percent else (0, None)))


def _with_legend(figure: Figure, columns: int, size: float = 9) -> bytes:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    place = "outside lower center"
    figure.legend(handles, labels, loc=place, ncols=columns, frameon=False, fontsize=size)
    return png(figure)


def training_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return gates, collisions and speed over a training and the fine-tunings that follow it.

    Args:
        curves: rows of metrics.jsonl by variant; an absent or empty one is left out.
    """
    labels = {**LABELS, BEFORE: "training"}
    return _curves({labels[name]: rows for name, rows in curves.items()}, COLOURS.values(), 3, True)


def tuning_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return gates, collisions and speed over several fine-tunings (rows of metrics.jsonl)."""
    return _curves(curves, SEVERAL[2:], 4, False)


def _curves(
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    colours: Iterable[str],
    columns: int,
    follow: bool,
) -> bytes:
    """Draw curves by label, all of a training's steps and those that follow it if `follow`."""
    figure = Figure(figsize=(10.4, 3.1), layout="constrained")
    before = len(next(iter(curves.values()))) if follow else 0
    for axes, (key, title, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        start = 0
        for (label, rows), colour in zip(curves.items(), colours, strict=False):
            if not rows:
                continue
            values = scale * np.array([row[key] for row in rows], float)
            at = start + np.array([row["iteration"] for row in rows])
            if follow:
                axes.plot(at, values, color=colour, lw=0.7, alpha=0.25)
            axes.plot(at, _smooth(values), color=colour, lw=1.8, label=label)
            start = before
        titled(axes, title)
        axes.set_xlabel("iteration", fontsize=9)
        axes.set_ylim(bottom=0)
    return _with_legend(figure, columns)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return running means over a twentieth of the values, shorter at the ends."""
    half = max(1, len(values) // 40)
    total = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(len(values)) - half, 0)
    last = np.minimum(np.arange(len(values)) + half + 1, len(values))
    return (total[last] - total[first]) / (last - first)


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
    return _with_legend(figure, 2, 8)
