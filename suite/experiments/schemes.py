"""The paper's comparison of training schemes: PPO, ours, and ours without the vector field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from suite.common.console import Console, duration
from suite.common.curve import METRICS
from suite.common.report import Picture
from suite.experiments.pages.document import Made
from suite.experiments.study import options, training
from suite.experiments.study.cache import Place
from suite.experiments.study.summary import Summary, summaries
from suite.train.overrides import check_owned, in_every_phase
from suite.train.ppo.config import ppo_like
from tracks.common.grid import Grid, table
from tracks.input.ranges import Iterations, Range, Trials

PROJECTION, PROJECTION_DECAY = 3.0, 0.5
"""lambda_proj and beta_3 of the paper's scheme without the field."""
FIGURE = ("reward", "v_max", "collision_free", "gates")
"""What the paper's figure shows."""
MEASURED = ("reward", "success_cross", "collision_free", "v_max", "gates")
"""Numbers of `validation.measured` in the table and in schemes.json."""
WANTED = (1, 2, 3)
"""Mean gates a trial, of four: the table has the time at which each is first reached."""


@dataclass(frozen=True)
class Config(options.FourGates):
    """Train by PPO, by our method, and by it without the field, and measure them as they learn.

    All three share policy, dynamics, worlds and the number of environment steps. A training is
    reused if its configuration and its measurements have the same hash.
    """

    progress: Annotated[float, Range(0.0, 1e6)] = 0.4
    """lambda_p of both differentiable schemes; the paper's."""
    ppo_iterations: Iterations | None = None
    """Rollouts of PPO; by default as many as the others' gradient steps."""
    trials: Trials = 100
    """Unseen worlds flown at every measurement."""
    measurements: Annotated[int, Range(1, 10_000)] = 20
    """About how many measurements a training has; their time does not count in the curves."""
    only: tuple[str, ...] = ()
    """Schemes: ppo, ours, projection; all by default."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; train what is missing."""
    from suite.experiments.pages.charts import curves_chart

    chosen = schemes(config)
    unseen = training.Unseen(config.measurements, config.trials, config.seed, config.seconds)
    study = training.Study(chosen, config.training_seeds, unseen, by_seed=True)
    runs = training.trained(study, place, console)
    rows, episode = summaries(chosen, runs), chosen[0].recipe.episode
    compiling = {
        row.key: float(np.mean([run.compile_s for run in runs if run.row == row.key]))
        for row in rows
    }
    facts = {
        "recipe": f"{' '.join([config.recipe, *config.set])} episode.gates={episode.gates} "
        f"lambda_p={config.progress:g}",
        "an iteration": f"{episode.batch} worlds x {episode.steps} steps",
        **training.facts(config, runs),
        "trainings at once": place.at_once,
    }
    whole = [row for row in rows if row.at]
    chart = [Picture(curves_chart(whole, FIGURE), "Learning curves over steps and over time")]
    parts = {
        "Learning curves": [*chart[: len(whole)], _end(whole), _reached(whole, compiling)],
    }
    numbers = [
        {
            "scheme": row.key,
            "words": row.words,
            "seeds": row.seeds,
            "diverged": row.diverged,
            "steps": [int(point["steps"].mean) for point in row.at],
            "time": [point["time"].mean for point in row.at],
            "curves": {n: [point[n] for point in row.at] for n in MEASURED if row.at},
            "reached": {gates: first_times(row, gates) for gates in WANTED},
            "compile_s": compiling[row.key],
        }
        for row in rows
    ]
    fields = ("seed", "points", "compile_s", "commit", "diverged")
    each = [{"scheme": run.row, **{f: getattr(run, f) for f in fields}} for run in runs]
    return Made(facts, parts, {"rows": numbers, "runs": each})


def schemes(config: Config) -> list[training.Row]:
    """Return the chosen schemes, in the paper's order.

    Raises:
        ValueError: for an unknown recipe, change or scheme, and for a number of worlds that is no
            multiple of PPO's minibatches.
    """
    compared = ("progress_norm", "projection", "projection_decay")
    owned = {f"loss.{name}": "it is compared" for name in compared}
    check_owned(config.set, {"loss.progress": "give --progress", **owned})
    base = options.four_gate_recipe(config)
    ours = in_every_phase(base, "loss", progress=config.progress, progress_norm=0.0, projection=0.0)
    scalar = {"projection": PROJECTION, "projection_decay": PROJECTION_DECAY}
    bare = in_every_phase(ours, "loss", field_gain=0.0, **scalar)
    ppo = ppo_like(ours, config.ppo_iterations or ours.optimizer.iterations)
    rows = [
        training.Row("ppo", "PPO", ppo),
        training.Row("ours", "ours", ours),
        training.Row("projection", "ours without the field, with L_proj", bare),
    ]
    rows = options.chosen({row.key: row for row in rows}, config.only, "scheme")
    if ppo.episode.batch % ppo.minibatches and "ppo" in rows:
        raise ValueError(
            f"--worlds is {ppo.episode.batch}, allowed with PPO are multiples of its "
            f"{ppo.minibatches} minibatches"
        )
    return list(rows.values())


def first_times(row: Summary, gates: float) -> list[tuple[float, float]]:
    """Return steps and seconds of each seed's first measurement with `gates`, where it has one."""
    firsts = [next((p for p in points if p["gates"] >= gates), None) for points in row.whole]
    return [(point["steps"], point["time"]) for point in firsts if point is not None]


def _end(rows: Sequence[Summary]) -> Grid:
    headers = ["scheme", *(METRICS[name].title for name in MEASURED), "diverged"]
    lines = [
        [row.words, *(row.text(name) for name in MEASURED), f"{row.diverged} of {row.seeds}"]
        for row in rows
    ]
    return table(headers, lines, "At the end of each budget: mean over seeds [least, most]")


def _reached(rows: Sequence[Summary], compiling: Mapping[str, float]) -> Grid:
    headers = ["scheme", *(f"{gates} gates" if gates > 1 else "1 gate" for gates in WANTED),
               "whole budget", "compilation"]  # fmt: skip
    lines = []
    for row in rows:
        line = [row.words]
        for gates in WANTED:
            found = np.array(first_times(row, gates)).reshape(-1, 2)
            steps, time = np.median(found, axis=0) if len(found) else (0, 0)
            times = f"{steps:,.0f} steps, {duration(time)} ({len(found)} of {row.seeds})"
            line.append(times if len(found) else "not reached")
        end = row.at[-1]
        budget = f"{end['steps'].mean:,.0f} steps, {duration(end['time'].mean)}"
        lines.append([*line, budget, duration(compiling[row.key])])
    return table(headers, lines, "Steps and time of training to so many gates a trial")
