"""Draw the charts of a loop as PNG: success and speed, training curves, the Delta Action Model.

The loop (`suite loop`) flies a policy, corrects the simulation from these flights and fine-tunes
the policy in it; the charts compare the policies before and after. The Delta Action Model ("delta")
is a network that corrects actions so that simulated flights match measured ones. A cell is the
trials of one track at one level of difficulty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import Interval
from suite.common.charts import curves_chart, dots, legend, png, titled
from suite.delta.run import errors_by_name
from suite.loop.compare import BEFORE, WITH, WITHOUT, CellComparison, PolicyResult

COLOURS = {BEFORE: "#8b93a1", WITHOUT: "#e0892b", WITH: "#2463c9"}
"""Colours of the three policies of the loop with a Delta Action Model."""
LABELS = {BEFORE: "before", WITHOUT: "tuned without delta", WITH: "tuned with delta"}
"""Their labels."""
SEVERAL = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""
ONE_ROW_MOST = 8
"""Largest number of cells whose names have room in two charts side by side."""


def comparison_chart(rows: Sequence[CellComparison]) -> bytes:
    """Return the chart of success rates and mean speeds of the three policies, by cell."""
    side_by_side = len(rows) <= ONE_ROW_MOST
    figure = Figure(figsize=(10.4, 3.9 if side_by_side else 6.6), layout="constrained")
    panels = figure.subplots(1, 2) if side_by_side else figure.subplots(2, 1)
    cells = [row.track if row.difficulty is None else f"{row.track}\nlevel {row.difficulty}"
             for row in rows]  # fmt: skip
    titles = {"success": "Success [%]", "v_mean": "Mean speed, median over trials [m/s]"}
    for axes, (field, title) in zip(panels, titles.items(), strict=True):
        policies = [
            (LABELS[variant], colour, [getattr(row, field)[number] for row in rows])
            for number, (variant, colour) in enumerate(COLOURS.items())
        ]
        _draw_panel(axes, title, cells, policies, spacing=0.2, ms=5.5, lw=1.8)
    legend(figure, panels[0])
    return png(figure)


def success_chart(results: Sequence[PolicyResult], labels: Mapping[str, str]) -> bytes:
    """Return the chart of success rates of any policies, by cell and over all trials.

    `labels` are by the policies' names.
    """
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    cells = [cell.replace(" ", "\nlevel ") for cell in (*results[0].by_cell, "all")]
    policies = [
        (labels[result.name], colour, [*result.by_cell.values(), result.success])
        for result, colour in zip(results, SEVERAL, strict=False)
    ]
    axes = figure.subplots()
    _draw_panel(axes, "Success [%]", cells, policies, spacing=0.13, ms=5, lw=1.6)
    legend(figure, axes)
    return png(figure)


def _draw_panel(
    axes: Axes,
    title: str,
    cells: Sequence[str],
    policies: Sequence[tuple[str, str, Sequence[Interval]]],
    *,
    spacing: float,
    ms: float,
    lw: float,
) -> None:
    """Draw the intervals of each policy, cell by cell.

    Args:
        axes: the chart.
        title: its title. A title that ends with "[%]" marks rates, which are drawn in percent.
        cells: names of the cells; the last one is that of all trials.
        policies: label, colour and intervals (one a cell) of each policy.
        spacing: distance between the dots of neighbouring policies, in widths of a cell.
        ms: matplotlib's size of a dot.
        lw: matplotlib's width of a line.
    """
    percent = title.endswith("[%]")
    for number, (label, colour, intervals) in enumerate(policies):
        x = np.arange(len(cells)) + spacing * (number - 0.5 * (len(policies) - 1))
        dots(axes, x, intervals, 100 if percent else 1, color=colour, label=label, ms=ms, lw=lw)
    titled(axes, title)
    axes.set_xticks(range(len(cells)), cells, fontsize=8)
    if len(cells) > 1:  # a line that separates the last cell
        axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    axes.set_ylim(*((-3, 103) if percent else (0, None)))


def training_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return the chart of the learning curves of a training and of the fine-tunings after it.

    `curves` are the rows of each learning curve, by the policy's name.
    """
    labels = {**LABELS, BEFORE: "training"}
    named = {labels[name]: rows for name, rows in curves.items()}
    return curves_chart(named, tuple(COLOURS.values()), follow=True)


def delta_chart(fitted: Mapping[str, Any]) -> bytes:
    """Return the chart of the Delta Action Model's error during its fit, and of simpler models.

    The simpler models have one error each, a horizontal line. `fitted` are the contents of
    delta.json.
    """
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    iterations = [row["iteration"] for row in fitted["curve"]]
    for key, label, style in (
        ("held_out_m", "with Delta Action Model, held-out flights", "-"),
        ("fit_m", "with Delta Action Model, fitted flights", ":"),
    ):
        errors = [row[key] for row in fitted["curve"]]
        axes.plot(iterations, errors, style, color=COLOURS[WITH], lw=1.8, label=label)
    # The last error is that of the Delta Action Model after the fit, the end of its curve.
    *simpler, _ = errors_by_name(fitted).items()
    for (name, error), variant in zip(simpler, (BEFORE, WITHOUT), strict=False):
        label = f"{name}, held-out flights"
        axes.axhline(error["position_m"], color=COLOURS[variant], lw=1.8, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("iteration of the fit", fontsize=9)
    titled(axes, f"Position error after {fitted['horizon_s']:g} s [m]")
    legend(figure, axes, 2, 8)
    return png(figure)
