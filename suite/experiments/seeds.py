"""The same recipe from several training seeds: each one's table, the spread, the median."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from eval.judging.tables import Tally
from eval.quadrotor.vehicle_file import load_vehicle
from policies.shipped import locate
from suite.common.console import Console, duration
from suite.common.report import Picture
from suite.experiments.pages.document import Made, Place
from suite.experiments.pages.tables import every_cell
from suite.experiments.study import judging, options, training
from suite.judging.content import policy_digest
from suite.judging.flying import labels
from tracks.common.grid import Grid, table
from tracks.input.ranges import Iterations, Seed, Trials

LEVELS = (0, 3, 6, 9)
"""The levels of the paper's table."""


@dataclass(frozen=True)
class Config:
    """Judge the policies of several training seeds on the same trials, and name the median.

    Without --policies they are trained, and found again by the hash of their configuration.
    """

    policies: tuple[str, ...] = ()
    """Policies of one recipe, one a training seed: run folders of `suite train`, checkpoints'
    folders, or names."""
    recipe: str = "race"
    """Without --policies: the recipe."""
    set: tuple[str, ...] = ()
    """Without --policies: change settings of the recipe by name."""
    iterations: Iterations | None = None
    """Without --policies: gradient steps, instead of the recipe's."""
    init_from: str | None = None
    """Without --policies: all are trained on from this shipped name or checkpoint's folder."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2, 3, 4)
    """Without --policies: the seeds that are trained."""
    trials: Trials = 100
    """Trials of every policy on every track at levels 0, 3, 6 and 9."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


class Repeats(NamedTuple):
    """How the training seeds of one recipe differ."""

    mean_success: dict[str, float]
    """Of each policy: mean success over its cells."""
    median: str
    """The policy whose mean success is the median; of an even number, the lower middle one."""
    mean: float
    """Over policies."""
    standard_deviation: float
    """Over policies; NaN of one."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is trained and flown first."""
    from suite.experiments.pages.charts import cells_chart

    vehicle, policies = load_vehicle(config.vehicle), _policies(config, place, console)
    trials = judging.trials_of(config, LEVELS)
    orders = {n: judging.Order(judging.Flier(p, vehicle), trials) for n, p in policies.items()}
    what = f"judging {len(policies)} training seeds"
    _, cells = judging.judged_cells(orders, place.cache, console, what, place.workers)
    found = repeats(cells)
    everything = [cell for some in cells.values() for cell in some]
    facts = {
        "recipe": "given policies" if config.policies else options.recipe_words(config),
        **{
            name: f"SHA-256 {policy_digest(path)[:16]}, {_trained(locate(path))}"
            for name, path in policies.items()
        },
        "vehicle": config.vehicle,
        "judged seeds": f"{options.judged_seeds(config)}, the same for all",
    }
    title = f"Success [%]; the median is {found.median}"
    parts = {
        "Success and speed by training seed": [
            _grid(title, cells, lambda c: c.success.value, 100, 0),
            _grid("v_max, median over trials [m/s]", cells, lambda c: c.v_max.value, 1, 2),
            Picture(cells_chart(cells), "Success of each training seed by cell"),
        ],
        "Every cell with its intervals": every_cell(everything),
    }
    return Made(facts, parts, {"spread": found, "cells": everything})


def _trained(policy: Path) -> str:
    """Return at which commit a policy was trained, and how long where its run is there."""
    seconds = training.seconds_of(policy)
    took = f" in {duration(seconds)}" if seconds else ""
    return f"trained at commit {training.commit_of(policy)}{took}"


def _policies(config: Config, place: Place, console: Console) -> dict[str, str]:
    """Return the policies by what the tables call them; missing ones are trained."""
    if not config.policies:
        row = training.Row("recipe", "the recipe", options.asked_recipe(config))
        study = training.Study(
            [row], config.training_seeds, may_diverge=False, start=config.init_from
        )
        runs = training.trained(study, place.cache, console, place.workers)
        return {f"seed {run.seed}": run.policy for run in runs}
    inside = [Path(path, "policy") for path in config.policies]
    chosen = [
        str(within) if within.is_dir() else path
        for path, within in zip(config.policies, inside, strict=True)
    ]
    for path in chosen:
        judging.name_of(path)
    names = labels(config.policies, [Path(path).name for path in config.policies], "--policies")
    return dict(zip(names, chosen, strict=True))


def repeats(cells: Mapping[str, Sequence[Tally]]) -> Repeats:
    """Return how the policies differ in mean success over their cells."""
    means = {name: float(np.mean([c.success.value for c in some])) for name, some in cells.items()}
    ordered, values = sorted(means, key=lambda name: means[name]), list(means.values())
    return Repeats(means, ordered[(len(ordered) - 1) // 2], float(np.mean(values)), _std(values))


def _std(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def _grid(
    title: str,
    cells: Mapping[str, Sequence[Tally]],
    pick: Callable[[Tally], float],
    scale: float,
    digits: int,
) -> Grid:
    """Return one number of every policy and cell, with its spread over policies below."""
    first = next(iter(cells.values()))
    headers = ["policy", "mean", *(f"{cell.track} {cell.difficulty}" for cell in first)]
    numbers = scale * np.array([[pick(cell) for cell in some] for some in cells.values()])
    numbers = np.column_stack([numbers.mean(axis=1), numbers])
    columns = numbers.T.tolist()
    over = {"mean": lambda c: float(np.mean(c)), "standard deviation": _std, "least": min,
            "most": max}  # fmt: skip
    lines = [*zip(cells, numbers.tolist(), strict=True)]
    if len(cells) > 1:
        lines += [(name, [of(column) for column in columns]) for name, of in over.items()]
    finer = ("mean", "standard deviation")
    texts = [
        (name, *(f"{v:.{digits + (k == 0 or name in finer)}f}" for k, v in enumerate(values)))
        for name, values in lines
    ]
    return table(headers, texts, title)
