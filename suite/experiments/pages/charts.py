"""Draw the charts of the result pages. Every function returns the bytes of a PNG file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath

import numpy as np
from matplotlib.figure import Figure

from eval.judging.statistics import wilson
from eval.judging.tables import Tally
from suite.common.charts import LINES, dots, legend, percent_axis, plain_axes, png, titled
from suite.common.curve import METRICS
from suite.experiments.pages.paper import Ablated, sim_to_sim
from suite.experiments.study.conditions import ConditionResult, Sweep
from suite.experiments.study.training import Spread, Summary
from tracks.families import JUDGED


def level_chart(cells: Sequence[Tally]) -> bytes:
    """Return a chart of the success rate (above) and v_max (below) by level, a column per track.

    Diamonds are the values of the paper, moved a little to the right. The axis shows all rates, but
    not the whole intervals of the paper, which are long.
    """
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    rows = figure.subplots(2, len(JUDGED), sharex=True, sharey="row")
    lowest, filled = 100.0, {"ms": 4, "lw": 1.2, "color": LINES[0]}
    hollow = {"ms": 5, "color": "#555b66", "mfc": "none"}
    for number, track in enumerate(JUDGED):
        upper, lower = rows[:, number]
        paper = [c for c in sim_to_sim().cells if (c.method, c.track) == ("with_delta", track)]
        paper_levels = np.array([c.level for c in paper]) + 0.25
        label = f"the paper, {paper[0].trials} trials per level (bars may be cut at the axis)"
        paper_rates = [wilson(c.won, c.trials) for c in paper]
        dots(upper, paper_levels, paper_rates, 100, label=label, fmt="D", lw=1.2, **hollow)
        lower.plot(paper_levels, [c.v_max for c in paper], "D", **hollow)
        ours = [cell for cell in cells if cell.track == track]
        levels = [c.difficulty for c in ours]
        label = f"{ours[0].policy}, {ours[0].trials} trials per level"
        dots(upper, levels, [c.success for c in ours], 100, label=label, **filled)
        dots(lower, levels, [c.v_max for c in ours], **filled)
        lowest = min([lowest, *(100 * c.success.low for c in ours)])
        lowest = min([lowest, *(100 * c.value for c in paper_rates)])
        titled(upper, track)
        plain_axes(lower)
        lower.set_xlabel("level", fontsize=9)
        lower.set_xticks(range(10))
    percent_axis(rows[0, 0], lowest)
    rows[0, 0].set_ylabel("success [%]", fontsize=9)
    rows[1, 0].set_ylabel("v_max, median [m/s]", fontsize=9)
    legend(figure, rows[0, 0])
    return png(figure)


def effects_chart(entries: Sequence[ConditionResult]) -> bytes:
    """Return a chart of the success rate under each effect, in rising order from above.

    The first of `entries` is the undisturbed condition: the top row, and dashed lines.
    """
    undisturbed, *others = entries
    names = list(undisturbed.results)
    others.sort(key=lambda entry: max(entry.success(name).value for name in names), reverse=True)
    ordered = [*others, undisturbed]
    figure = Figure(figsize=(8.6, 1.4 + 0.24 * len(ordered)), layout="constrained")
    axes = figure.subplots()
    y = np.arange(len(ordered))
    for number, name in enumerate(names):
        colour, offset = LINES[number % len(LINES)], 0.22 * (number - (len(names) - 1) / 2)
        rates = [entry.success(name) for entry in ordered]
        value, low, high = 100 * np.array(rates).T
        bars = np.maximum([value - low, high - value], 0)
        label = f"{name}, {len(undisturbed.results[name])} trials per row; dashed: undisturbed"
        style = {"fmt": "o", "ms": 4, "lw": 1.4, "color": colour, "label": label}
        axes.errorbar(value, y - offset, xerr=bars, **style)
        axes.axvline(100 * undisturbed.success(name).value, color=colour, lw=1, ls="--", alpha=0.6)
    axes.set_yticks(y, [f"{e.condition.name}  {e.condition.size_text}".strip() for e in ordered])
    percent_axis(axes, min(100 * e.success(n).low for e in ordered for n in names), vertical=False)
    axes.set_xlabel("success [%]", fontsize=9)
    titled(axes, "Success under one effect at a time, with 95 % Wilson intervals")
    axes.tick_params(axis="y", labelsize=7)
    legend(figure, axes)
    return png(figure)


def sweeps_chart(grown: Mapping[Sweep, Sequence[ConditionResult]]) -> bytes:
    """Return a chart of the success rate against the size of each disturbance, a panel each.

    Dots are at the measured sizes. With several policies they are moved a little sideways.
    """
    results = next(iter(grown.values()))[0].results
    names = list(results)
    # Divisions rounded up: at most four panels in a row, and rows of about equal length.
    rows = -(-len(grown) // 4)
    columns = -(-len(grown) // rows)
    figure = Figure(figsize=(10.4, 0.5 + 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(grown) :]:
        axes.set_visible(False)
    for axes, (sweep, points) in zip(panels, grown.items(), strict=False):
        sizes = [point.condition.size for point in points]
        spacing = 0.03 * (max(sizes) - min(sizes))
        for number, name in enumerate(names):
            x = np.array(sizes) + spacing * (number - (len(names) - 1) / 2)
            label = f"{short_name(name)}, {len(results[name])} trials per point"
            colour = LINES[number % len(LINES)]
            rates = [point.success(name) for point in points]
            dots(axes, x, rates, 100, ms=3.5, lw=1.2, color=colour, label=label)
        titled(axes, sweep.name)
        axes.set_xlabel(sweep.axis, fontsize=8)
        axes.set_ylabel("success [%]", fontsize=8)
        percent_axis(axes, min(100 * p.success(name).low for p in points for name in names))
    legend(figure, panels[0])
    return png(figure)


def short_name(policy: str) -> str:
    """Return a policy's label for a legend. For a checkpoint RUN/policy it is the name of RUN."""
    path = PurePath(policy)
    return path.parent.name if path.name == "policy" and path.parent.name else policy


def bars_chart(
    rows: Mapping[str, Mapping[str, Spread]],
    printed: Mapping[str, Ablated],
    kinds: Mapping[str, str],
    sample: str,
) -> bytes:
    """Return a chart of means over training seeds as bars, with the least and most as dots.

    Diamonds are the values of the paper. The key of a row is its kind and its weight, such as
    "field 0.4". `kinds` has the label of each kind, in the order of the colours. The legend has the
    `sample`: seeds and trials.
    """
    figure = Figure(figsize=(10.4, 5.2), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    paper_label: str | None = "the paper"
    for axes, name in zip(panels, ("success_cross", "collision_free", "v_max"), strict=True):
        scale = METRICS[name].scale
        for y, (key, numbers) in enumerate(rows.items()):
            colour = LINES[list(kinds).index(key.split()[0])]
            mean, least, most = (scale * value for value in numbers[name])
            axes.barh(y, mean, height=0.55, color=colour, alpha=0.6)
            label = f"mean, least and most of {sample}" if y == 0 else None
            axes.plot([least, most], [y, y], "o-", ms=4, lw=1.2, color=colour, label=label)
            if key in printed:
                paper_value = scale * getattr(printed[key], name)
                axes.plot(paper_value, y, "D", ms=7, mfc="none", mec="black", label=paper_label)
                paper_label = None  # once in the legend
        titled(axes, METRICS[name].title)
        if scale == 100:
            axes.set_xlim(-3, 103)
    labels = [f"{kinds[kind]} {weight}" for kind, weight in map(str.split, rows)]
    panels[0].set_yticks(range(len(rows)), labels)
    panels[0].invert_yaxis()
    legend(figure, panels[0])
    return png(figure)


def curves_chart(rows: Sequence[Summary], names: Sequence[str]) -> bytes:
    """Return a chart of measures over steps (above) and over time (below), a column per measure.

    A line is the mean over the training seeds of a scheme, a band the range from least to most,
    both without diverged trainings.
    """
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, len(names), sharey="col")
    for column, name in enumerate(names):
        scale = METRICS[name].scale
        for axes, key, label in ((upper[column], "steps", "environment steps [thousands]"),
                                 (lower[column], "time", "training [s]")):  # fmt: skip
            divisor = 1e3 if key == "steps" else 1.0
            for colour, row in zip(LINES, rows, strict=False):
                x = [point[key].mean / divisor for point in row.at]
                mean, least, most = scale * np.array([point[name] for point in row.at]).T
                axes.fill_between(x, least, most, color=colour, alpha=0.15, lw=0)
                text = f"{row.label}, {len(row.trainings)} seeds"
                axes.plot(x, mean, "o-", ms=3, color=colour, label=text)
            axes.set_xlabel(label, fontsize=9)
            titled(axes, METRICS[name].heading)
        if scale == 100:
            percent_axis(upper[column], min(100 * p[name].least for row in rows for p in row.at))
    legend(figure, upper[0])
    return png(figure)
