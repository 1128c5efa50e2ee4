"""What randomised dynamics in training buy, spread by spread: disturbed with each and without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture, Report, Section
from suite.experiments.pages import randomisation as pages
from suite.experiments.pages.document import Place
from suite.experiments.pages.randomisation import FIXED, RANDOMISED, UNDISTURBED, WITHOUT
from suite.experiments.study import disturbed, judging, options, training
from suite.experiments.study.conditions import Condition
from suite.train.dynamics import spreads
from tracks.common.names import unknown_name
from tracks.input.ranges import Iterations, Seed, Trials


@dataclass(frozen=True)
class Config:
    """Train one recipe with all its spreads, without each, and without any, and disturb them.

    Every training seed flies its share of the trials, the same share in all settings.
    """

    preset: str = "swift-quad"
    """The recipe."""
    from_: Annotated[str | None, tyro.conf.arg(name="from")] = "swift"
    """All are trained on from this shipped name or checkpoint's folder; None: from nothing."""
    set: tuple[str, ...] = ()
    """Change settings of the recipe by name."""
    iterations: Iterations | None = 200
    """Gradient steps; None: the preset's."""
    without: tuple[str, ...] = ()
    """Only these spreads are left out one by one, by name; by default each that the recipe has."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds that every setting is trained from."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 32
    """Trials of each setting on every track at every level under every condition."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = tuple(pages.AGAINST.values())
    """Only these effects, at their usual size, and sweeps, by name."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what is missing is trained and flown first."""
    from suite.experiments.pages.charts import sweeps_chart

    seeds, recipe = config.training_seeds, options.asked_recipe(config)
    rows, vehicle = settings(config), load_vehicle(config.vehicle)
    alone, sweeps = disturbed.asked_conditions(vehicle, config.only)
    trials = judging.trials_of(config)
    if len(trials) < len(seeds):
        raise ValueError(
            f"--trials is {config.trials}, {len(trials)} on all tracks and levels, and they are "
            f"shared among {len(seeds)} --training-seeds; give more trials or fewer seeds"
        )
    runs = training.trained(
        training.Study(rows, seeds, may_diverge=False, start=config.from_),
        place.cache, console, place.workers,
    )  # fmt: skip
    shares = {seed: trials[part :: len(seeds)] for part, seed in enumerate(seeds)}
    fliers = {
        row.key: [(run.policy, shares[run.seed]) for run in runs if run.row == row.key]
        for row in rows
    }
    base = Condition(UNDISTURBED, 0.0, "", vehicle)
    (still, *effects), grown = disturbed.flown_under(
        [base, *alone], sweeps, fliers, place.cache, console, place.workers
    )
    tested = [*effects, *(point for points in grown.values() for point in points[1:])]
    worth = pages.worth_of(still, tested, [len(share) for share in shares.values()])
    sections = [Section("Spread by spread", [pages.worth_grid(worth), *pages.MEANING])]
    pictured = [Picture(sweeps_chart(pages.two_of(grown)), pages.CAPTION)] if grown else []
    sections += [
        Section("By disturbance", [pages.success_grid([still, *tested]), *pictured]),
        Section("Every training", [pages.seeds_grid(shares, still, tested), pages.BY_SEED]),
    ]
    report = Report(
        title="What randomised dynamics in training buy",
        lead=pages.lead(worth),
        facts={
            "recipe": f"{options.recipe_words(config)}, {recipe.optimizer.iterations} gradient "
            "steps",
            RANDOMISED: spreads.words(recipe),
            FIXED: "none of that",
            "training seeds": " ".join(map(str, seeds)),
            "trained at commit": training.commits(runs),
            "trials": f"three tracks, level {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} trials a condition, shared out to the "
            "training seeds",
            "vehicle": config.vehicle,
        },
        sections=sections,
    )
    return report, {
        "worth": {
            name: {what: {"rates": w.rates, **w.gap._asdict()} for what, w in mine.items()}
            for name, mine in worth.items()
        },
        "conditions": [disturbed.tested_numbers(entry, still) for entry in [still, *tested]],
    }


def settings(config: Config) -> Sequence[training.Row]:
    """Return what is trained: with nothing varied, without each spread, and the recipe.

    Raises:
        ValueError: for a spread that the recipe has not.
    """
    recipe = options.asked_recipe(config)
    known = spreads.spreads(recipe)
    for name in config.without:
        if name not in known:
            raise unknown_name("spread", name, known)
    fixed = spreads.fixed(recipe)
    return [
        training.Row(FIXED, "nothing varied", fixed),
        *(
            training.Row(f"{WITHOUT}{name}", f"all but {name}", known[name])
            for name in dict.fromkeys(config.without or known)
            if known[name] != fixed
        ),
        training.Row(RANDOMISED, "the recipe", recipe),
    ]
