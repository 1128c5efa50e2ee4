"""Success and speed over the ten levels, ours and what the paper prints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from eval.judging.tables import Cell
from suite.common.charts import LINES, png, titled
from suite.experiments.paper import sim_to_sim
from tracks.families import JUDGED

STYLES = ("-", "--", ":")
"""Of the policies, in order."""


def level_chart(cells: Sequence[Cell]) -> bytes:
    """Return success (left) and v_max (right) by level; colours are tracks, styles policies."""
    figure = Figure(figsize=(10.4, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    for colour, track in zip(LINES, JUDGED, strict=False):
        for style, policy in zip(STYLES, policies, strict=False):
            mine = [cell for cell in cells if (cell.policy, cell.track) == (policy, track)]
            levels = [cell.difficulty for cell in mine]
            label = track if len(policies) == 1 else f"{track}, {policy}"
            value, low, high = 100 * np.array([cell.success for cell in mine]).T
            left.fill_between(levels, low, high, color=colour, alpha=0.12, lw=0)
            left.plot(levels, value, style, marker="o", ms=4, color=colour, label=label)
            speeds = [cell.v_max.value for cell in mine]
            right.plot(levels, speeds, style, marker="o", ms=4, color=colour)
        theirs = [c for c in sim_to_sim().cells if (c.method, c.track) == ("with_delta", track)]
        levels, hollow = [cell.level for cell in theirs], {"mfc": "none", "mec": colour, "ls": ""}
        left.plot(levels, [100 * c.won / c.trials for c in theirs], marker="D", ms=7, **hollow)
        right.plot(levels, [c.v_max for c in theirs], marker="D", ms=7, **hollow)
    titled(left, "Success [%]")
    titled(right, "v_max, median over trials [m/s]")
    left.set_ylim(-3, 103)
    right.set_ylim(0, 1.05 * max(right.get_ylim()[1], 7.1))
    for axes in (left, right):
        axes.set_xlabel("level", fontsize=9)
        axes.set_xticks(range(10))
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return png(figure)
