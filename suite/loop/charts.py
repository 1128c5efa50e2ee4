"""Draw the charts of a loop as PNG: success rates, and errors of the Delta Action Model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from suite.common.charts import dots, legend, png, titled
from suite.delta.run import errors_by_name
from suite.loop.compare import PolicyResult

COLOURS = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""


def success_chart(results: Sequence[PolicyResult], labels: Mapping[str, str]) -> bytes:
    """Return the chart of success rates of any policies, by cell and over all trials.

    `labels` are by the policies' names.
    """
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    axes = figure.subplots()
    cells = [cell.replace(" ", "\nlevel ") for cell in (*results[0].by_cell, "all")]
    for number, (result, colour) in enumerate(zip(results, COLOURS, strict=False)):
        # Dots of neighbouring policies are 0.13 widths of a cell apart.
        x = np.arange(len(cells)) + 0.13 * (number - 0.5 * (len(results) - 1))
        intervals = [*result.by_cell.values(), result.success]
        dots(axes, x, intervals, 100, color=colour, label=labels[result.name], ms=5, lw=1.6)
    titled(axes, "Success [%]")
    axes.set_xticks(range(len(cells)), cells, fontsize=8)
    # A line separates the last cell, that of all trials.
    axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    axes.set_ylim(-3, 103)
    legend(figure, axes)
    return png(figure)


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
        axes.plot(iterations, errors, style, color=COLOURS[4], lw=1.8, label=label)
    # The last error is that of the Delta Action Model after the fit, the end of its curve.
    *simpler, _ = errors_by_name(fitted).items()
    for (name, error), colour in zip(simpler, COLOURS, strict=False):
        label = f"{name}, held-out flights"
        axes.axhline(error["position_m"], color=colour, lw=1.8, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("iteration of the fit", fontsize=9)
    titled(axes, f"Position error after {fitted['horizon_s']:g} s [m]")
    legend(figure, axes, 2, 8)
    return png(figure)
