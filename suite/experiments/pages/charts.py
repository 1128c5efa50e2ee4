"""The documents' charts, each as a PNG file's bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import wilson
from eval.judging.tables import Tally
from suite.common.charts import LINES, dots, legend, plain_axes, png, titled
from suite.common.curve import METRICS
from suite.experiments.pages.paper import Ablated, sim_to_sim
from suite.experiments.study.conditions import Sweep
from suite.experiments.study.disturbed import Tested
from suite.experiments.study.summary import Spread, Summary
from tracks.families import JUDGED


def _percent_axis(axes: Axes, low: float, vertical: bool = True) -> None:
    """Have an axis of percentages cover the data, whose lowest value or interval end is `low`."""
    ends = (max(-2.0, 5.0 * math.floor(low / 5.0) - 2.0), 101.5)
    (axes.set_ylim if vertical else axes.set_xlim)(*ends)


def level_chart(cells: Sequence[Tally]) -> bytes:
    """Return a policy's success and v_max below by level, a column a track, next to the paper's."""
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    rows = figure.subplots(2, len(JUDGED), sharex=True, sharey="row")
    lowest, filled = 100.0, {"ms": 4, "lw": 1.2, "color": LINES[0]}
    hollow = {"ms": 5, "color": "#555b66", "mfc": "none"}
    for number, track in enumerate(JUDGED):
        upper, lower = rows[:, number]
        theirs = [c for c in sim_to_sim().cells if (c.method, c.track) == ("with_delta", track)]
        at = np.array([c.level for c in theirs]) + 0.25
        words = f"the paper, {theirs[0].trials} trials a level"
        printed = [wilson(c.won, c.trials) for c in theirs]
        dots(upper, at, printed, 100, label=words, fmt="D", lw=1.2, **hollow)
        lower.plot(at, [c.v_max for c in theirs], "D", **hollow)
        mine = [cell for cell in cells if cell.track == track]
        levels = [c.difficulty for c in mine]
        words = f"{mine[0].policy}, {mine[0].trials} trials a level"
        dots(upper, levels, [c.success for c in mine], 100, label=words, **filled)
        dots(lower, levels, [c.v_max for c in mine], **filled)
        lowest = min([lowest, *(100 * c.success.low for c in mine)])
        lowest = min([lowest, *(100 * c.value for c in printed)])
        titled(upper, track)
        plain_axes(lower)
        lower.set_xlabel("level", fontsize=9)
        lower.set_xticks(range(10))
    _percent_axis(rows[0, 0], lowest)
    rows[0, 0].set_ylabel("success [%]", fontsize=9)
    rows[1, 0].set_ylabel("v_max, median [m/s]", fontsize=9)
    legend(figure, rows[0, 0])
    return png(figure)


def effects_chart(entries: Sequence[Tested]) -> bytes:
    """Return success under each effect, the worst on top; the first entry is undisturbed."""
    first, *others = entries
    names = list(first.results)
    others.sort(key=lambda entry: max(entry.success(name).value for name in names), reverse=True)
    shown = [*others, first]
    figure = Figure(figsize=(8.6, 1.4 + 0.24 * len(shown)), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(shown))
    for number, name in enumerate(names):
        colour, place = LINES[number % len(LINES)], 0.22 * (number - (len(names) - 1) / 2)
        found = [entry.success(name) for entry in shown]
        value, low, high = 100 * np.array(found).T
        reach = np.maximum([value - low, high - value], 0)
        label = f"{name}, {len(first.results[name])} trials a row; dashed: undisturbed"
        style = {"fmt": "o", "ms": 4, "lw": 1.4, "color": colour, "label": label}
        axes.errorbar(value, at - place, xerr=reach, **style)
        axes.axvline(100 * first.success(name).value, color=colour, lw=1, ls="--", alpha=0.6)
    axes.set_yticks(at, [f"{e.condition.name}  {e.condition.words}".strip() for e in shown])
    _percent_axis(axes, min(100 * e.success(n).low for e in shown for n in names), vertical=False)
    axes.set_xlabel("success [%]", fontsize=9)
    titled(axes, "Success under one effect at a time, with 95 % Wilson intervals")
    axes.tick_params(axis="y", labelsize=7)
    legend(figure, axes)
    return png(figure)


def sweeps_chart(grown: Mapping[Sweep, Sequence[Tested]]) -> bytes:
    """Return success against the size of each disturbance, a panel each.

    Only measured sizes are drawn; dots of several policies stand next to each other.
    """
    results = next(iter(grown.values()))[0].results
    names = list(results)
    rows = -(-len(grown) // 4)
    columns = -(-len(grown) // rows)
    figure = Figure(figsize=(10.4, 0.5 + 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(grown) :]:
        axes.set_visible(False)
    for axes, (sweep, points) in zip(panels, grown.items(), strict=False):
        sizes = [point.condition.size for point in points]
        apart = 0.03 * (max(sizes) - min(sizes))
        for number, name in enumerate(names):
            at = np.array(sizes) + apart * (number - (len(names) - 1) / 2)
            label = f"{short_name(name)}, {len(results[name])} trials a point"
            colour = LINES[number % len(LINES)]
            found = [point.success(name) for point in points]
            dots(axes, at, found, 100, ms=3.5, lw=1.2, color=colour, label=label)
        titled(axes, sweep.name)
        axes.set_xlabel(sweep.axis, fontsize=8)
        axes.set_ylabel("success [%]", fontsize=8)
        _percent_axis(axes, min(100 * p.success(name).low for p in points for name in names))
    legend(figure, panels[0])
    return png(figure)


def short_name(policy: str) -> str:
    """Return a policy's label for a legend: of a checkpoint RUN/policy the name of the run."""
    path = PurePath(policy)
    return path.parent.name if path.name == "policy" and path.parent.name else policy


def bars_chart(
    rows: Mapping[str, Mapping[str, Spread]],
    printed: Mapping[str, Ablated],
    kinds: Mapping[str, str],
    trained: str,
) -> bytes:
    """Return means over training seeds as bars, least and most as dots, the paper's as diamonds.

    Args:
        rows: numbers by key: a kind and its weight, such as "field 0.4".
        printed: the paper's, of some keys.
        kinds: label of each kind, in the colours' order.
        trained: the seeds and trials, for the legend.
    """
    figure = Figure(figsize=(10.4, 5.2), layout="constrained")
    every = figure.subplots(1, 3, sharey=True)
    for axes, name in zip(every, ("success_cross", "collision_free", "v_max"), strict=True):
        scale = METRICS[name].scale
        for at, (key, numbers) in enumerate(rows.items()):
            colour = LINES[list(kinds).index(key.split()[0])]
            mean, least, most = (scale * value for value in numbers[name])
            axes.barh(at, mean, height=0.55, color=colour, alpha=0.6)
            label = f"mean, least and most of {trained}" if at == 0 else None
            axes.plot([least, most], [at, at], "o-", ms=4, lw=1.2, color=colour, label=label)
            if key in printed:
                theirs = scale * getattr(printed[key], name)
                label = "the paper" if at == 0 else None
                axes.plot(theirs, at, "D", ms=7, mfc="none", mec="black", label=label)
        titled(axes, METRICS[name].title)
        if scale == 100:
            axes.set_xlim(-3, 103)
    labels = [f"{kinds[kind]} {weight}" for kind, weight in map(str.split, rows)]
    every[0].set_yticks(range(len(rows)), labels)
    every[0].invert_yaxis()
    legend(figure, every[0])
    return png(figure)


def curves_chart(rows: Sequence[Summary], names: Sequence[str]) -> bytes:
    """Return numbers over steps and over time, a column each; bands span the training seeds."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, len(names), sharey="col")
    for column, name in enumerate(names):
        scale = METRICS[name].scale
        for axes, x, words in ((upper[column], "steps", "environment steps [thousands]"),
                               (lower[column], "time", "training [s]")):  # fmt: skip
            unit = 1e3 if x == "steps" else 1.0
            for colour, row in zip(LINES, rows, strict=False):
                at = [point[x].mean / unit for point in row.at]
                mean, least, most = scale * np.array([point[name] for point in row.at]).T
                axes.fill_between(at, least, most, color=colour, alpha=0.15, lw=0)
                axes.plot(
                    at, mean, "o-", ms=3, color=colour, label=f"{row.words}, {row.seeds} seeds"
                )
            axes.set_xlabel(words, fontsize=9)
            titled(axes, METRICS[name].heading)
        if scale == 100:
            _percent_axis(upper[column], min(100 * p[name].least for row in rows for p in row.at))
    legend(figure, upper[0])
    return png(figure)
