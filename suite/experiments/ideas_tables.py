"""The document of `suite reproduce ideas`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from eval.judging.statistics import Interval
from eval.worlds.trial import TrialResult
from suite.common.charts import LINES, png, titled
from suite.common.console import duration
from suite.common.report import Cell, Grid, Picture, Report, Section, ranged
from suite.experiments import seed_intervals
from suite.experiments.robust_tables import points_cell

if TYPE_CHECKING:
    from suite.experiments.ideas import Config, Idea, Made

MEANING = (
    "Success: over the trials of all training seeds, with the least and the most of a seed. "
    "Difference: to the recipe on the same trials and training seeds, in points, with a 95 % "
    "bootstrap interval that draws training seeds and trials anew. A gain or a loss is where it "
    "leaves zero out and every seed agrees. Seeds are few, and all rows are compared with the same "
    "trainings of the recipe: where a change does nothing, three seeds agree in sign one time in "
    "four, and of many rows one may stand out by chance.",
    "v_max: the median over trials of each one's largest speed before any contact. Training: the "
    "median time of a row's trainings, without compilation.",
)
ROUND = (
    "In the training's own dynamics, from standing start. Success cross: all gates without a "
    "collision; success rate: no collision, whatever gates were passed. Mean over training seeds, "
    "least and most. Images show the nearest 24 bars and plates, and collisions are looked for "
    "among the nearest 8: three gates and one, with eight bars each. It is the same for both."
)


class Compared(NamedTuple):
    """A row against the recipe."""

    key: str
    success: list[float]
    """Of each training seed."""
    difference: Interval
    """In success, over all seeds' trials."""
    of_seeds: list[float]
    """The difference of each training seed."""
    v_max: float
    """Median over trials [m/s]."""
    collisions: float
    """Share of trials."""
    timeouts: float
    """Share of trials."""
    seconds: float
    """Median training time [s]."""

    @property
    def verdict(self) -> str:
        """`gain`, `loss` or `unclear`."""
        return seed_intervals.verdict(self.difference, self.of_seeds)


def compared(
    key: str, mine: Sequence[Sequence[TrialResult]], base: np.ndarray, seconds: float
) -> Compared:
    """Return a row.

    Args:
        key: its name.
        mine: results of each training seed, the same trials in the same order.
        base: which of them the recipe's trainings won, (seeds, trials) bool.
        seconds: median training time.
    """
    won = _won(mine)
    gap = won.astype(float) - base
    every = [row for rows in mine for row in rows]
    return Compared(
        key=key,
        success=won.mean(axis=1).tolist(),
        difference=seed_intervals.crossed(gap),
        of_seeds=gap.mean(axis=1).tolist(),
        v_max=float(np.median([row.v_max for row in every])),
        collisions=float(np.mean([row.ended_by == "collision" for row in every])),
        timeouts=float(np.mean([row.ended_by == "timeout" for row in every])),
        seconds=seconds,
    )


def _won(results: Sequence[Sequence[TrialResult]]) -> np.ndarray:
    return np.array([[row.success for row in rows] for rows in results])


def ideas_report(
    config: Config,
    chosen: Sequence[Idea],
    made: Mapping[tuple[str, int], Made],
    judged: Mapping[tuple[str, int], Sequence[TrialResult]],
    measured: Mapping[str, Sequence[Mapping[str, float]]],
    failures: Mapping[str, str],
) -> tuple[Report, dict[str, Any]]:
    """Return the document and the numbers that go beside it.

    Args:
        config: what was asked.
        chosen: all rows that were trained to the end, the recipe first.
        made: every training by its row and seed.
        judged: results of those that the judge flew.
        measured: numbers of the rows with round gates, of each training seed.
        failures: what was said of the rows that a diverged training leaves out.
    """
    seeds, first = config.training_seeds, chosen[0]
    base = _won([judged[first.key, seed] for seed in seeds])
    flown = [idea for idea in chosen if not idea.round]
    rows = [
        compared(
            idea.key,
            [judged[idea.key, seed] for seed in seeds],
            base,
            float(np.median([made[idea.key, seed].seconds for seed in seeds])),
        )
        for idea in flown
    ]
    caption = "Difference in success to the recipe; dots: training seeds."
    sections = [
        Section(
            "One change at a time",
            [_grid(flown, rows), *MEANING, Picture(_chart(rows), caption)],
        )
    ]
    rounds = [idea for idea in chosen if idea.round]
    if rounds:
        sections.append(Section("Round gates", [_round_grid(rounds, measured), ROUND]))
    optimizer, episode = first.recipe.optimizer, first.recipe.episode
    last = config.seed + config.trials - 1
    report = Report(
        title="What could be better than the recipe",
        lead=" ".join([lead(rows), *(_round_words(idea, measured) for idea in rounds)]),
        facts={
            "recipe": f"{config.preset} {' '.join(config.set)}".strip()
            + f", {optimizer.iterations} gradient steps of {episode.batch} worlds x "
            f"{episode.steps} steps",
            "training seeds": " ".join(map(str, seeds)),
            "trained at commit": ", ".join(sorted({run.commit for run in made.values()})),
            "trials": f"three tracks, levels {config.difficulty}, seeds {config.seed} to {last}: "
            f"{base.shape[1]} a training",
            "worlds with round gates": f"{config.round_trials}, seed {config.round_seed}, "
            f"{config.round_seconds:g} s each",
            "trainings at once": f"{config.jobs}, each on its own share of the cores",
            "vehicle": config.vehicle,
            **{f"left out, {key}": said for key, said in failures.items()},
        },
        sections=sections,
    )
    numbers = {"config": config, "rows": rows, "round": measured, "diverged": failures}
    return report, numbers


def lead(rows: Sequence[Compared]) -> str:
    """Return in sentences which changes are gains and which losses."""
    said = [f"Of the recipe's trials {100 * float(np.mean(rows[0].success)):.0f} % succeed."]
    for verdict, words in (("gain", "More succeed with"), ("loss", "Fewer succeed with")):
        named = [
            f"{row.key} ({points_cell(row.difference).text})"
            for row in rows[1:]
            if row.verdict == verdict
        ]
        if named:
            said.append(f"{words} {', '.join(named)}.")
    unclear = [row.key for row in rows[1:] if row.verdict == "unclear"]
    if unclear:
        said.append(f"These trainings do not tell for {', '.join(unclear)}.")
    return " ".join(said)


def _round_words(idea: Idea, measured: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    cross = _range([100 * numbers["success_cross"] for numbers in measured[idea.key]], 0)
    return f"{idea.words[0].upper() + idea.words[1:]}: {cross} % of the tracks are crossed."


def _grid(chosen: Sequence[Idea], rows: Sequence[Compared]) -> Grid:
    headers = ["row", "what", "changes", "success [%]", "difference [points]", "by seed",
               "v_max [m/s]", "collisions [%]", "timeouts [%]", "training", ""]  # fmt: skip
    cells = []
    for number, (idea, row) in enumerate(zip(chosen, rows, strict=True)):
        seeds = " ".join(f"{round(100 * gap) + 0:+d}" for gap in row.of_seeds)
        cells.append(
            [
                Cell(idea.key),
                Cell(idea.words),
                Cell(" ".join(f"`{change}`" for change in idea.changes) or "-"),
                Cell(_range([100 * rate for rate in row.success], 0)),
                points_cell(row.difference) if number else Cell("-"),
                Cell(seeds if number else "-"),
                Cell(f"{row.v_max:.2f}"),
                Cell(f"{100 * row.collisions:.0f}"),
                Cell(f"{100 * row.timeouts:.0f}"),
                Cell(duration(row.seconds)),
                Cell(row.verdict if number else ""),
            ]
        )
    return Grid("", headers, cells)


def _round_grid(
    rounds: Sequence[Idea], measured: Mapping[str, Sequence[Mapping[str, float]]]
) -> Grid:
    names = {"success_cross": 100.0, "success_rate": 100.0, "v_max": 1.0, "gates": 1.0}
    headers = ["row", "what", "success cross [%]", "success rate [%]", "v_max [m/s]", "gates"]
    cells = []
    for idea in rounds:
        columns = [
            _range([scale * numbers[name] for numbers in measured[idea.key]], 0 if scale > 1 else 2)
            for name, scale in names.items()
        ]
        cells.append([Cell(text) for text in (idea.key, idea.words, *columns)])
    return Grid("", headers, cells)


def _range(values: Sequence[float], digits: int) -> str:
    """Return the mean with the least and the most."""
    return ranged(float(np.mean(values)), min(values), max(values), digits)


def _chart(rows: Sequence[Compared]) -> bytes:
    shown = rows[1:]
    figure = Figure(figsize=(7.4, 1.2 + 0.32 * len(shown)), layout="constrained")
    axes = figure.subplots()
    axes.axvline(0, color="black", lw=0.8)
    for at, row in enumerate(shown):
        value, low, high = 100 * np.array(row.difference)
        axes.plot([low, high], [at, at], "-", lw=4, color=LINES[0], alpha=0.35)
        axes.plot(value, at, "|", ms=12, mew=2, color=LINES[0])
        axes.plot(100 * np.array(row.of_seeds), [at] * len(row.of_seeds), "o", ms=4, color=LINES[0])
    titled(axes, "Success, points more than the recipe (bar: 95 % interval)")
    axes.set_yticks(range(len(shown)), [row.key for row in shown])
    axes.invert_yaxis()
    return png(figure)
