"""What randomised dynamics in training gain: every spread left out in turn, under disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made, Place
from suite.experiments.pages.tables import gap_cell
from suite.experiments.study import disturbed, judging, options, training
from suite.experiments.study.conditions import Condition
from suite.experiments.study.disturbed import Tested
from suite.experiments.study.intervals import Gap, nested
from suite.train.dynamics import spreads
from tracks.common.grid import Cell, Grid, table
from tracks.common.names import unknown_name
from tracks.input.ranges import Iterations, Seed, Trials

FIXED, RANDOMISED, WITHOUT = "fixed", "randomised", "without "
"""Settings; the last is followed by a spread's name."""
UNDISTURBED, ALL, OWN = "undisturbed", "all disturbances", "its own"
"""What settings are compared under."""
AGAINST = {
    "mass": "mass",
    "thrust": "thrust_scale",
    "rotor lag": "motor lag",
    "drag": "drag",
    "delay": "latency",
    "rate gain": "rate_gain",
    "centre of mass": "com_offset",
    "torque trim": "torque_trim",
    "wind": "wind",
    "image": "depth noise",
}
"""The disturbance that each spread is there for."""


@dataclass(frozen=True)
class Config:
    """Train one recipe with all its spreads, without each, and without any, and disturb them.

    Every training seed flies its share of the trials, the same share in all settings.
    """

    recipe: str = "race"
    """The recipe."""
    init_from: str | None = "race-paper"
    """All are trained on from this shipped name or checkpoint's folder; None: from nothing."""
    set: tuple[str, ...] = ()
    """Change settings of the recipe by name."""
    iterations: Iterations | None = 200
    """Gradient steps; None: the recipe's."""
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
    only: tuple[str, ...] = tuple(AGAINST.values())
    """Only these effects, at their usual size, and sweeps, by name."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is trained and flown first."""
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
        training.Study(rows, seeds, may_diverge=False, start=config.init_from),
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
    worth = worth_of(still, tested, [len(share) for share in shares.values()])
    facts = {
        "recipe": f"{options.recipe_words(config)}, {recipe.optimizer.iterations} gradient steps",
        RANDOMISED: ", ".join(spreads.spreads(recipe)),
        FIXED: "none of that",
        "training seeds": " ".join(map(str, seeds)),
        "trained at commit": training.commits(runs),
        "trials": f"three tracks, level {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} trials a condition, shared out to the "
        "training seeds",
        "vehicle": config.vehicle,
    }
    caption = "Success with every spread and with none against the size of each disturbance"
    pictured = [Picture(sweeps_chart(grown, (FIXED, RANDOMISED)), caption)] if grown else []
    parts = {
        "Spread by spread": [worth_grid(worth)],
        "By disturbance": [success_grid([still, *tested]), *pictured],
    }
    numbers = {
        "worth": {
            name: {what: {"rates": w.rates, **w.gap._asdict()} for what, w in mine.items()}
            for name, mine in worth.items()
        },
        "conditions": [disturbed.tested_numbers(entry, still) for entry in [still, *tested]],
    }
    return Made(facts, parts, numbers)


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


class Worth(NamedTuple):
    """The recipe against another setting under some conditions, all of them together."""

    rates: tuple[Interval, Interval]
    """Success of the other and of the recipe, with Wilson intervals."""
    gap: Gap
    """In success, the recipe - the other."""


def worth_of(
    still: Tested, tested: Sequence[Tested], sizes: Sequence[int]
) -> dict[str, dict[str, Worth]]:
    """Return what each setting but the recipe lacks, by its name and by what it is disturbed by.

    Args:
        still: undisturbed, with every setting's trials, one training seed's after the other.
        tested: disturbed.
        sizes: trials of each training seed, in their order.
    """
    found = {}
    for name in still.results:
        if name == RANDOMISED:
            continue
        own = AGAINST.get(name.removeprefix(WITHOUT))
        under = {
            UNDISTURBED: [still],
            OWN: [entry for entry in tested if entry.condition.name == own],
            ALL: list(tested),
        }
        found[name] = {
            what: compare(name, entries, sizes) for what, entries in under.items() if entries
        }
    return found


def compare(name: str, entries: Sequence[Tested], sizes: Sequence[int]) -> Worth:
    """Return the recipe against the setting `name` over all of `entries` together."""
    other, recipe = (np.array([e.won(each) for e in entries]) for each in (name, RANDOMISED))
    # A trial counts once, with its mean over conditions, under which all fly the same trials.
    other, recipe = other.mean(axis=0), recipe.mean(axis=0)
    first, second = (wilson(float(won.sum()), won.size) for won in (other, recipe))
    apart = recipe - other
    return Worth((first, second), nested(np.split(apart, np.cumsum(sizes)[:-1])))


def worth_grid(worth: Mapping[str, Mapping[str, Worth]]) -> Grid:
    """Return what each spread is worth, and last all of them."""
    lines = []
    for name in sorted(worth, key=lambda setting: setting == FIXED):
        mine, spread = worth[name], name.removeprefix(WITHOUT)
        line: list[str | Cell] = ["all of them" if name == FIXED else spread]
        line.append(AGAINST.get(spread, "-"))
        for what in (UNDISTURBED, OWN, ALL):
            line.append(gap_cell(mine[what].gap) if what in mine else "-")
        verdicts = [mine[what].gap.verdict if what in mine else "unclear" for what in (OWN, ALL)]
        line += ["" if verdict == "unclear" else verdict for verdict in verdicts]
        lines.append(line)
    headers = ["spread", "its own disturbance", UNDISTURBED, OWN, ALL, f"{OWN}?", "all?"]
    return table(headers, lines)


def success_grid(tested: Sequence[Tested]) -> Grid:
    """Return the success of every setting under every condition."""
    names = list(tested[0].results)
    lines = [
        [
            f"{entry.condition.name} {entry.condition.words}".strip(),
            *(f"{100 * entry.success(name).value:.0f}" for name in names),
        ]
        for entry in tested
    ]
    return table(["success [%]", *names], lines)
