"""The page `ablation`: trainings with the Attractive Vector Field (Su et al. 2026) and without it.

Each setting is trained from several seeds, and flies tracks that no training uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from suite.common.console import Console, duration
from suite.common.report import Picture
from suite.experiments.pages import paper
from suite.experiments.pages.document import PageContents
from suite.experiments.study import options, training
from suite.experiments.study.cache import Workspace
from suite.experiments.study.training import Summary
from suite.train.overrides import check_owned
from tracks.common.grid import Grid, table

PROGRESS = (0.4, 0.8, 1.6, 3.2)
"""Values of lambda_p, the weight of the progress term L_p. The paper trains with the field only at
the first of these weights. Here each of them, and the weight of the recipe, is trained with and
without the field, so that the two trainings of a pair differ in the field only."""
NORMALISED = (1.6, 3.2, 6.4)
"""Values of lambda_p, trained without the field, for the term L_p^norm. It rewards the direction of
flight alone."""
KINDS = {
    "field": "with the field, L_p",
    "progress": "without, L_p",
    "normalised": "without, L_p^norm",
}
"""Kind of a setting -> its label in tables. The key of a setting is its kind and its weight, such
as "field 0.4"."""
RATES = ("success_cross", "collision_free")
"""Measures of `validation.mean_scores` that are shares of the trials."""
SPREADS = ("success_cross", "collision_free", "v_max", "v_max_most", "gates")
"""Measures of `validation.mean_scores` that ablation.json has."""


@dataclass(frozen=True)
class Config(options.FourGateOptions):
    """Train with the vector field and without it, from several seeds, and fly unseen worlds.

    A training is reused if its configuration has the same hash.
    """

    only: tuple[str, ...] = ()
    """Settings, such as "field 0.4"; all by default."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; missing trainings and flights are made first."""
    from suite.experiments.pages.charts import bars_chart

    # The first argument is 0: only the finished policies are measured.
    compared = settings(config)
    unseen = training.UnseenWorlds(0, config.trials, config.seed, config.seconds)
    runs = training.train_all(compared, config.training_seeds, unseen, workspace, console)
    rows, recipe = training.summaries(compared, runs), compared[0].recipe
    at_end = {row.key: row.at[-1] for row in rows if row.at}
    steps = config.iterations * recipe.episode.batch * recipe.episode.steps
    median_time = duration(float(np.median([run.seconds for run in runs])))
    sample = f"{len(config.training_seeds)} training seeds, {config.trials} trials each"
    chart = bars_chart(at_end, paper.ablation()[1], KINDS, sample)
    facts = {
        "recipe": options.recipe_fact(config),
        "a training": f"{config.iterations} gradient steps of {recipe.episode.batch} worlds x "
        f"{recipe.episode.steps} steps, {steps:,} in all; {median_time} (median)",
        **training.facts(config, runs),
    }
    parts = {
        "The paper's table, and ours": [
            _comparison_grid(rows),
            Picture(chart, "Success cross, collision-free rate and v_max by setting"),
        ],
    }
    numbers = [
        {
            "setting": row.key,
            "words": row.label,
            "weight": weight(row),
            "seeds": row.seeds,
            "diverged": row.diverged,
            "over": {name: row.at[-1][name] for name in SPREADS if row.at},
        }
        for row in rows
    ]
    fields = ("setting", "seed", "seconds", "commit", "machine", "diverged")
    trainings = [
        {**{f: getattr(run, f) for f in fields}, "measured": run.points[-1] if run.points else None}
        for run in runs
    ]
    return PageContents(facts, parts, {"rows": numbers, "runs": trainings})


def settings(config: Config) -> list[training.Setting]:
    """Return the selected settings, in the paper's order.

    Raises:
        ValueError: for an unknown recipe, change or setting.
    """
    fixed = ("progress_norm", "projection")
    check_owned(config.set, {f"loss.{name}": "it is compared" for name in fixed})
    base = options.four_gate_recipe(config)

    def setting(kind: str, weight: float, **changes: float) -> training.Setting:
        """Return the setting of a kind, with `changes` of the weights of the loss in the recipe."""
        weights: dict[str, Any] = {"progress": weight, "progress_norm": 0.0, **changes}
        recipe = replace(base, loss=replace(base.loss, **weights))
        return training.Setting(f"{kind} {weight:g}", KINDS[kind], recipe)

    weights = sorted({float(f"{weight:g}") for weight in (*PROGRESS, base.loss.progress)})
    all_settings = [setting("field", w) for w in weights]
    all_settings += [setting("progress", w, field_gain=0.0) for w in weights]
    all_settings += [
        setting("normalised", w, progress=0.0, progress_norm=w, field_gain=0.0) for w in NORMALISED
    ]
    return list(
        options.select({each.key: each for each in all_settings}, config.only, "setting").values()
    )


def weight(row: Summary) -> float:
    """Return lambda_p, the weight of the progress term of the setting."""
    return row.recipe.loss.progress or row.recipe.loss.progress_norm


def _comparison_grid(rows: Sequence[Summary]) -> Grid:
    """Return a table of our results and those that the paper prints, a row per setting."""
    source, paper_rows = paper.ablation()
    headers = ["setting", "lambda_p", "success cross [%]", "paper [%]",
               "collision-free rate [%]", "paper [%]",
               "v_max [m/s]", "largest [m/s]", "paper [m/s]", "gates", "diverged"]  # fmt: skip
    lines = []
    for row in rows:
        printed = paper_rows.get(row.key)
        line = [row.label, f"{weight(row):g}"]
        for name in RATES:
            paper_rate = f"{100 * getattr(printed, name):.0f}" if printed else "-"
            line += [row.text(name), paper_rate]
        line += [row.text("v_max"), f"{max(row.values('v_max_most')):.1f}" if row.at else "-"]
        line += [f"{printed.v_max:.1f}" if printed else "-"]
        lines.append([*line, row.text("gates"), f"{row.diverged} of {row.seeds}"])
    return table(headers, lines, note=f"Paper: {source}.")
