"""What could be better than the paper's recipe: one change at a time, judged in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.choices import at_least, parse_levels
from suite.common.console import Console
from suite.experiments.schemes import PROJECTION, PROJECTION_DECAY

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from suite.experiments.document import Place
    from suite.train.config import TrainConfig

RECIPE = "recipe"
"""The key of the row that all others are compared with."""
ROUND_CORNERS = 8
"""Of the gates in the comparison of fields."""


@dataclass(frozen=True)
class Config:
    """Train a recipe and variants of it with one change each, and judge them in pairs.

    Round gates, which no judged track has, are flown in the training's own dynamics.
    """

    preset: str = "small"
    """The recipe."""
    set: tuple[str, ...] = ("episode.image_stride=3",)
    """Change settings of the recipe, and so of all rows, by name."""
    iterations: int | None = None
    """Gradient steps, instead of the preset's."""
    training_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds that every row is trained from; less than three tell nothing."""
    difficulty: str = "0,3,6"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: int = 10
    """Trials of every training on every track at every level, the same for all."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    round_trials: int = 300
    """Unseen worlds with round gates that each of their trainings flies."""
    round_seed: int = 1000
    """Of those worlds; none of the training seeds."""
    round_seconds: float = 20.0
    """Of a trial there, from standing start."""
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

    @property
    def round(self) -> bool:
        """Whether it is about round gates, which the judge does not have."""
        return self.recipe.episode.gate_corners != 4


class Made(NamedTuple):
    """A training of a row."""

    policy: str
    """Its checkpoint's folder."""
    seconds: float
    """Spent on gradient steps after those that compile [s]."""
    commit: str
    """That trained it."""
    diverged: str = ""
    """What was said where it diverged, and there is no policy to fly."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train and fly what is missing and write ideas.md.

    Raises:
        ValueError: for anything that cannot be used, before the first training.
        WorkFailed: where a training of the recipe itself diverges; any other leaves its row out.
    """
    import functools

    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.common.work import all_done, check_jobs
    from suite.experiments.document import write_document
    from suite.experiments.flights import Flier, Order, flown
    from suite.experiments.ideas_tables import ideas_report
    from suite.experiments.recipes import check_seeds, check_unseen
    from suite.judging.flying import trial_list
    from tracks.families import JUDGED

    seeds = config.training_seeds
    check_seeds(seeds)
    check_unseen("--round-seed", config.round_seed, seeds)
    check_jobs(config.jobs)
    at_least("--trials", config.trials, 1)
    at_least("--round-trials", config.round_trials, 1)
    at_least("--round-seconds", config.round_seconds, 0.5)
    at_least("--seed", config.seed, 0)
    vehicle, chosen = load_vehicle(config.vehicle), ideas(config)
    trials = trial_list(JUDGED, parse_levels(config.difficulty), config.trials, config.seed)
    runs = {(idea.key, s): replace(idea.recipe, seed=s) for s in seeds for idea in chosen}
    console.note(f"{len(runs)} trainings, less those that are there")
    do = functools.partial(_make, cache=place.cache)
    found = all_done(do, list(runs.values()), config.jobs, console, "training")
    made = dict(zip(runs, found, strict=True))
    chosen, failures = _whole_rows(chosen, made)
    wanted = [(idea.key, seed) for idea in chosen if not idea.round for seed in seeds]
    orders = [Order(Flier(made[which].policy, vehicle), trials) for which in wanted]
    flights = flown(orders, place.cache, console, f"judging {len(orders)} trainings")
    judged = dict(zip(wanted, flights, strict=True))
    measured = {
        idea.key: _flown_round(idea, [made[idea.key, seed].policy for seed in seeds], config)
        for idea in chosen
        if idea.round
    }
    report, numbers = ideas_report(config, chosen, made, judged, measured, failures)
    return write_document(place, "ideas", report, numbers, config.seed, console)


def ideas(config: Config) -> list[Idea]:
    """Return the recipe and the changes of it that are asked for; what changes nothing is left out.

    Raises:
        ValueError: for a preset, a change or a row that does not exist.
    """
    from suite.experiments.recipes import asked_recipe, asked_rows
    from suite.train.overrides import override

    base = asked_recipe(config.preset, config.set, config.iterations)
    if base.episode.gate_corners != 4:
        raise ValueError(
            f"--set episode.gate_corners={base.episode.gate_corners}: the judge's gates have 4; "
            "round gates have rows of their own"
        )
    longer = (
        f"episode.steps={2 * base.episode.steps}",
        f"episode.batch={max(1, base.episode.batch // 2)}",
    )
    fading = f"loss.gradient_decay={2 * base.loss.gradient_decay:g}"
    scalar = f"loss.projection={PROJECTION:g}", f"loss.projection_decay={PROJECTION_DECAY:g}"
    corners = f"episode.gate_corners={ROUND_CORNERS}"
    rows = {
        "second gate": ("the gate after the next is observed", ("spec.second_gate=True",)),
        "gate axis": ("the next gate's direction is observed", ("spec.gate_axis=True",)),
        "pass first": ("progress looks ahead at a gate", ("loss.pass_first=True",)),
        "finish": ("a world is done at its last gate", ("episode.finish=True",)),
        "heights": ("gates further up and down", ("episode.height_spread=2.0",)),
        "curriculum": ("difficulty grows over the first half", ("episode.easy_until=0.5",)),
        "one check": ("collision check at a step's end alone", ("loss.path_samples=1",)),
        "longer": ("twice the horizon, half the worlds", longer),
        "longer, truncated": ("and gradients that fade twice as fast", (*longer, fading)),
        "L_proj": ("the scalar substitute in the field's place", ("loss.field_gain=0", *scalar)),
        "field and L_proj": ("both", scalar),
        "round": ("round gates with their own field", (corners,)),
        "round, square field": (
            "round gates with the field of the square around them",
            (corners, "loss.field_square=True"),
        ),
    }
    made = [
        Idea(k, words, changes, override(base, changes)) for k, (words, changes) in rows.items()
    ]
    kept = asked_rows(made, config.only, "row")
    return [
        Idea(RECIPE, "nothing changed", (), base),
        *(idea for idea in kept if idea.recipe != base),
    ]


def _make(config: TrainConfig, console: Console, cache: Path) -> Made:
    from suite.experiments.trainings import commit_of, divergence, folder_of, warm_seconds

    diverged = divergence(config, cache, console)
    if diverged:
        console.note(diverged)
    folder = folder_of(config, cache)
    policy = folder / "policy"
    return Made(str(policy), warm_seconds(folder), commit_of(policy), diverged)


def _whole_rows(
    chosen: list[Idea], made: Mapping[tuple[str, int], Made]
) -> tuple[list[Idea], dict[str, str]]:
    """Return the rows whose trainings all came to an end, and what the others' seeds said.

    Raises:
        WorkFailed: where the recipe's own training diverged, with which all are compared.
    """
    from suite.common.errors import WorkFailed

    failures: dict[str, str] = {}
    for (key, seed), run in made.items():
        if run.diverged:
            before = f"{failures[key]}; " if key in failures else ""
            failures[key] = f"{before}seed {seed}: {run.diverged}"
    if RECIPE in failures:
        raise WorkFailed(f"the recipe itself, {failures[RECIPE]}")
    return [idea for idea in chosen if idea.key not in failures], failures


def _flown_round(idea: Idea, policies: list[str], config: Config) -> list[dict[str, float]]:
    """Return what each policy does in unseen worlds with round gates, the same for all."""
    from suite.experiments.validation import make_validation, stored_params

    measure = make_validation(
        idea.recipe, config.round_trials, config.round_seed, config.round_seconds
    )
    return [measure(stored_params(path)) for path in policies]
