"""The same recipe from several training seeds: each one's table, the spread, the median."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from suite.common.choices import at_least
from suite.common.console import Console

if TYPE_CHECKING:
    from suite.experiments.document import Place

LEVELS = (0, 3, 6, 9)
"""The levels of the paper's table."""


@dataclass(frozen=True)
class Config:
    """Judge the policies of several training seeds on the same trials, and say which is the median.

    Without --policies they are trained, and found again by the hash of their configuration.
    """

    policies: tuple[str, ...] = ()
    """Policies of one recipe, one a training seed: run folders of `suite train`, checkpoints'
    folders, or names."""
    preset: str = "racer"
    """Without --policies: the recipe."""
    set: tuple[str, ...] = ()
    """Without --policies: change settings of the recipe by name."""
    iterations: int | None = None
    """Without --policies: gradient steps, instead of the preset's."""
    training_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Without --policies: the seeds that are trained."""
    trials: int = 100
    """Trials of every policy on every track at levels 0, 3, 6 and 9."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    jobs: int = 1
    """Without --policies: trainings at once, each in a process with its own share of the cores."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train and fly what is missing and write seeds.md.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
        WorkFailed: where a training diverges.
    """
    from eval.judging.tables import summarise
    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.common.work import check_jobs
    from suite.experiments.document import write_document
    from suite.experiments.flights import Flier, Order, flown
    from suite.experiments.seed_tables import seed_report, spread
    from suite.judging.flying import trial_list
    from tracks.families import JUDGED

    at_least("--trials", config.trials, 1)
    at_least("--seed", config.seed, 0)
    check_jobs(config.jobs)
    vehicle = load_vehicle(config.vehicle)
    policies = _policies(config, place, console)
    trials = trial_list(JUDGED, LEVELS, config.trials, config.seed)
    orders = [Order(Flier(policy, vehicle), trials) for policy in policies.values()]
    results = flown(orders, place.cache, console, f"judging {len(policies)} training seeds")
    cells = {
        name: summarise([row._replace(policy=name) for row in rows])["cells"]
        for name, rows in zip(policies, results, strict=True)
    }
    found = spread(cells)
    report = seed_report(config, policies, cells, found)
    numbers = {"config": config, "spread": found, "cells": [c for s in cells.values() for c in s]}
    return write_document(place, "seeds", report, numbers, config.seed, console)


def _policies(config: Config, place: Place, console: Console) -> dict[str, str]:
    """Return the policies by what the tables call them; missing ones are trained."""
    from pathlib import Path

    from policies.policy import load_policy
    from suite.judging.flying import labels

    if config.policies:
        inside = [Path(path, "policy") for path in config.policies]
        chosen = [
            str(within) if within.is_dir() else path
            for path, within in zip(config.policies, inside, strict=True)
        ]
        for path in chosen:
            load_policy(path)
        names = labels(config.policies, [Path(path).name for path in config.policies])
        return dict(zip(names, chosen, strict=True))
    return _trained(config, place, console)


def _trained(config: Config, place: Place, console: Console) -> dict[str, str]:
    import functools
    from dataclasses import replace

    from suite.common.work import all_done
    from suite.experiments.recipes import asked_recipe, check_seeds
    from suite.experiments.trainings import trained_policy

    check_seeds(config.training_seeds)
    recipe = asked_recipe(config.preset, config.set, config.iterations)
    runs = [replace(recipe, seed=seed) for seed in config.training_seeds]
    do = functools.partial(trained_policy, cache=place.cache)
    policies = all_done(do, runs, config.jobs, console, "training")
    return {
        f"seed {seed}": policy for seed, policy in zip(config.training_seeds, policies, strict=True)
    }
