"""Charts of `suite reproduce robustness`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from suite.common.charts import LINES, png, titled
from suite.experiments.conditions import Sweep

if TYPE_CHECKING:
    from suite.experiments.robust_tables import Tested


def effects_chart(entries: Sequence[Tested], names: Sequence[str]) -> bytes:
    """Return success under each effect as dots with intervals, the undisturbed as a line."""
    figure = Figure(figsize=(8.6, 1.2 + 0.24 * len(entries)), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(entries))[::-1]
    for number, name in enumerate(names):
        colour = LINES[number % len(LINES)]
        value, low, high = 100 * np.array([entry.success(name) for entry in entries]).T
        reach = np.maximum([value - low, high - value], 0)
        places = at - 0.22 * (number - (len(names) - 1) / 2)
        axes.errorbar(value, places, xerr=reach, fmt="o", ms=4, lw=1.4, color=colour, label=name)
        axes.axvline(value[0], color=colour, lw=1, ls="--", alpha=0.6)
    axes.set_yticks(at, [f"{e.condition.name}  {e.condition.words}".strip() for e in entries])
    axes.set_xlim(-3, 103)
    titled(axes, "Success [%]")
    axes.tick_params(axis="y", labelsize=7)
    if len(names) > 1:
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)


def sweeps_chart(grown: Mapping[Sweep, Sequence[Tested]], names: Sequence[str]) -> bytes:
    """Return success against the size of each disturbance, a panel each."""
    columns = min(4, len(grown))
    rows = -(-len(grown) // columns)
    figure = Figure(figsize=(10.4, 0.5 + 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(grown) :]:
        axes.set_visible(False)
    for axes, (sweep, points) in zip(panels, grown.items(), strict=False):
        sizes = [point.condition.size for point in points]
        for number, name in enumerate(names):
            colour = LINES[number % len(LINES)]
            value, low, high = 100 * np.array([point.success(name) for point in points]).T
            axes.fill_between(sizes, low, high, color=colour, alpha=0.15, lw=0)
            axes.plot(sizes, value, "o-", ms=3.5, lw=1.6, color=colour, label=name)
        titled(axes, sweep.name)
        axes.set_xlabel(sweep.axis, fontsize=8)
        axes.set_ylim(-3, 103)
    if len(names) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9
        )
    return png(figure)
