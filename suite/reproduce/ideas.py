"""What could be better than the paper's recipe: one change at a time, judged in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.choices import at_least, parse_levels
from suite.console import Console

if TYPE_CHECKING:
    from suite.reproduce.document import Place
    from suite.train.config import TrainConfig

RECIPE = "recipe"
"""The key of the row that all others are compared with."""
ROUND_CORNERS = 8
"""Of the gates in the comparison of fields."""
PROJECTION = 3.0
"""lambda_proj in the field's place."""


@dataclass(frozen=True)
class Config:
    """Train a recipe and variants of it that differ in one thing each, and judge them in pairs.

    Round gates, which no judged track has, are flown in the training's own dynamics.
    """

    preset: str = "small"
    """The recipe."""
    set: tuple[str, ...] = ("episode.image_stride=3",)
    """Change settings of the recipe, and so of all rows, by name."""
    iterations: int | None = None
    """Gradient steps, instead of the preset's."""
    training_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds that every row is trained from."""
    difficulty: str = "0,3,6"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: int = 10
    """Trials of every training on every track at every level, the same for all."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    round_trials: int = 300
    """Unseen worlds with round gates that each of their trainings flies."""
    round_seed: int = 1000
    """Of those worlds."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Rows besides the recipe's; all if none is named."""
    jobs: int = 1
    """Trainings at once, each in a process with its own share of the cores."""


class Idea(NamedTuple):
    """A row: the recipe, or one change of it."""

    key: str
    """Its name."""
    words: str
    """What it is for."""
    changes: tuple[str, ...]
    """Of the recipe, as `suite train --set` takes them."""
    recipe: TrainConfig
    """With the changes made, and the seed left as it is."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train and fly what is missing and write ideas.md.

    Raises:
        ValueError: for anything that cannot be used, before the first training.
        WorkFailed: where a training diverges.
    """
    import functools

    from eval.vehicle_file import load_vehicle
    from suite.flying import trial_list
    from suite.reproduce.document import write_document
    from suite.reproduce.flights import Flier, Order, flown
    from suite.reproduce.ideas_tables import ideas_report
    from suite.reproduce.recipes import check_seeds
    from suite.reproduce.side_by_side import all_done, check_jobs
    from suite.reproduce.trainings import trained_policy
    from tracks.families import JUDGED

    seeds = config.training_seeds
    check_seeds(seeds)
    check_jobs(config.jobs)
    at_least("--trials", config.trials, 1)
    at_least("--round-trials", config.round_trials, 1)
    at_least("--seed", config.seed, 0)
    vehicle = load_vehicle(config.vehicle)
    chosen, rounds = judged_ideas(config), round_ideas(config)
    trials = trial_list(JUDGED, parse_levels(config.difficulty), config.trials, config.seed)
    runs = [replace(idea.recipe, seed=seed) for idea in (*chosen, *rounds) for seed in seeds]
    do = functools.partial(trained_policy, cache=place.cache)
    policies = all_done(do, runs, config.jobs, console, "training")
    orders = [Order(Flier(path, vehicle), trials) for path in policies[: len(chosen) * len(seeds)]]
    rows = iter(flown(orders, place.cache, console, f"judging {len(orders)} trainings"))
    judged = {idea.key: [next(rows) for _ in seeds] for idea in chosen}
    flights = iter(
        _flown_round(path, recipe, config)
        for path, recipe in zip(policies[len(orders) :], runs[len(orders) :], strict=True)
    )
    measured = {idea.key: [next(flights) for _ in seeds] for idea in rounds}
    report, numbers = ideas_report(config, chosen, judged, rounds, measured, policies)
    return write_document(place, "ideas", report, numbers, config.seed, console)


def judged_ideas(config: Config) -> list[Idea]:
    """Return the recipe and the changes of it that are asked for.

    Raises:
        ValueError: for a preset, a change or a row that does not exist.
    """
    from tracks.names import unknown_name

    base = _base(config)
    longer = (
        f"episode.steps={2 * base.episode.steps}",
        f"episode.batch={max(1, base.episode.batch // 2)}",
    )
    fading = f"loss.gradient_decay={2 * base.loss.gradient_decay:g}"
    rows = {
        "second gate": ("the gate after the next is observed", ("spec.second_gate=True",)),
        "gate axis": ("the next gate's direction is observed", ("spec.gate_axis=True",)),
        "pass first": ("progress looks ahead at a gate", ("loss.pass_first=True",)),
        "curriculum": ("difficulty grows over the first half", ("episode.easy_until=0.5",)),
        "one check": ("collision check at a step's end alone", ("loss.path_samples=1",)),
        "longer": ("twice the horizon, half the worlds", longer),
        "longer, truncated": ("and gradients that fade twice as fast", (*longer, fading)),
        "L_proj": (
            "the scalar substitute in the field's place",
            ("loss.field_gain=0", f"loss.projection={PROJECTION:g}"),
        ),
        "field and L_proj": ("both", (f"loss.projection={PROJECTION:g}",)),
    }
    for name in config.only:
        if name not in rows:
            raise unknown_name("row", name, rows)
    kept = [key for key in rows if not config.only or key in config.only]
    first = Idea(RECIPE, "nothing changed", (), base)
    return [first, *(_idea(base, key, *rows[key]) for key in kept)]


def round_ideas(config: Config) -> list[Idea]:
    """Return the two rows with round gates; none where only others are asked for."""
    if config.only:
        return []
    base, corners = _base(config), f"episode.gate_corners={ROUND_CORNERS}"
    return [
        _idea(base, "round", "the field of the round gate", (corners,)),
        _idea(
            base,
            "round, square field",
            "the field of the square around it",
            (corners, "loss.field_square=True"),
        ),
    ]


def _base(config: Config) -> TrainConfig:
    from suite.reproduce.recipes import asked_recipe

    return asked_recipe(config.preset, config.set, config.iterations)


def _idea(base: TrainConfig, key: str, words: str, changes: tuple[str, ...]) -> Idea:
    from suite.train.overrides import override

    return Idea(key, words, changes, override(base, changes))


def _flown_round(path: str, recipe: TrainConfig, config: Config) -> dict[str, float]:
    """Return what the policy at `path` does in unseen worlds with round gates."""
    from pathlib import Path

    import jax.numpy as jnp

    from policies.policy_file import load_policy_checkpoint
    from suite.reproduce.validation import make_validation

    stored = load_policy_checkpoint(Path(path)).params
    params = {name: jnp.asarray(array) for name, array in stored.items()}
    return make_validation(recipe, config.round_trials, config.round_seed)(params)
