"""Charts of a loop as PNG: success and speed by cell, training curves, the delta's error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import Interval
from suite.common.charts import plain_axes, png, titled
from suite.loop.compare import BEFORE, WITH, WITHOUT, Line
from suite.loop.variants import Standing

COLOURS = {BEFORE: "#8b93a1", WITHOUT: "#e0892b", WITH: "#2463c9"}
LABELS = {BEFORE: "before", WITHOUT: "tuned without delta", WITH: "tuned with delta"}
PANELS = (
    ("gates", "Gates a rollout", 1),
    ("collided", "Worlds that collided [%]", 100),
    ("speed", "Mean speed [m/s]", 1),
)
"""Numbers of a training's curve, their titles and scales."""


def comparison_chart(lines: Sequence[Line]) -> bytes:
    """Return success rates and mean speeds of the three policies by track and level."""
    figure = Figure(figsize=(10.4, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [line.track if line.difficulty is None else f"{line.track}\nlevel {line.difficulty}"
             for line in lines]  # fmt: skip
    for axes, title, scale, pick in (
        (left, "Success [%]", 100, lambda line: line.success),
        (right, "Mean speed, median over trials [m/s]", 1, lambda line: line.v_mean),
    ):
        _dots(axes, lines, scale, pick)
        titled(axes, title)
        axes.set_xticks(range(len(lines)), names, fontsize=8)
        if lines[-1].difficulty is None and len(lines) > 1:
            axes.axvline(len(lines) - 1.5, color="#b8bec8", lw=0.8)
    left.set_ylim(-3, 103)
    right.set_ylim(bottom=0)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)


def _dots(
    axes: Axes, lines: Sequence[Line], scale: float, pick: Callable[[Line], Sequence[Interval]]
) -> None:
    for number, variant in enumerate(COLOURS):
        value, low, high = scale * np.array([pick(line)[number] for line in lines]).T
        at = np.arange(len(lines)) + 0.2 * (number - 1)
        reach = np.maximum([value - low, high - value], 0)
        style = {"fmt": "o", "ms": 5.5, "lw": 1.8, "capsize": 0}
        axes.errorbar(at, value, reach, color=COLOURS[variant], label=LABELS[variant], **style)


def training_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return gates, collisions and speed over a training and the fine-tunings that follow it.

    Args:
        curves: rows of metrics.jsonl by variant; an absent or empty one is left out.
    """
    figure = Figure(figsize=(10.4, 3.1), layout="constrained")
    before = len(curves.get(BEFORE, ()))
    for axes, (key, title, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        for variant, rows in curves.items():
            if not rows:
                continue
            values = scale * np.array([row[key] for row in rows], float)
            at = np.array([row["iteration"] for row in rows])
            at = at + (0 if variant == BEFORE else before)
            axes.plot(at, values, color=COLOURS[variant], lw=0.7, alpha=0.25)
            label = "training" if variant == BEFORE else LABELS[variant]
            axes.plot(at, _smooth(values), color=COLOURS[variant], lw=1.8, label=label)
        titled(axes, title)
        axes.set_xlabel("iteration", fontsize=9)
        axes.set_ylim(bottom=0)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)


SEVERAL = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""


def success_chart(stand: Sequence[Standing], labels: Mapping[str, str]) -> bytes:
    """Return the success rates of any policies by track and level, and over all."""
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    axes = figure.subplots()
    cells = [*stand[0].by_cell, "all"]
    for number, (one, colour) in enumerate(zip(stand, SEVERAL, strict=False)):
        rates = [*one.by_cell.values(), one.success]
        value, low, high = 100 * np.array(rates).T
        at = np.arange(len(cells)) + 0.13 * (number - 0.5 * (len(stand) - 1))
        reach = np.maximum([value - low, high - value], 0)
        style = {"fmt": "o", "ms": 5, "lw": 1.6, "capsize": 0}
        axes.errorbar(at, value, reach, color=colour, label=labels[one.name], **style)
    axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    axes.set_xticks(range(len(cells)), [cell.replace(" ", "\nlevel ") for cell in cells])
    axes.set_ylim(-3, 103)
    axes.set_title("Success [%]", loc="left", fontsize=11, fontweight="bold")
    plain_axes(axes)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)


def tuning_chart(
    curves: Mapping[str, Sequence[Mapping[str, Any]]], labels: Mapping[str, str]
) -> bytes:
    """Return gates, collisions and speed over several fine-tunings (rows of metrics.jsonl)."""
    figure = Figure(figsize=(10.4, 3.1), layout="constrained")
    colours = dict(zip(curves, SEVERAL[2:], strict=False))
    for axes, (key, title, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        for variant, rows in curves.items():
            if not rows:
                continue
            values = scale * np.array([row[key] for row in rows], float)
            at = np.array([row["iteration"] for row in rows])
            axes.plot(at, _smooth(values), color=colours[variant], lw=1.8, label=labels[variant])
        axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
        axes.set_xlabel("iteration", fontsize=9)
        axes.set_ylim(bottom=0)
        plain_axes(axes)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return png(figure)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return running means over a twentieth of the values, shorter at the ends."""
    half = max(1, len(values) // 40)
    total = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(len(values)) - half, 0)
    last = np.minimum(np.arange(len(values)) + half + 1, len(values))
    return (total[last] - total[first]) / (last - first)


def delta_chart(fitted: Mapping[str, Any]) -> bytes:
    """Return the Delta Action Model's error over its fit beside its rivals' (from delta.json)."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    at = [row["iteration"] for row in fitted["curve"]]
    for key, label, style in (
        ("held_out_m", "with Delta Action Model, held-out flights", "-"),
        ("fit_m", "with Delta Action Model, fitted flights", ":"),
    ):
        errors = [row[key] for row in fitted["curve"]]
        axes.plot(at, errors, style, color=COLOURS[WITH], lw=1.8, label=label)
    for key, label, colour in (
        ("point_mass", "point mass as trained in", COLOURS[BEFORE]),
        ("fitted_point_mass", "point mass, lag, drag and delay fitted", COLOURS[WITHOUT]),
    ):
        level = fitted[key]["position_m"]
        axes.axhline(level, color=colour, lw=1.8, label=f"{label}, held-out flights")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("iteration of the fit", fontsize=9)
    title = f"Position error after {fitted['horizon_s']:g} s [m]"
    titled(axes, title)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return png(figure)
