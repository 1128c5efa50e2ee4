"""The learning curves of training schemes, over environment steps and over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from suite.common.charts import LINES, png, titled
from suite.experiments.scheme_curves import FIGURE, METRICS, Row


def scheme_chart(rows: Sequence[Row]) -> bytes:
    """Return the paper's four numbers, a column each, with bands over training seeds."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, len(FIGURE), sharey="col")
    for column, name in enumerate(FIGURE):
        title, scale, _ = METRICS[name]
        for axes, words in ((upper[column], "environment steps"), (lower[column], "training [s]")):
            for number, row in enumerate(rows):
                x = row.steps if axes is upper[column] else row.time
                mean, least, most = scale * np.array(row.curves[name]).T
                colour = LINES[number]
                axes.fill_between(x, least, most, color=colour, alpha=0.15, lw=0)
                axes.plot(x, mean, color=colour, label=row.words)
            axes.set_xlabel(words, fontsize=9)
            titled(axes, title if name == "v_max" else title[0].upper() + title[1:])
        if scale == 100:
            upper[column].set_ylim(-3, 103)
    handles, labels = upper[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)
