"""What the ablation's page shows: rows over training seeds beside the paper's, and sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.judging.statistics import Interval, wilson
from suite.common.charts import LINES, png, titled
from suite.common.console import duration
from suite.common.report import Cell, Grid, Picture, Report, Section, ranged
from suite.experiments.paper import Ablated
from suite.experiments.paper import ablation as printed
from suite.experiments.seed_intervals import Spread, spread

if TYPE_CHECKING:
    from suite.experiments.ablation import Config, Setting, Trained

METRICS = ("success_cross", "success_rate", "v_max", "v_max_most", "gates")


class Row(NamedTuple):
    """One setting over its training seeds; those that diverged are left out of all numbers."""

    setting: str
    """Its key."""
    words: str
    weight: float
    seeds: int
    """Trainings, the diverged ones included."""
    diverged: int
    over: dict[str, Spread]
    """Of `METRICS`; empty where all diverged."""
    pooled: dict[str, Interval]
    """Wilson intervals of the two successes over the trials of all seeds; empty likewise."""


def summaries(chosen: Sequence[Setting], results: Sequence[Trained], trials: int) -> list[Row]:
    """Return every setting's row.

    Args:
        chosen: settings, in order.
        results: all their runs.
        trials: of each run.
    """
    rows = []
    for setting in chosen:
        mine = [run for run in results if run.setting == setting.key]
        found = [run.measured for run in mine if run.measured is not None]
        over, pooled = {}, {}
        if found:
            columns = {name: [numbers[name] for numbers in found] for name in METRICS}
            over = {name: spread(column) for name, column in columns.items()}
            pooled = {
                name: wilson(sum(round(trials * x) for x in columns[name]), trials * len(found))
                for name in METRICS[:2]
            }
        failed = len(mine) - len(found)
        rows.append(
            Row(setting.key, setting.words, setting.weight, len(mine), failed, over, pooled)
        )
    return rows


def verdict(rows: Sequence[Row]) -> str:
    """Return what came out in sentences: the field at the same lambda_p, then best against best."""
    measured = {row.setting: row for row in rows if row.over}
    fields = [row for key, row in measured.items() if key.startswith("field")]
    bare = [row for key, row in measured.items() if not key.startswith("field")]
    said = _same_weight(fields, measured)
    for words, group in (("with", fields), ("without", bare)):
        if group:
            best = _best(group)
            said.append(
                f"The most {words} the field is {_of(best, 'success_cross')} success cross "
                f"({best.setting}), at a success rate of {_of(best, 'success_rate')} and a v_max "
                f"of {best.over['v_max'].mean:.1f} m/s."
            )
    if fields and bare:
        said.append(f"The first is {_against(_best(fields), _best(bare))}.")
    said += [f"Every training of {row.setting} diverged." for row in rows if not row.over]
    return " ".join(said) or "No setting was measured."


def _best(rows: Sequence[Row]) -> Row:
    return max(rows, key=lambda row: row.over["success_cross"].mean)


def _same_weight(fields: Sequence[Row], measured: Mapping[str, Row]) -> list[str]:
    """Return a sentence on the weights at which nothing but the field differs, or none."""
    pairs = [
        (row.weight, row.over["success_cross"], measured[key].over["success_cross"])
        for row in fields
        if (key := f"progress {row.weight:g}") in measured
    ]
    if not pairs:
        return []
    listed = ", ".join(
        f"{100 * on.mean:.0f} and {100 * off.mean:.0f} % at {weight:g}" for weight, on, off in pairs
    )
    apart = sum(on.least > off.most for _, on, off in pairs)
    return [
        f"Success cross with the field and without it, at the same lambda_p of L_p: {listed}; at "
        f"{apart} of {len(pairs)} weights every seed with it is above every one without."
    ]


def _against(row: Row, other: Row) -> str:
    """Return how the success cross of `row` compares, and whether the seeds agree."""
    mine, theirs = row.over["success_cross"], other.over["success_cross"]
    points = round(100 * (mine.mean - theirs.mean))
    if mine.least > theirs.most:
        return f"{points} points more, and its worst seed above the best one"
    if mine.most < theirs.least:
        return f"{-points} points less, and its best seed below the worst one"
    if points == 0:
        return "as much"
    return f"{abs(points)} points {'more' if points > 0 else 'less'}, and their seeds overlap"


def beside_paper(rows: Sequence[Row]) -> str:
    """Return, in sentences, in which rows ours and the paper's numbers differ."""
    theirs = printed()[1]
    pairs = [(row, theirs[row.setting]) for row in rows if row.setting in theirs and row.over]
    if not pairs:
        return "No row that was measured has one in the paper."
    parts = []
    for name, words in (("success_cross", "success cross"), ("success_rate", "success rate")):
        outside = [
            (row, getattr(row_p, name)) for row, row_p in pairs if not _within(row, row_p, name)
        ]
        listed = "; ".join(
            f"{row.setting}: {100 * row.over[name].mean:.0f} % here, {100 * value:.0f} % there"
            for row, value in outside
        )
        inside = len(pairs) - len(outside)
        parts.append(
            f"The paper's {words} lies within the range of our seeds or their pooled interval in "
            f"{inside} of {len(pairs)} rows{': elsewhere ' + listed if listed else ''}."
        )
    ours = {row.setting: row.over["success_cross"].mean for row, _ in pairs}
    parts.append(
        f"Most success cross of these rows: {_most(ours)} here, "
        f"{_most({key: row.success_cross for key, row in theirs.items()})} in the paper."
    )
    return " ".join(parts)


def _most(rates: Mapping[str, float]) -> str:
    """Return the settings with the highest rate; nobody where that is zero."""
    top = max(rates.values())
    return ", ".join(key for key, rate in rates.items() if rate == top) if top else "no row"


def _within(row: Row, paper: Ablated, name: str) -> bool:
    low = min(row.over[name].least, row.pooled[name].low)
    return low <= getattr(paper, name) <= max(row.over[name].most, row.pooled[name].high)


def _of(row: Row, name: str) -> str:
    over = row.over[name]
    return f"{100 * over.mean:.0f} % ({100 * over.least:.0f} to {100 * over.most:.0f} over seeds)"


def ablation_report(
    config: Config, chosen: Sequence[Setting], rows: Sequence[Row], results: Sequence[Trained]
) -> Report:
    """Return the document.

    Args:
        config: what was asked.
        chosen: the settings.
        rows: of `summaries`.
        results: of every run.
    """
    recipe = chosen[0].recipe
    steps = recipe.optimizer.iterations * recipe.episode.batch * recipe.episode.steps
    each = duration(float(np.median([run.seconds for run in results])))
    commits = ", ".join(sorted({run.commit for run in results}))
    return Report(
        title="With the Attractive Vector Field and without it",
        lead=verdict(rows),
        facts={
            "recipe": " ".join(
                [config.preset, *config.set, f"episode.gates={recipe.episode.gates}"]
            ),
            "a training": f"{recipe.optimizer.iterations} gradient steps of "
            f"{recipe.episode.batch} worlds x {recipe.episode.steps} steps, {steps:,} in all; "
            f"{each} (median), {config.jobs} at a time",
            "training seeds": " ".join(map(str, config.training_seeds)),
            "trained at commit": commits,
            "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
        },
        sections=[
            Section(
                "The paper's table, and ours",
                [_main(rows), beside_paper(rows), Picture(_chart(rows), CAPTION)],
            ),
            Section("Every training", [_every(results)]),
            Section("What was measured", MEANING),
        ],
    )


CAPTION = "Bars: mean over training seeds; dots: each seed's least and most; diamonds: the paper's."
MEANING = (
    "Success cross: all gates passed without a collision before. Success rate: no collision, "
    "whatever gates were passed. A trial ends at a collision, at its last gate or at its time. "
    "v_max: the median over trials of each one's largest speed until its end; the paper does not "
    "say over what its maximum is taken.",
    "Trials fly the training's dynamics (the point mass with each world's own constants), from "
    "standing start on worlds that no training has seen, the same for all. A collision is what the "
    "trainer takes for one: the same code finds the nearest solid to the points of each step's "
    "path, and closer than the body's radius is a collision.",
    "All settings share the recipe but for the field, the form of progress and its lambda_p. The "
    "recipe is ours and not the paper's: its other weights, its horizon and its budget are "
    "those of the preset, so that the numbers are not expected to be the paper's; the order of the "
    "rows is what can be compared.",
    "Brackets: least and most over training seeds, and the 95 % Wilson interval of the pooled "
    "trials. The latter takes trials as independent; as all seeds of a setting fly the same worlds "
    "and differ in training, the range over seeds says more. A training that diverged is left "
    "out of the numbers and counted in its own column.",
)


def _main(rows: Sequence[Row]) -> Grid:
    source, theirs = printed()
    headers = ["setting", "lambda_p", "success cross [%]", "pooled", "paper", "success rate [%]",
               "pooled", "paper", "v_max [m/s]", "most", "paper", "gates", "diverged"]  # fmt: skip
    cells = []
    for row in rows:
        paper = theirs.get(row.setting)
        line = [row.words, f"{row.weight:g}"]
        for name in METRICS[:2]:
            line += [_range(row, name, 100, 0), _pooled(row, name)]
            line += [f"{100 * getattr(paper, name):.0f}" if paper else "-"]
        most = f"{row.over['v_max_most'].most:.1f}" if row.over else "-"
        line += [_range(row, "v_max", 1, 1), most, f"{paper.v_max:.1f}" if paper else "-"]
        line += [_range(row, "gates", 1, 2), f"{row.diverged} of {row.seeds}"]
        cells.append([Cell(text) for text in line])
    return Grid("", headers, cells, note=f"Paper: {source}.")


def _range(row: Row, name: str, scale: float, digits: int) -> str:
    if not row.over:
        return "diverged"
    mean, least, most = (scale * value for value in row.over[name])
    return ranged(mean, least, most, digits)


def _pooled(row: Row, name: str) -> str:
    if not row.over:
        return "-"
    return f"[{100 * row.pooled[name].low:.0f}, {100 * row.pooled[name].high:.0f}]"


def _every(results: Sequence[Trained]) -> Grid:
    headers = ["setting", "training seed", "success cross [%]", "success rate [%]", "v_max [m/s]",
               "gates", "trained for"]  # fmt: skip
    cells = []
    for run in results:
        found, line = run.measured, [run.setting, str(run.seed)]
        if found is None:
            line += ["diverged", "-", "-", "-"]
        else:
            line += [f"{100 * found[name]:.1f}" for name in METRICS[:2]]
            line += [f"{found['v_max']:.2f}", f"{found['gates']:.2f}"]
        cells.append([Cell(text) for text in [*line, duration(run.seconds)]])
    return Grid("", headers, cells)


def _chart(rows: Sequence[Row]) -> bytes:
    figure = Figure(figsize=(10.4, 5.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3, sharey=True)
    shown = [row for row in rows if row.over]
    _bars(left, shown, "success_cross", lambda p: p.success_cross, 100)
    _bars(middle, shown, "success_rate", lambda p: p.success_rate, 100)
    _bars(right, shown, "v_max", lambda p: p.v_max, 1)
    titled(left, "Success cross [%]")
    titled(middle, "Success rate [%]")
    titled(right, "v_max, median [m/s]")
    for axes in (left, middle):
        axes.set_xlim(-3, 103)
    left.set_yticks(range(len(shown)), [row.setting for row in shown])
    left.invert_yaxis()
    return png(figure)


def _bars(
    axes: Axes, rows: Sequence[Row], name: str, pick: Callable[[Ablated], float], scale: float
) -> None:
    theirs = printed()[1]
    for at, row in enumerate(rows):
        kind = ("field", "progress", "normalised").index(row.setting.split()[0])
        mean, least, most = (scale * value for value in row.over[name])
        axes.barh(at, mean, height=0.55, color=LINES[kind], alpha=0.6)
        axes.plot([least, most], [at, at], "o-", ms=4, lw=1.2, color=LINES[kind])
        if row.setting in theirs:
            axes.plot(scale * pick(theirs[row.setting]), at, "D", ms=7, mfc="none", mec="black")
