"""The paper's ablation: with the Attractive Vector Field and without it, at several weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eval.judging.statistics import Interval, wilson
from suite.common.console import Console, duration
from suite.common.report import Picture, Report, Section
from suite.experiments.pages import paper
from suite.experiments.pages.document import Place
from suite.experiments.pages.tables import every_training
from suite.experiments.study import options, training
from suite.experiments.study.summary import Summary, summaries
from suite.train.overrides import check_owned
from tracks.common.grid import Grid, table

PROGRESS = (0.4, 0.8, 1.6, 3.2)
"""lambda_p of L_p. The paper has the field at the first alone; here it is on and off at each and at
the recipe's own weight, so that a pair differs in the field and in nothing else."""
NORMALISED = (1.6, 3.2, 6.4)
"""lambda_p of L_p^norm without the field."""
KINDS = ("field", "progress", "normalised")
"""First words of rows' keys."""
RATES = ("success_cross", "success_rate")
SPREADS = ("success_cross", "success_rate", "v_max", "v_max_most", "gates")
DIGITS = {"success_cross": 1, "success_rate": 1, "v_max": 2, "gates": 2}
"""Of every training's numbers."""
CAPTION = "Bars: mean over training seeds; dots: each seed's least and most; diamonds: the paper's."
MEANING = (
    "Success cross: all gates passed without a collision before. Success rate: no collision, "
    "whatever gates were passed. A trial ends at a collision, at its last gate or at its time. "
    "v_max: the median over trials of each one's largest speed until its end; the paper does not "
    "say over what its maximum is taken.",
    "Trials fly the training's dynamics (each world with its own constants), from "
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


@dataclass(frozen=True)
class Config(options.FourGates):
    """Train with the vector field and without it, from several seeds, and fly unseen worlds.

    Trainings are found again by the hash of their configuration.
    """

    only: tuple[str, ...] = ()
    """Settings, such as "field 0.4"; all if none is named."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; train and fly what is missing."""
    from suite.experiments.pages.charts import bars_chart

    chosen = settings(config)
    looks = training.Looks(0, config.trials, config.seed, config.seconds)
    study = training.Study(chosen, config.training_seeds, looks)
    runs = training.trained(study, place.cache, console, place.workers)
    rows, recipe = summaries(chosen, runs), chosen[0].recipe
    whole = {row.key: row.at[-1] for row in rows if row.at}
    steps = config.iterations * recipe.episode.batch * recipe.episode.steps
    each = duration(float(np.median([run.seconds for run in runs])))
    picture = Picture(bars_chart(whole, paper.ablation()[1], KINDS), CAPTION)
    report = Report(
        title="With the Attractive Vector Field and without it",
        lead=verdict(rows),
        facts={
            "recipe": f"{options.recipe_words(config)} episode.gates={recipe.episode.gates}",
            "a training": f"{config.iterations} gradient steps of {recipe.episode.batch} worlds x "
            f"{recipe.episode.steps} steps, {steps:,} in all; {each} (median), at once "
            f"{place.at_once}",
            "training seeds": " ".join(map(str, config.training_seeds)),
            "trained at commit": training.commits(runs),
            "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
        },
        sections=[
            Section(
                "The paper's table, and ours",
                [_main(rows, config.trials), beside_paper(rows, config.trials), picture],
            ),
            every_training("setting", runs, DIGITS, lambda run: duration(run.seconds)),
            Section("What was measured", MEANING),
        ],
    )
    return report, {
        "rows": [
            {
                "setting": row.key,
                "words": row.words,
                "weight": weight(row),
                "seeds": row.seeds,
                "diverged": row.diverged,
                "over": {name: row.at[-1][name] for name in SPREADS if row.at},
                "pooled": {name: pooled(row, name, config.trials) for name in RATES if row.at},
            }
            for row in rows
        ],
        "runs": [
            {
                "setting": run.row,
                "seed": run.seed,
                "seconds": run.seconds,
                "commit": run.commit,
                "measured": run.points[-1] if run.points else None,
                "diverged": run.diverged,
            }
            for run in runs
        ],
    }


def settings(config: Config) -> list[training.Row]:
    """Return the rows that are asked for, in the paper's order.

    Raises:
        ValueError: for a preset, a change or a row that does not exist.
    """
    fixed = ("progress_norm", "projection")
    check_owned(config.set, {f"loss.{name}": "it is compared" for name in fixed})
    base = options.four_gate_recipe(config)

    def row(key: str, words: str, weight: float, **changes: float) -> training.Row:
        weights = {"progress": weight, "progress_norm": 0.0, **changes}
        return training.Row(
            f"{key} {weight:g}", words, replace(base, loss=replace(base.loss, **weights))
        )

    weights = sorted({float(f"{weight:g}") for weight in (*PROGRESS, base.loss.progress)})
    rows = [row("field", "with the field, L_p", w) for w in weights]
    rows += [row("progress", "without, L_p", w, field_gain=0.0) for w in weights]
    rows += [
        row("normalised", "without, L_p^norm", w, progress=0.0, progress_norm=w, field_gain=0.0)
        for w in NORMALISED
    ]
    return training.asked_rows(rows, config.only, "setting")


def weight(row: Summary) -> float:
    """Return lambda_p."""
    return row.recipe.loss.progress or row.recipe.loss.progress_norm


def pooled(row: Summary, name: str, trials: int) -> Interval:
    """Return the Wilson interval of a rate over the trials of all seeds, `trials` of each."""
    return wilson(sum(round(trials * x) for x in row.values(name)), trials * len(row.whole))


def verdict(rows: Sequence[Summary]) -> str:
    """Return what came out in sentences: the field at the same lambda_p, then best against best."""
    measured = {row.key: row for row in rows if row.at}
    fields = [row for key, row in measured.items() if key.startswith("field")]
    bare = [row for key, row in measured.items() if not key.startswith("field")]
    said = _same_weight(fields, measured)
    for words, group in (("with", fields), ("without", bare)):
        if group:
            best = _best(group)
            said.append(
                f"The most {words} the field is {_of(best, 'success_cross')} success cross "
                f"({best.key}), at a success rate of {_of(best, 'success_rate')} and a v_max "
                f"of {best.at[-1]['v_max'].mean:.1f} m/s."
            )
    if fields and bare:
        said.append(f"The first is {_against(_best(fields), _best(bare))}.")
    said += [f"Every training of {row.key} diverged." for row in rows if not row.at]
    return " ".join(said) or "No setting was measured."


def _best(rows: Sequence[Summary]) -> Summary:
    return max(rows, key=lambda row: row.at[-1]["success_cross"].mean)


def _same_weight(fields: Sequence[Summary], measured: Mapping[str, Summary]) -> list[str]:
    """Return a sentence on the weights at which nothing but the field differs, or none."""
    pairs = [
        (weight(row), row.at[-1]["success_cross"], measured[key].at[-1]["success_cross"])
        for row in fields
        if (key := f"progress {weight(row):g}") in measured
    ]
    if not pairs:
        return []
    listed = ", ".join(
        f"{100 * on.mean:.0f} and {100 * off.mean:.0f} % at {at:g}" for at, on, off in pairs
    )
    apart = sum(on.least > off.most for _, on, off in pairs)
    return [
        f"Success cross with the field and without it, at the same lambda_p of L_p: {listed}; at "
        f"{apart} of {len(pairs)} weights every seed with it is above every one without."
    ]


def _against(row: Summary, other: Summary) -> str:
    """Return how the success cross of `row` compares, and whether the seeds agree."""
    mine, theirs = row.at[-1]["success_cross"], other.at[-1]["success_cross"]
    points = round(100 * (mine.mean - theirs.mean))
    if mine.least > theirs.most:
        return f"{points} points more, and its worst seed above the best one"
    if mine.most < theirs.least:
        return f"{-points} points less, and its best seed below the worst one"
    if points == 0:
        return "as much"
    return f"{abs(points)} points {'more' if points > 0 else 'less'}, and their seeds overlap"


def beside_paper(rows: Sequence[Summary], trials: int) -> str:
    """Return, in sentences, in which rows ours and the paper's numbers differ."""
    theirs = paper.ablation()[1]
    pairs = [(row, theirs[row.key]) for row in rows if row.key in theirs and row.at]
    if not pairs:
        return "No row that was measured has one in the paper."
    parts = []
    for name, words in (("success_cross", "success cross"), ("success_rate", "success rate")):
        there = [(row, getattr(row_p, name)) for row, row_p in pairs]
        outside = [(row, x) for row, x in there if not _within(row, x, name, trials)]
        listed = "; ".join(
            f"{row.key}: {100 * row.at[-1][name].mean:.0f} % here, {100 * value:.0f} % there"
            for row, value in outside
        )
        inside = len(pairs) - len(outside)
        parts.append(
            f"The paper's {words} lies within the range of our seeds or their pooled interval in "
            f"{inside} of {len(pairs)} rows{': elsewhere ' + listed if listed else ''}."
        )
    ours = {row.key: row.at[-1]["success_cross"].mean for row, _ in pairs}
    parts.append(
        f"Most success cross of these rows: {_most(ours)} here, "
        f"{_most({key: row.success_cross for key, row in theirs.items()})} in the paper."
    )
    return " ".join(parts)


def _most(rates: Mapping[str, float]) -> str:
    """Return the settings with the highest rate; nobody where that is zero."""
    top = max(rates.values())
    return ", ".join(key for key, rate in rates.items() if rate == top) if top else "no row"


def _within(row: Summary, value: float, name: str, trials: int) -> bool:
    over, pool = row.at[-1][name], pooled(row, name, trials)
    return min(over.least, pool.low) <= value <= max(over.most, pool.high)


def _of(row: Summary, name: str) -> str:
    over = row.at[-1][name]
    return f"{100 * over.mean:.0f} % ({100 * over.least:.0f} to {100 * over.most:.0f} over seeds)"


def _main(rows: Sequence[Summary], trials: int) -> Grid:
    source, theirs = paper.ablation()
    headers = ["setting", "lambda_p", "success cross [%]", "pooled", "paper", "success rate [%]",
               "pooled", "paper", "v_max [m/s]", "most", "paper", "gates", "diverged"]  # fmt: skip
    lines = []
    for row in rows:
        printed = theirs.get(row.key)
        line = [row.words, f"{weight(row):g}"]
        for name in RATES:
            _, low, high = pooled(row, name, trials) if row.at else (0, 0, 0)
            line += [row.text(name), f"[{100 * low:.0f}, {100 * high:.0f}]" if row.at else "-"]
            line += [f"{100 * getattr(printed, name):.0f}" if printed else "-"]
        line += [row.text("v_max"), f"{max(row.values('v_max_most')):.1f}" if row.at else "-"]
        line += [f"{printed.v_max:.1f}" if printed else "-"]
        lines.append([*line, row.text("gates"), f"{row.diverged} of {row.seeds}"])
    return table(headers, lines, note=f"Paper: {source}.")
