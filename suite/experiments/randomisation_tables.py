"""The document of `suite reproduce randomisation`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from eval.worlds.trial import TrialSpec
from suite.common.report import Cell, Grid, Picture, Report, Section
from suite.experiments import seed_intervals
from suite.experiments.conditions import Sweep
from suite.experiments.robust_charts import sweeps_chart
from suite.experiments.robust_tables import Tested, condition_grid, points_cell, tested_numbers
from suite.experiments.trainings import commit_of
from suite.train.config import TrainConfig

if TYPE_CHECKING:
    from suite.experiments.randomisation import Config

ALL = "all disturbances"
MEANING = (
    "Success: over all trials under all sizes of the disturbance but the undisturbed one. "
    "Difference: randomised - fixed, in points, with a 95 % bootstrap interval that draws training "
    "seeds anew and the trials of each, a trial with all its conditions. A gain or a loss is where "
    "it leaves zero out and every seed agrees; with few seeds one of several rows may stand out by "
    "chance."
)


class Compared(NamedTuple):
    """Two settings of the recipe under some conditions, all of them together."""

    rates: dict[str, Interval]
    """Each setting's success, with Wilson intervals."""
    difference: Interval
    """In success, the second - the first, over seeds and trials."""
    of_seeds: list[float]
    """The difference of each training seed."""

    @property
    def verdict(self) -> str:
        """`gain`, `loss` or `unclear`."""
        return seed_intervals.verdict(self.difference, self.of_seeds)


def randomisation_report(
    config: Config,
    recipe: TrainConfig,
    policies: Mapping[str, Sequence[str]],
    shares: Sequence[Sequence[TrialSpec]],
    grown: Mapping[Sweep, Sequence[Tested]],
) -> tuple[Report, dict[str, Any]]:
    """Return the document and the numbers that go beside it.

    Args:
        config: what was asked.
        recipe: of the randomised setting.
        policies: of each setting, the fixed one first, one a training seed.
        shares: the trials of each training seed, in the order of every `Tested`.
        grown: the points of each sweep, the undisturbed first.
    """
    names = list(policies)
    base = next(iter(grown.values()))[0]
    disturbed = {sweep.name: points[1:] for sweep, points in grown.items()}
    disturbed[ALL] = [point for points in disturbed.values() for point in points]
    together = {"undisturbed": [base], **disturbed}
    sizes = [len(share) for share in shares]
    compared = {
        what: compare({name: np.array([p.won(name) for p in points]) for name in names}, sizes)
        for what, points in together.items()
    }
    trained = _by_seed(config, shares, base, disturbed[ALL], names)
    last = config.seed + config.trials - 1
    report = Report(
        title="What randomised dynamics in training buy",
        lead=_lead(compared),
        facts={
            "recipe": f"{config.preset} {' '.join(config.set)}".strip()
            + f", {recipe.optimizer.iterations} gradient steps",
            "randomised": _ranges(recipe),
            "fixed": "the middle of those ranges; no wind, no noise",
            "training seeds": " ".join(map(str, config.training_seeds)),
            "trained at commit": ", ".join(
                sorted({commit_of(Path(path)) for paths in policies.values() for path in paths})
            ),
            "trials": f"three tracks, level {config.difficulty}, seeds {config.seed} to {last}: "
            f"{sum(map(len, shares))} trials a condition, shared out to the training seeds",
            "vehicle": config.vehicle,
        },
        sections=[
            Section(
                "By disturbance",
                [
                    _summary(compared),
                    MEANING,
                    Picture(sweeps_chart(grown, names), "Success with 95 % Wilson intervals."),
                ],
            ),
            Section("Every training", [trained]),
            Section(
                "Every condition",
                [
                    condition_grid(sweep.name, points, base, names, (sweep.axis,))
                    for sweep, points in grown.items()
                ],
            ),
        ],
    )
    numbers = {
        "config": config,
        "compared": compared,
        "conditions": [
            tested_numbers(point, base, names) for points in grown.values() for point in points
        ],
    }
    return report, numbers


def compare(won: Mapping[str, np.ndarray], sizes: Sequence[int]) -> Compared:
    """Return two settings' success over all conditions together, and how they differ.

    Args:
        won: which trials succeeded, (conditions, trials) bool of each setting.
        sizes: trials of each training seed, in their order.
    """
    rates = {name: wilson(int(each.sum()), each.size) for name, each in won.items()}
    first, second = (each.mean(axis=0) for each in won.values())
    gaps = np.split(second - first, np.cumsum(sizes)[:-1])
    return Compared(rates, seed_intervals.nested(gaps), [float(gap.mean()) for gap in gaps])


def _lead(compared: Mapping[str, Compared]) -> str:
    def said(name: str) -> str:
        fixed, randomised = (100 * rate.value for rate in compared[name].rates.values())
        points = points_cell(compared[name].difference).text
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
        named = [what for what, entry in compared.items() if entry.verdict == verdict]
        if named:
            words.append(f"{meant}: {', '.join(named)}.")
    return " ".join(words)


def _summary(compared: Mapping[str, Compared]) -> Grid:
    names = list(next(iter(compared.values())).rates)
    rows = []
    for what, entry in compared.items():
        rates = [Cell(f"{100 * rate.value:.0f}") for rate in entry.rates.values()]
        of_seeds = " ".join(f"{100 * gap:+.0f}" for gap in entry.of_seeds)
        told = "" if entry.verdict == "unclear" else entry.verdict
        rows.append([Cell(what), *rates, points_cell(entry.difference), Cell(of_seeds), Cell(told)])
    headers = ["disturbance", *(f"{name} [%]" for name in names), "difference [points]"]
    return Grid("", [*headers, "by seed", ""], rows)


def _by_seed(
    config: Config,
    shares: Sequence[Sequence[TrialSpec]],
    base: Tested,
    disturbed: Sequence[Tested],
    names: Sequence[str],
) -> Grid:
    rows, start = [], 0
    for seed, share in zip(config.training_seeds, shares, strict=True):
        mine = slice(start, start + len(share))
        start += len(share)
        cells = [
            Cell(f"{100 * np.mean([point.won(name)[mine] for point in points]):.0f}")
            for points in ([base], disturbed)
            for name in names
        ]
        rows.append([Cell(str(seed)), Cell(str(len(share))), *cells])
    headers = ["training seed", "trials"]
    headers += [f"{name}, {how} [%]" for how in ("undisturbed", "disturbed") for name in names]
    return Grid("", headers, rows)


def _ranges(recipe: TrainConfig) -> str:
    physics = recipe.physics
    low, high = physics.drag
    first, last = physics.action_delay
    return (
        f"lag {physics.lag_mean:g} +- {physics.lag_std:g} 1/s, drag {low:g} to {high:g} 1/s, delay "
        f"{first:g} to {last:g} decisions, wind {physics.wind_std[0]:g} m/s, time step "
        f"{100 * physics.time_step_std:g} %, field of view, noise of the image"
    )
