"""Drawing functions that all charts use: axes, intervals, legends, training curves, PNG bytes."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from suite.common.curve import METRICS

GRID = "#e6e9ee"
"""Colour of the grid."""
LINES = ("#2463c9", "#e0892b", "#2e8b57", "#b0413e", "#7a5cb8", "#8b93a1")
"""Colours of the compared policies or methods, in order."""
DPI = 130
"""Resolution of the pictures [dots per inch]."""
DRAWN = ("gates", "collided", "speed")
"""Keys of the measures of a training's curve that `curves_chart` draws."""


def titled(axes: Axes, title: str) -> None:
    """Write `title` above the axes and draw plain axes."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    plain_axes(axes)


def plain_axes(axes: Axes) -> None:
    """Draw a light grid, small ticks, and no frame at the top and on the right."""
    axes.grid(color=GRID, lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def percent_axis(axes: Axes, low: float, vertical: bool = True) -> None:
    """Limit an axis of percentages to the data, whose lowest value or interval end is `low`."""
    limits = (max(-2.0, 5.0 * math.floor(low / 5.0) - 2.0), 101.5)
    (axes.set_ylim if vertical else axes.set_xlim)(*limits)


def legend(figure: Figure, axes: Axes, columns: int = 3, size: float = 9) -> None:
    """Draw the legend of `axes` below the figure."""
    handles, labels = axes.get_legend_handles_labels()
    location = "outside lower center"
    box = figure.legend(handles, labels, loc=location, ncols=columns, frameon=False, fontsize=size)
    for text in box.get_texts():
        text.set_parse_math(False)  # a policy's name may contain dollar signs


def dots(
    axes: Axes, x: Any, intervals: Sequence[Any], scale: float = 1, fmt: str = "o", **style: Any
) -> None:
    """Draw values with their intervals (value, low, high), times `scale`, as dots with bars."""
    value, low, high = scale * np.array(intervals).T
    axes.errorbar(x, value, np.maximum([value - low, high - value], 0), fmt=fmt, **style)


def curves_chart(
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    colours: Sequence[str] = LINES,
    follow: bool = False,
) -> bytes:
    """Return a PNG of gates, collisions and speed over gradient steps, a panel each.

    Thick lines are running means, thin lines are single steps. A curve has the rows of
    metrics.jsonl; one without rows is left out. With `follow`, the curves after the first begin
    where the first one ends, as a fine-tuning follows a training.
    """
    figure = Figure(figsize=(10.4, 3.1), layout="constrained")
    panels = figure.subplots(1, len(DRAWN))
    first_length = len(next(iter(curves.values()))) if follow else 0
    for axes, name in zip(panels, DRAWN, strict=True):
        offset = 0
        for (label, rows), colour in zip(curves.items(), colours, strict=False):
            if not rows:
                continue
            values = METRICS[name].scale * np.array([row[name] for row in rows], float)
            steps = offset + np.array([row["iteration"] for row in rows])
            axes.plot(steps, values, color=colour, lw=0.7, alpha=0.25)
            axes.plot(steps, _running_mean(values), color=colour, lw=1.8, label=label)
            offset = first_length
        titled(axes, METRICS[name].heading)
        axes.set_xlabel("gradient steps", fontsize=9)
        axes.set_ylim(bottom=0)
    if len(curves) > 1:
        legend(figure, panels[0], len(curves))
    return png(figure)


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Return running means over a twentieth of the values; at the ends over fewer values."""
    half_width = max(1, len(values) // 40)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    begin = np.maximum(np.arange(len(values)) - half_width, 0)
    end = np.minimum(np.arange(len(values)) + half_width + 1, len(values))
    return (sums[end] - sums[begin]) / (end - begin)


def png(figure: Figure) -> bytes:
    """Return the bytes of the figure as a PNG file."""
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI)
    return file.getvalue()
