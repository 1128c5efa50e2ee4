"""The page `ablation`: trainings with the Attractive Vector Field and without it.

The field u_A is a term that guides the drone through gates (Su et al. 2026). Each setting is
trained from several seeds at several weights of the progress term, and flies tracks that no
training uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.judging.statistics import Interval, wilson
from suite.common.console import Console, duration
from suite.common.report import Picture
from suite.experiments.pages import paper
from suite.experiments.pages.document import PageContents
from suite.experiments.study import options, training
from suite.experiments.study.cache import Workspace
from suite.experiments.study.summary import Summary, summaries
from suite.train.overrides import check_owned, in_every_phase
from tracks.common.grid import Grid, table

PROGRESS = (0.4, 0.8, 1.6, 3.2)
"""lambda_p, the weight of the progress term L_p. The paper has the field only at the first weight;
here each weight, and the recipe's, is trained with and without it, so that only the field differs
in a pair."""
NORMALISED = (1.6, 3.2, 6.4)
"""lambda_p of L_p^norm, progress by direction alone, without the field."""
KINDS = {
    "field": "with the field, L_p",
    "progress": "without, L_p",
    "normalised": "without, L_p^norm",
}
"""Kinds of settings, the first words of their keys, with their labels."""
RATES = ("success_cross", "collision_free")
"""Numbers of `validation.mean_scores` that are rates."""
SPREADS = ("success_cross", "collision_free", "v_max", "v_max_most", "gates")
"""Numbers of `validation.mean_scores` in ablation.json."""


@dataclass(frozen=True)
class Config(options.FourGateOptions):
    """Train with the vector field and without it, from several seeds, and fly unseen worlds.

    A training is reused if its configuration has the same hash.
    """

    only: tuple[str, ...] = ()
    """Settings, such as "field 0.4"; all by default."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return tables and numbers; missing trainings and flights are made first."""
    from suite.experiments.pages.charts import bars_chart

    compared = settings(config)
    unseen = training.UnseenWorlds(0, config.trials, config.seed, config.seconds)
    study = training.Study(compared, config.training_seeds, unseen)
    runs = training.train_all(study, workspace, console)
    rows, recipe = summaries(compared, runs), compared[0].recipe
    at_end = {row.key: row.at[-1] for row in rows if row.at}
    steps = config.iterations * recipe.episode.batch * recipe.episode.steps
    median_time = duration(float(np.median([run.seconds for run in runs])))
    sample = f"{len(config.training_seeds)} training seeds, {config.trials} trials each"
    chart = bars_chart(at_end, paper.ablation()[1], KINDS, sample)
    facts = {
        "recipe": options.recipe_fact(config),
        "a training": f"{config.iterations} gradient steps of {recipe.episode.batch} worlds x "
        f"{recipe.episode.steps} steps, {steps:,} in all; {median_time} (median), "
        f"{workspace.at_once} at a time",
        **training.facts(config, runs),
    }
    parts = {
        "The paper's table, and ours": [
            _comparison_grid(rows, config.trials),
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
            "pooled": {name: pooled(row, name, config.trials) for name in RATES if row.at},
        }
        for row in rows
    ]
    trainings = [
        {
            "setting": run.setting,
            "seed": run.seed,
            "seconds": run.seconds,
            "commit": run.commit,
            "measured": run.points[-1] if run.points else None,
            "diverged": run.diverged,
        }
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
        weights = {"progress": weight, "progress_norm": 0.0, **changes}
        recipe = in_every_phase(base, "loss", **weights)
        return training.Setting(f"{kind} {weight:g}", KINDS[kind], recipe)

    weights = sorted({float(f"{weight:g}") for weight in (*PROGRESS, base.loss.progress)})
    found = [setting("field", w) for w in weights]
    found += [setting("progress", w, field_gain=0.0) for w in weights]
    found += [
        setting("normalised", w, progress=0.0, progress_norm=w, field_gain=0.0) for w in NORMALISED
    ]
    return list(options.select({each.key: each for each in found}, config.only, "setting").values())


def weight(row: Summary) -> float:
    """Return lambda_p of the setting's progress term."""
    return row.recipe.loss.progress or row.recipe.loss.progress_norm


def pooled(row: Summary, name: str, trials: int) -> Interval:
    """Return the Wilson interval of a rate over the trials of all seeds, `trials` of each."""
    return wilson(sum(round(trials * x) for x in row.values(name)), trials * len(row.trainings))


def _comparison_grid(rows: Sequence[Summary], trials: int) -> Grid:
    """Return our numbers next to the printed ones, a row per setting."""
    source, paper_rows = paper.ablation()
    headers = ["setting", "lambda_p", "success cross [%]", "pooled [%]", "paper [%]",
               "collision-free rate [%]", "pooled [%]", "paper [%]",
               "v_max [m/s]", "largest [m/s]", "paper [m/s]", "gates", "diverged"]  # fmt: skip
    lines = []
    for row in rows:
        printed = paper_rows.get(row.key)
        line = [row.label, f"{weight(row):g}"]
        for name in RATES:
            _, low, high = pooled(row, name, trials) if row.at else (0, 0, 0)
            line += [row.text(name), f"[{100 * low:.0f}, {100 * high:.0f}]" if row.at else "-"]
            line += [f"{100 * getattr(printed, name):.0f}" if printed else "-"]
        line += [row.text("v_max"), f"{max(row.values('v_max_most')):.1f}" if row.at else "-"]
        line += [f"{printed.v_max:.1f}" if printed else "-"]
        lines.append([*line, row.text("gates"), f"{row.diverged} of {row.seeds}"])
    return table(headers, lines, note=f"Paper: {source}.")
