"""What randomised dynamics in training buy: the same recipe with them and without, disturbed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture, Report, Section
from suite.experiments.pages.document import Place
from suite.experiments.pages.tables import condition_grid, points_cell
from suite.experiments.study import disturbed, judging, options, training
from suite.experiments.study.disturbed import Tested
from suite.experiments.study.intervals import Gap, nested
from suite.train.config import PointMassConfig, TrainConfig
from tracks.common.grid import Grid, table
from tracks.input.ranges import Iterations, Seed, Trials

FIXED, RANDOMISED = "fixed", "randomised"
ALL = "all disturbances"
MEANING = (
    "Success: over all trials under all sizes of the disturbance but the undisturbed one. "
    "Difference: randomised - fixed, in points, with a 95 % bootstrap interval that draws training "
    "seeds anew and the trials of each, a trial with all its conditions. A gain or a loss is where "
    "it leaves zero out and every seed agrees; with few seeds one of several rows may stand out by "
    "chance."
)


@dataclass(frozen=True)
class Config:
    """Train one recipe with randomised dynamics and with fixed ones, and disturb what comes out.

    Every training seed flies its share of the trials, the same share in both settings.
    """

    preset: str = "small"
    """The recipe."""
    set: tuple[str, ...] = ()
    """Change settings of the recipe by name."""
    iterations: Iterations | None = None
    """Gradient steps, instead of the preset's."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds that both settings are trained from."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 32
    """Trials of each setting on every track at every level under every condition."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Only these sweeps, by name; by default all."""


class Compared(NamedTuple):
    """Two settings of the recipe under some conditions, all of them together."""

    rates: dict[str, Interval]
    """Each setting's success, with Wilson intervals."""
    gap: Gap
    """In success, the second - the first."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what is missing is trained and flown first."""
    from suite.experiments.pages.charts import sweeps_chart

    seeds, recipe = config.training_seeds, options.asked_recipe(config)
    _, sweeps = disturbed.asked_conditions(load_vehicle(config.vehicle), config.only, effects=False)
    trials = judging.trials_of(config)
    rows = [
        training.Row(FIXED, "fixed dynamics", fixed(recipe)),
        training.Row(RANDOMISED, "the recipe's dynamics", recipe),
    ]
    runs = training.trained(
        training.Study(rows, seeds, may_diverge=False), place.cache, console, place.workers
    )
    shares = {seed: trials[part :: len(seeds)] for part, seed in enumerate(seeds)}
    fliers = {
        row.key: [(run.policy, shares[run.seed]) for run in runs if run.row == row.key]
        for row in rows
    }
    _, grown = disturbed.flown_under([], sweeps, fliers, place.cache, console, place.workers)
    base = next(iter(grown.values()))[0]
    worse = {sweep.name: points[1:] for sweep, points in grown.items()}
    worse[ALL] = [point for points in worse.values() for point in points]
    sizes = {seed: len(share) for seed, share in shares.items()}
    compared = {
        what: compare(
            {row.key: np.array([p.won(row.key) for p in points]) for row in rows},
            list(sizes.values()),
        )
        for what, points in {"undisturbed": [base], **worse}.items()
    }
    grids = [condition_grid(points, base, (s.axis,), s.name) for s, points in grown.items()]
    picture = Picture(sweeps_chart(grown), "Success with 95 % Wilson intervals.")
    report = Report(
        title="What randomised dynamics in training buy",
        lead=lead(compared),
        facts={
            "recipe": f"{options.recipe_words(config)}, {recipe.optimizer.iterations} gradient "
            "steps",
            "randomised": _ranges(recipe),
            "fixed": "the middle of those ranges; no wind, no noise",
            "training seeds": " ".join(map(str, seeds)),
            "trained at commit": training.commits(runs),
            "trials": f"three tracks, level {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} trials a condition, shared out to the "
            "training seeds",
            "vehicle": config.vehicle,
        },
        sections=[
            Section("By disturbance", [_summary(compared), MEANING, picture]),
            Section("Every training", [_by_seed(sizes, base, worse[ALL])]),
            Section("Every condition", grids),
        ],
    )
    return report, {
        "compared": {what: {"rates": e.rates, **e.gap._asdict()} for what, e in compared.items()},
        "conditions": [
            disturbed.tested_numbers(p, base) for points in grown.values() for p in points
        ],
    }


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


def compare(won: Mapping[str, np.ndarray], sizes: Sequence[int]) -> Compared:
    """Return two settings' success over all conditions together, and how they differ.

    Args:
        won: which trials succeeded, (conditions, trials) bool of each setting.
        sizes: trials of each training seed, in their order.
    """
    rates = {name: wilson(int(each.sum()), each.size) for name, each in won.items()}
    first, second = (each.mean(axis=0) for each in won.values())
    return Compared(rates, nested(np.split(second - first, np.cumsum(sizes)[:-1])))


def lead(compared: Mapping[str, Compared]) -> str:
    """Return in sentences what randomisation gains and loses."""

    def said(name: str) -> str:
        fixed, randomised = (100 * rate.value for rate in compared[name].rates.values())
        points = points_cell(compared[name].gap.difference).text
        return (
            f"{randomised:.0f} % succeed where dynamics were randomised in training and "
            f"{fixed:.0f} % where they were not ({points} points)"
        )

    words = [f"Over all disturbances {said(ALL)}; undisturbed {said('undisturbed')}."]
    for verdict, meant in (
        ("gain", "Randomisation gains in"),
        ("loss", "It loses in"),
        ("unclear", "These trainings do not tell for"),
    ):
        named = [what for what, entry in compared.items() if entry.gap.verdict == verdict]
        if named:
            words.append(f"{meant}: {', '.join(named)}.")
    return " ".join(words)


def _summary(compared: Mapping[str, Compared]) -> Grid:
    lines = [
        [
            what,
            *(f"{100 * rate.value:.0f}" for rate in rates.values()),
            points_cell(gap.difference),
            " ".join(f"{100 * each:+.0f}" for each in gap.of_seeds),
            "" if gap.verdict == "unclear" else gap.verdict,
        ]
        for what, (rates, gap) in compared.items()
    ]
    headers = ["disturbance", f"{FIXED} [%]", f"{RANDOMISED} [%]", "difference [points]"]
    return table([*headers, "by seed", ""], lines)


def _by_seed(sizes: Mapping[int, int], base: Tested, worse: Sequence[Tested]) -> Grid:
    lines, start, names = [], 0, list(base.results)
    for seed, size in sizes.items():
        mine = slice(start, start + size)
        start += size
        rates = [
            100 * np.mean([point.won(name)[mine] for point in points])
            for points in ([base], worse)
            for name in names
        ]
        lines.append([str(seed), str(size), *(f"{rate:.0f}" for rate in rates)])
    headers = ["training seed", "trials"]
    headers += [f"{name}, {how} [%]" for how in ("undisturbed", "disturbed") for name in names]
    return table(headers, lines)


def _ranges(recipe: TrainConfig) -> str:
    physics = recipe.physics
    low, high = physics.drag
    first, last = physics.action_delay
    return (
        f"lag {physics.lag_mean:g} +- {physics.lag_std:g} 1/s, drag {low:g} to {high:g} 1/s, delay "
        f"{first:g} to {last:g} decisions, wind {physics.wind_std[0]:g} m/s, time step "
        f"{100 * physics.time_step_std:g} %, field of view, noise of the image"
    )
