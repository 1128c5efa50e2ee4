"""The documents' charts, each as a PNG file's bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.tables import Tally
from suite.common.charts import LINES, png, titled
from suite.experiments.pages.paper import Ablated, sim_to_sim
from suite.experiments.study.conditions import Sweep
from suite.experiments.study.disturbed import Tested
from suite.experiments.study.intervals import Spread
from suite.experiments.study.summary import METRICS, Summary
from tracks.families import JUDGED

STYLES = ("-", "--", ":")
"""Of the policies over levels, in order."""


def _legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    handles, labels = axes.get_legend_handles_labels()
    legend = figure.legend(
        handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9
    )
    for text in legend.get_texts():
        text.set_parse_math(False)  # a policy's name may hold dollar signs


def level_chart(cells: Sequence[Tally]) -> bytes:
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
    _legend(figure, left)
    return png(figure)


def cells_chart(cells: Mapping[str, Sequence[Tally]]) -> bytes:
    """Return success of every policy, cell by cell, as dots with intervals."""
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.subplots()
    first = next(iter(cells.values()))
    for number, (name, some) in enumerate(cells.items()):
        value, low, high = 100 * np.array([cell.success for cell in some]).T
        at = np.arange(len(some)) + 0.12 * (number - (len(cells) - 1) / 2)
        reach = np.maximum([value - low, high - value], 0)
        colour = LINES[number % len(LINES)]
        axes.errorbar(at, value, reach, fmt="o", ms=4, lw=1.2, color=colour, label=name)
    titled(axes, "Success with 95 % Wilson intervals [%]")
    axes.set_ylim(-3, 103)
    axes.set_xticks(range(len(first)), [f"{c.track}\nlevel {c.difficulty}" for c in first])
    axes.tick_params(labelsize=7)
    _legend(figure, axes, columns=6)
    return png(figure)


def effects_chart(entries: Sequence[Tested]) -> bytes:
    """Return success under each effect as dots with intervals, the undisturbed as a line."""
    figure = Figure(figsize=(8.6, 1.2 + 0.24 * len(entries)), layout="constrained")
    axes = figure.subplots()
    at, names = np.arange(len(entries))[::-1], list(entries[0].results)
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
        _legend(figure, axes)
    return png(figure)


def sweeps_chart(grown: Mapping[Sweep, Sequence[Tested]], names: Sequence[str] = ()) -> bytes:
    """Return success against the size of each disturbance, a panel each; of `names` or of all."""
    names = names or list(next(iter(grown.values()))[0].results)
    rows = -(-len(grown) // 4)
    columns = -(-len(grown) // rows)
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
        _legend(figure, panels[0])
    return png(figure)


def bars_chart(
    rows: Mapping[str, Mapping[str, Spread]], printed: Mapping[str, Ablated], kinds: Sequence[str]
) -> bytes:
    """Return means over training seeds as bars, least and most as dots, the paper's as diamonds.

    Args:
        rows: numbers by key; the key's first word sets the colour.
        printed: the paper's, of some keys.
        kinds: all first words of keys, in the colours' order.
    """
    figure = Figure(figsize=(10.4, 5.2), layout="constrained")
    every = figure.subplots(1, 3, sharey=True)
    for axes, name in zip(every, ("success_cross", "success_rate", "v_max"), strict=True):
        title, scale, _ = METRICS[name]
        for at, (key, numbers) in enumerate(rows.items()):
            colour = LINES[kinds.index(key.split()[0])]
            mean, least, most = (scale * value for value in numbers[name])
            axes.barh(at, mean, height=0.55, color=colour, alpha=0.6)
            axes.plot([least, most], [at, at], "o-", ms=4, lw=1.2, color=colour)
            if key in printed:
                theirs = scale * getattr(printed[key], name)
                axes.plot(theirs, at, "D", ms=7, mfc="none", mec="black")
        titled(axes, title)
        if scale == 100:
            axes.set_xlim(-3, 103)
    every[0].set_yticks(range(len(rows)), list(rows))
    every[0].invert_yaxis()
    return png(figure)


def curves_chart(rows: Sequence[Summary], names: Sequence[str]) -> bytes:
    """Return numbers over steps and over time, a column each, with bands over training seeds."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, len(names), sharey="col")
    for column, name in enumerate(names):
        title, scale, _ = METRICS[name]
        for axes, x, words in ((upper[column], "steps", "environment steps"),
                               (lower[column], "time", "training [s]")):  # fmt: skip
            for colour, row in zip(LINES, rows, strict=False):
                at = [point[x].mean for point in row.at]
                mean, least, most = scale * np.array([point[name] for point in row.at]).T
                axes.fill_between(at, least, most, color=colour, alpha=0.15, lw=0)
                axes.plot(at, mean, color=colour, label=row.words)
            axes.set_xlabel(words, fontsize=9)
            titled(axes, title if name == "v_max" else title[0].upper() + title[1:])
        if scale == 100:
            upper[column].set_ylim(-3, 103)
    _legend(figure, upper[0])
    return png(figure)
