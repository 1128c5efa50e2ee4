"""Success under every effect of the catalogue and under growing disturbances, policies in pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from suite.common.choices import at_least, parse_levels
from suite.common.console import Console

if TYPE_CHECKING:
    from suite.experiments.document import Place

UNDISTURBED = "undisturbed"


@dataclass(frozen=True)
class Config:
    """Judge policies under every physical effect and under growing disturbances.

    All fly the same trials under every condition. A policy trained with another randomisation
    beside the first shows what that randomisation buys.
    """

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it the shipped policy flies."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: int = 32
    """Trials of every policy on every track at every level under every condition."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Only these effects and sweeps, by name; by default all."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Fly what is missing and write robustness.md.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from policies.policy import load_policy
    from suite.experiments.conditions import Condition, effect_conditions, sweep_conditions, sweeps
    from suite.experiments.document import write_document
    from suite.experiments.flights import Flier, Order, flown
    from suite.experiments.robust_tables import Tested, robust_report
    from suite.judging.flying import default_policy, labels, trial_list
    from tracks.common.names import unknown_name
    from tracks.families import JUDGED

    at_least("--trials", config.trials, 1)
    at_least("--seed", config.seed, 0)
    vehicle = load_vehicle(config.vehicle)
    asked = config.policy or (default_policy(),)
    names = labels(asked, [load_policy(policy).name for policy in asked])
    all_sweeps = sweeps(vehicle)
    effects = effect_conditions(vehicle)
    known = dict.fromkeys([*(s.name for s in all_sweeps), *(c.name for c in effects)])
    for name in config.only:
        if name not in known:
            raise unknown_name("effect or sweep", name, known)
    chosen = config.only or tuple(known)
    base = Condition(UNDISTURBED, 0.0, "", vehicle)
    effects = [base, *(c for c in effects if c.name in chosen)]
    grown = {s: sweep_conditions(vehicle, s) for s in all_sweeps if s.name in chosen}
    conditions = [*effects, *(point for points in grown.values() for point in points)]
    trials = trial_list(JUDGED, parse_levels(config.difficulty), config.trials, config.seed)
    orders = [
        Order(Flier(policy, condition.vehicle, condition.noise), trials)
        for policy in asked
        for condition in conditions
    ]
    rows = iter(flown(orders, place.cache, console, "flying under disturbances"))
    flown_by = {name: [next(rows) for _ in conditions] for name in names}
    tested = [
        Tested(condition, {name: flown_by[name][number] for name in names})
        for number, condition in enumerate(conditions)
    ]
    of_effects, rest = tested[: len(effects)], iter(tested[len(effects) :])
    of_sweeps = {sweep: [next(rest) for _ in points] for sweep, points in grown.items()}
    report, numbers = robust_report(config, dict(zip(names, asked, strict=True)), of_effects,
                                    of_sweeps)  # fmt: skip
    return write_document(place, "robustness", report, numbers, config.seed, console)
