"""Success under every effect of the catalogue and under growing disturbances, policies in pairs."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made, Place
from suite.experiments.pages.tables import condition_grid
from suite.experiments.study import disturbed, judging, options
from suite.experiments.study.conditions import Condition
from suite.judging.flying import default_policy
from tracks.common.grid import Grid
from tracks.input.ranges import Seed, Trials

UNDISTURBED = "undisturbed"


@dataclass(frozen=True)
class Config:
    """Judge policies under every physical effect and under growing disturbances.

    All fly the same trials under every condition. A policy trained with another randomisation
    next to the first shows what that randomisation gains.
    """

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it the shipped policy flies."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 32
    """Trials of every policy on every track at every level under every condition."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Only these effects and sweeps, by name; by default all."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    from suite.experiments.pages.charts import effects_chart, sweeps_chart

    vehicle = load_vehicle(config.vehicle)
    policies = judging.named_policies(config.policy or (default_policy(),))
    alone, sweeps = disturbed.asked_conditions(vehicle, config.only)
    base, trials = Condition(UNDISTURBED, 0.0, "", vehicle), judging.trials_of(config)
    fliers = {name: [(policy, trials)] for name, policy in policies.items()}
    effects, grown = disturbed.flown_under(
        [base, *alone], sweeps, fliers, place.cache, console, place.workers
    )
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, level {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} trials a condition, the same in all",
        "vehicle": config.vehicle,
    }
    parts: dict[str, list[Grid | Picture]] = {}
    if alone:
        parts["Every effect at its usual size"] = [
            Picture(effects_chart(effects), "Success under each effect; dashed: undisturbed"),
            condition_grid(effects, effects[0], ("effect", "total")),
        ]
    if grown:
        parts["Growing disturbances"] = [
            Picture(sweeps_chart(grown), "Success against the size of each disturbance"),
            *(condition_grid(points, effects[0], (s.axis,), s.name) for s, points in grown.items()),
        ]
    tested = [*effects, *(point for points in grown.values() for point in points)]
    numbers = [disturbed.tested_numbers(entry, effects[0]) for entry in tested]
    return Made(facts, parts, {"conditions": numbers})
