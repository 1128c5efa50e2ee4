"""The paper's ablation: with the Attractive Vector Field and without it, at several weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.judging.statistics import Interval, wilson
from suite.common.console import Console, duration
from suite.common.report import Picture
from suite.experiments.pages import paper
from suite.experiments.pages.document import Made
from suite.experiments.study import options, training
from suite.experiments.study.cache import Place
from suite.experiments.study.summary import Summary, summaries
from suite.train.overrides import check_owned, in_every_phase
from tracks.common.grid import Grid, table

PROGRESS = (0.4, 0.8, 1.6, 3.2)
"""lambda_p of L_p. The paper has the field only at the first; here each weight, and the recipe's
own, is trained with and without it, so that a pair differs in nothing but the field."""
NORMALISED = (1.6, 3.2, 6.4)
"""lambda_p of L_p^norm without the field."""
KINDS = {
    "field": "with the field, L_p",
    "progress": "without, L_p",
    "normalised": "without, L_p^norm",
}
"""Kinds of settings, the first words of their keys, with their labels."""
RATES = ("success_cross", "collision_free")
SPREADS = ("success_cross", "collision_free", "v_max", "v_max_most", "gates")


@dataclass(frozen=True)
class Config(options.FourGates):
    """Train with the vector field and without it, from several seeds, and fly unseen worlds.

    A training is reused if its configuration has the same hash.
    """

    only: tuple[str, ...] = ()
    """Settings, such as "field 0.4"; all by default."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; train and fly what is missing."""
    from suite.experiments.pages.charts import bars_chart

    chosen = settings(config)
    unseen = training.Unseen(0, config.trials, config.seed, config.seconds)
    study = training.Study(chosen, config.training_seeds, unseen)
    runs = training.trained(study, place, console)
    rows, recipe = summaries(chosen, runs), chosen[0].recipe
    whole = {row.key: row.at[-1] for row in rows if row.at}
    steps = config.iterations * recipe.episode.batch * recipe.episode.steps
    each = duration(float(np.median([run.seconds for run in runs])))
    trained = f"{len(config.training_seeds)} training seeds, {config.trials} trials each"
    chart = bars_chart(whole, paper.ablation()[1], KINDS, trained)
    facts = {
        "recipe": f"{' '.join([config.recipe, *config.set])} episode.gates={recipe.episode.gates}",
        "a training": f"{config.iterations} gradient steps of {recipe.episode.batch} worlds x "
        f"{recipe.episode.steps} steps, {steps:,} in all; {each} (median), at once "
        f"{place.at_once}",
        **training.facts(config, runs),
    }
    parts = {
        "The paper's table, and ours": [
            _main(rows, config.trials),
            Picture(chart, "Success cross, collision-free rate and v_max by setting"),
        ],
    }
    numbers = [
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
    ]
    each = [
        {
            "setting": run.row,
            "seed": run.seed,
            "seconds": run.seconds,
            "commit": run.commit,
            "measured": run.points[-1] if run.points else None,
            "diverged": run.diverged,
        }
        for run in runs
    ]
    return Made(facts, parts, {"rows": numbers, "runs": each})


def settings(config: Config) -> list[training.Row]:
    """Return the chosen settings, in the paper's order.

    Raises:
        ValueError: for an unknown recipe, change or setting.
    """
    fixed = ("progress_norm", "projection")
    check_owned(config.set, {f"loss.{name}": "it is compared" for name in fixed})
    base = options.four_gate_recipe(config)

    def row(kind: str, weight: float, **changes: float) -> training.Row:
        weights = {"progress": weight, "progress_norm": 0.0, **changes}
        recipe = in_every_phase(base, "loss", **weights)
        return training.Row(f"{kind} {weight:g}", KINDS[kind], recipe)

    weights = sorted({float(f"{weight:g}") for weight in (*PROGRESS, base.loss.progress)})
    rows = [row("field", w) for w in weights]
    rows += [row("progress", w, field_gain=0.0) for w in weights]
    rows += [
        row("normalised", w, progress=0.0, progress_norm=w, field_gain=0.0) for w in NORMALISED
    ]
    return list(options.chosen({row.key: row for row in rows}, config.only, "setting").values())


def weight(row: Summary) -> float:
    """Return lambda_p of the progress term that is used."""
    return row.recipe.loss.progress or row.recipe.loss.progress_norm


def pooled(row: Summary, name: str, trials: int) -> Interval:
    """Return the Wilson interval of a rate over the trials of all seeds, `trials` of each."""
    return wilson(sum(round(trials * x) for x in row.values(name)), trials * len(row.whole))


def _main(rows: Sequence[Summary], trials: int) -> Grid:
    source, theirs = paper.ablation()
    headers = ["setting", "lambda_p", "success cross [%]", "pooled [%]", "paper [%]",
               "collision-free rate [%]", "pooled [%]", "paper [%]",
               "v_max [m/s]", "largest [m/s]", "paper [m/s]", "gates", "diverged"]  # fmt: skip
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
