"""The page `schemes`: the paper's comparison of three schemes (ways of training a policy).

They are PPO, our method, and our method without the Attractive Vector Field ("the field"). During
the training they are measured on tracks that no training uses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from suite.common.console import Console, duration
from suite.common.curve import METRICS
from suite.common.report import Picture
from suite.experiments.pages.document import PageContents
from suite.experiments.study import options, training
from suite.experiments.study.cache import Workspace
from suite.experiments.study.training import Summary
from suite.train.overrides import check_owned
from suite.train.ppo.config import ppo_like
from tracks.common.grid import Grid, table
from tracks.input.ranges import Iterations, Range, Trials

PROJECTION, PROJECTION_DECAY = 3.0, 0.5
"""lambda_proj and beta_3: weight and decay of L_proj, the paper's substitute for the field."""
FIGURE = ("reward", "v_max", "collision_free", "gates")
"""Measures of `validation.mean_scores` in the chart; the paper's figure has the same ones."""
MEASURED = ("reward", "success_cross", "collision_free", "v_max", "gates")
"""Measures of `validation.mean_scores` in the table and in schemes.json."""
GATE_COUNTS = (1, 2, 3)
"""Numbers of passed gates, of the four of a track. A table has the time at which the mean over the
trials first reaches each of them."""


@dataclass(frozen=True)
class Config(options.FourGateOptions):
    """Train by PPO, by our method, and by ours without the field, and measure them as they learn.

    All three share policy, dynamics, worlds and, without --ppo-iterations, the number of
    environment steps. A training is reused if its configuration and its measurements have the same
    hash.
    """

    progress: Annotated[float, Range(0.0, 1e6)] = 0.4
    """lambda_p, the weight of progress in both differentiable schemes; by default the paper's."""
    ppo_iterations: Iterations | None = None
    """Rollouts of PPO; by default the number of the others' gradient steps."""
    trials: Trials = 100
    """Unseen worlds flown at every measurement."""
    measurements: Annotated[int, Range(1, 10_000)] = 20
    """Approximate number of measurements of a training; their time does not count in the curves."""
    only: tuple[str, ...] = ()
    """Schemes: ppo, ours, projection; all by default."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; missing trainings are made first."""
    from suite.experiments.pages.charts import curves_chart

    compared = schemes(config)
    unseen = training.UnseenWorlds(config.measurements, config.trials, config.seed, config.seconds)
    runs = training.train_all(
        compared, config.training_seeds, unseen, workspace, console, by_seed=True
    )
    rows, episode = training.summaries(compared, runs), compared[0].recipe.episode
    compile_s = {
        row.key: float(np.mean([run.compile_s for run in runs if run.setting == row.key]))
        for row in rows
    }
    facts = {
        "recipe": f"{options.recipe_fact(config)}, lambda_p={config.progress:g}",
        "an iteration": f"{episode.batch} worlds x {episode.steps} steps",
        **training.facts(config, runs),
    }
    measured = [row for row in rows if row.at]
    tables = [_end_grid(measured), _time_grid(measured, compile_s)]
    title = "Learning curves over steps and over time"
    chart = [Picture(curves_chart(measured, FIGURE), title)] if measured else []
    parts = {"Learning curves": [*chart, *tables]}
    numbers = [
        {
            "scheme": row.key,
            "words": row.label,
            "seeds": row.seeds,
            "diverged": row.diverged,
            "steps": [int(point["steps"].mean) for point in row.at],
            "time": [point["time"].mean for point in row.at],
            "curves": {n: [point[n] for point in row.at] for n in MEASURED if row.at},
            "reached": {gates: first_times(row, gates) for gates in GATE_COUNTS},
            "compile_s": compile_s[row.key],
        }
        for row in rows
    ]
    fields = ("seed", "points", "compile_s", "commit", "machine", "diverged")
    trainings = [{"scheme": run.setting, **{f: getattr(run, f) for f in fields}} for run in runs]
    return PageContents(facts, parts, {"rows": numbers, "runs": trainings})


def schemes(config: Config) -> list[training.Setting]:
    """Return the selected schemes, in the paper's order.

    Raises:
        ValueError: for an unknown recipe, change or scheme, and for a number of worlds that is no
            multiple of PPO's minibatches.
    """
    compared = ("progress_norm", "projection", "projection_decay")
    owned = {f"loss.{name}": "it is compared" for name in compared}
    check_owned(config.set, {"loss.progress": "give --progress", **owned})
    base = options.four_gate_recipe(config)
    loss = replace(base.loss, progress=config.progress, progress_norm=0.0, projection=0.0)
    ours = replace(base, loss=loss)
    field_substitute = {"projection": PROJECTION, "projection_decay": PROJECTION_DECAY}
    without_field = replace(base, loss=replace(loss, field_gain=0.0, **field_substitute))
    ppo = ppo_like(ours, config.ppo_iterations or ours.optimizer.iterations)
    known = [
        training.Setting("ppo", "PPO", ppo),
        training.Setting("ours", "ours", ours),
        training.Setting("projection", "ours without the field, with L_proj", without_field),
    ]
    selected = options.select({scheme.key: scheme for scheme in known}, config.only, "scheme")
    if ppo.episode.batch % ppo.minibatches and "ppo" in selected:
        raise ValueError(
            f"--worlds is {ppo.episode.batch}, allowed with PPO are multiples of its "
            f"{ppo.minibatches} minibatches"
        )
    return list(selected.values())


def first_times(row: Summary, gates: float) -> list[tuple[float, float]]:
    """Return when the trainings first pass `gates` gates in the mean.

    Returns:
        (environment steps, time [s]) of each training that reaches this number; the others have no
        entry.
    """
    first_points = [
        next((p for p in points if p["gates"] >= gates), None) for points in row.trainings
    ]
    return [(point["steps"], point["time"]) for point in first_points if point is not None]


def _end_grid(rows: Sequence[Summary]) -> Grid:
    """Return a table of the measures at the end of the trainings, a row per scheme."""
    headers = ["scheme", *(METRICS[name].title for name in MEASURED), "diverged"]
    lines = [
        [row.label, *(row.text(name) for name in MEASURED), f"{row.diverged} of {row.seeds}"]
        for row in rows
    ]
    return table(headers, lines, "At the end of each budget: mean over seeds [least, most]")


def _time_grid(rows: Sequence[Summary], compile_s: Mapping[str, float]) -> Grid:
    """Return a table of the steps and times until `GATE_COUNTS` are reached, a row per scheme.

    Each entry is the median over the training seeds that reach the number.
    """
    headers = ["scheme", *(f"{gates} gates" if gates > 1 else "1 gate" for gates in GATE_COUNTS),
               "whole budget", "compilation"]  # fmt: skip
    lines = []
    for row in rows:
        line = [row.label]
        for gates in GATE_COUNTS:
            reached = np.array(first_times(row, gates)).reshape(-1, 2)
            steps, time = np.median(reached, axis=0) if len(reached) else (0, 0)
            text = f"{steps:,.0f} steps, {duration(time)} ({len(reached)} of {row.seeds})"
            line.append(text if len(reached) else "not reached")
        end = row.at[-1]
        budget = f"{end['steps'].mean:,.0f} steps, {duration(end['time'].mean)}"
        lines.append([*line, budget, duration(compile_s[row.key])])
    return table(headers, lines, "Training until a mean number of gates per trial: steps and time")
