"""What all charts share: colours, plain axes, and a figure as PNG bytes."""

from __future__ import annotations

import io

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

GRID = "#e6e9ee"
LINES = ("#2463c9", "#e0892b", "#2e8b57", "#b0413e", "#7a5cb8", "#8b93a1")
"""Colours of what is compared, in order."""
DPI = 130


def titled(axes: Axes, title: str) -> None:
    """Put `title` above the axes and leave out what is no data."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    plain_axes(axes)


def plain_axes(axes: Axes) -> None:
    """Leave out what is no data."""
    axes.grid(color=GRID, lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG file's bytes."""
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI)
    return file.getvalue()
