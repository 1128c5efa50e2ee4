"""What randomised dynamics in training buy: the same recipe with them and without, disturbed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from suite.common.choices import at_least, parse_levels
from suite.common.console import Console

if TYPE_CHECKING:
    from eval.worlds.trial import TrialSpec
    from suite.experiments.conditions import Condition
    from suite.experiments.document import Place
    from suite.experiments.robust_tables import Tested
    from suite.train.config import PointMassConfig, TrainConfig

FIXED, RANDOMISED = "fixed", "randomised"


@dataclass(frozen=True)
class Config:
    """Train one recipe with randomised dynamics and with fixed ones, and disturb what comes out.

    Every training seed flies its share of the trials, the same share in both settings.
    """

    preset: str = "small"
    """The recipe."""
    set: tuple[str, ...] = ()
    """Change settings of the recipe by name."""
    iterations: int | None = None
    """Gradient steps, instead of the preset's."""
    training_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds that both settings are trained from."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: int = 32
    """Trials of each setting on every track at every level under every condition."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Only these sweeps, by name; by default all."""
    jobs: int = 1
    """Trainings at once, each in a process with its own share of the cores."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train and fly what is missing and write randomisation.md.

    Raises:
        ValueError: for anything that cannot be used, before the first training.
        WorkFailed: where a training diverges.
    """
    import functools

    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.common.work import all_done, check_jobs
    from suite.experiments.conditions import sweep_conditions, sweeps
    from suite.experiments.document import write_document
    from suite.experiments.randomisation_tables import randomisation_report
    from suite.experiments.recipes import asked_recipe, check_seeds
    from suite.experiments.trainings import trained_policy
    from suite.judging.flying import trial_list
    from tracks.common.names import unknown_name
    from tracks.families import JUDGED

    seeds = config.training_seeds
    check_seeds(seeds)
    at_least("--trials", config.trials, 1)
    at_least("--seed", config.seed, 0)
    check_jobs(config.jobs)
    vehicle = load_vehicle(config.vehicle)
    known = {sweep.name: sweep for sweep in sweeps(vehicle)}
    for name in config.only:
        if name not in known:
            raise unknown_name("sweep", name, known)
    grown = {s: sweep_conditions(vehicle, s) for s in known.values()
             if not config.only or s.name in config.only}  # fmt: skip
    trials = trial_list(JUDGED, parse_levels(config.difficulty), config.trials, config.seed)
    recipe = asked_recipe(config.preset, config.set, config.iterations)
    runs = [replace(r, seed=seed) for r in (fixed(recipe), recipe) for seed in seeds]
    do = functools.partial(trained_policy, cache=place.cache)
    found = all_done(do, runs, config.jobs, console, "training")
    policies = {FIXED: found[: len(seeds)], RANDOMISED: found[len(seeds) :]}
    shares = [trials[number :: len(seeds)] for number in range(len(seeds))]
    tested = _flown(policies, shares, [c for cs in grown.values() for c in cs], place, console)
    rest = iter(tested)
    of_sweeps = {sweep: [next(rest) for _ in points] for sweep, points in grown.items()}
    report, numbers = randomisation_report(config, recipe, policies, shares, of_sweeps)
    return write_document(place, "randomisation", report, numbers, config.seed, console)


def fixed(recipe: TrainConfig) -> TrainConfig:
    """Return `recipe` with every world's dynamics in the middle of what they are drawn from."""

    def middle(bounds: tuple[float, float]) -> tuple[float, float]:
        centre = sum(bounds) / 2
        return centre, centre

    physics: PointMassConfig = recipe.physics
    return replace(
        recipe,
        physics=replace(
            physics,
            lag_std=0.0,
            drag=middle(physics.drag),
            drag_up=middle(physics.drag_up),
            wind_std=(0.0, 0.0, 0.0),
            time_step_std=0.0,
            action_delay=middle(physics.action_delay),
            depth_noise=0.0,
            fov_scale=(1.0, 1.0),
        ),
    )


def _flown(
    policies: dict[str, list[str]],
    shares: list[list[TrialSpec]],
    conditions: list[Condition],
    place: Place,
    console: Console,
) -> list[Tested]:
    """Return every condition with both settings' trials, each seed's share after the other's."""
    from suite.experiments.flights import Flier, Order, flown
    from suite.experiments.robust_tables import Tested

    orders = [
        Order(Flier(policy, condition.vehicle, condition.noise), share)
        for condition in conditions
        for paths in policies.values()
        for policy, share in zip(paths, shares, strict=True)
    ]
    rows = iter(flown(orders, place.cache, console, "flying under disturbances"))
    return [
        Tested(
            condition,
            {name: [row for _ in paths for row in next(rows)] for name, paths in policies.items()},
        )
        for condition in conditions
    ]
