"""The document of `suite reproduce ideas`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from eval.stats import Interval, bootstrap_mean
from eval.trial import TrialResult
from suite.charts import LINES, png, titled
from suite.report import Cell, Grid, Picture, Report, Section
from suite.reproduce.robust_tables import points_cell
from suite.reproduce.trainings import commit_of

if TYPE_CHECKING:
    from suite.reproduce.ideas import Config, Idea

MEANING = (
    "Success: over the trials of all training seeds, with the least and the most of a seed. "
    "Difference: to the recipe on the same trials and training seeds, in points, with the 95 % "
    "bootstrap interval over trials, each drawn with all its trainings; it holds for these "
    "trainings, and their differences, seed by seed, say how far others may be off. A change "
    "counts as a gain or a loss where the interval leaves zero out and every seed agrees.",
    "v_max: the median over trials of each one's largest speed before any contact.",
)
ROUND = (
    "Flown in the training's own dynamics from standing start, with the same unseen tracks of "
    "eight round gates for both. Success cross: all gates without a collision; success rate: no "
    "collision, whatever gates were passed. Mean over training seeds, least and most."
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

    @property
    def verdict(self) -> str:
        """`gain`, `loss` or `unclear`."""
        low, high = self.difference.low, self.difference.high
        if low > 0 and min(self.of_seeds) > 0:
            return "gain"
        return "loss" if high < 0 and max(self.of_seeds) < 0 else "unclear"


def compared(key: str, mine: Sequence[Sequence[TrialResult]], base: np.ndarray) -> Compared:
    """Return a row.

    Args:
        key: its name.
        mine: results of each training seed, the same trials in the same order.
        base: which of them the recipe's trainings won, (seeds, trials) bool.
    """
    won = np.array([[row.success for row in rows] for rows in mine])
    gap = won.astype(float) - base
    every = [row for rows in mine for row in rows]
    return Compared(
        key=key,
        success=won.mean(axis=1).tolist(),
        difference=bootstrap_mean(gap.mean(axis=0)),
        of_seeds=gap.mean(axis=1).tolist(),
        v_max=float(np.median([row.v_max for row in every])),
        collisions=float(np.mean([row.ended_by == "collision" for row in every])),
        timeouts=float(np.mean([row.ended_by == "timeout" for row in every])),
    )


def ideas_report(
    config: Config,
    chosen: Sequence[Idea],
    judged: Mapping[str, Sequence[Sequence[TrialResult]]],
    rounds: Sequence[Idea],
    measured: Mapping[str, Sequence[Mapping[str, float]]],
    policies: Sequence[str],
) -> tuple[Report, dict[str, Any]]:
    """Return the document and the numbers that go beside it.

    Args:
        config: what was asked.
        chosen: the rows that were judged, the recipe first.
        judged: results of each row's training seeds.
        rounds: the rows with round gates.
        measured: their numbers, of each training seed.
        policies: every training's policy.
    """
    first, recipe = next(iter(judged.values())), chosen[0].recipe
    base = np.array([[row.success for row in rows] for rows in first])
    rows = [compared(key, mine, base) for key, mine in judged.items()]
    last = config.seed + config.trials - 1
    sections = [
        Section(
            "One change at a time",
            [
                _grid(chosen, rows),
                *MEANING,
                Picture(_chart(rows), "Difference in success to the recipe; dots: training seeds."),
            ],
        )
    ]
    if rounds:
        sections.append(Section("Round gates", [_round_grid(rounds, measured), ROUND]))
    report = Report(
        title="What could be better than the recipe",
        lead=lead(rows),
        facts={
            "recipe": f"{config.preset} {' '.join(config.set)}".strip()
            + f", {recipe.optimizer.iterations} gradient steps",
            "training seeds": " ".join(map(str, config.training_seeds)),
            "trained at commit": ", ".join(sorted({commit_of(Path(path)) for path in policies})),
            "trials": f"three tracks, levels {config.difficulty}, seeds {config.seed} to {last}: "
            f"{base.shape[1]} a training",
            "vehicle": config.vehicle,
        },
        sections=sections,
    )
    return report, {"config": config, "rows": rows, "round": measured}


def lead(rows: Sequence[Compared]) -> str:
    """Return in sentences which changes are gains and which losses."""
    said = []
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
    rate = 100 * float(np.mean(rows[0].success))
    return f"Of the recipe's trials {rate:.0f} % succeed. " + " ".join(said)


def _grid(chosen: Sequence[Idea], rows: Sequence[Compared]) -> Grid:
    headers = ["row", "what", "changes", "success [%]", "difference [points]", "by seed",
               "v_max [m/s]", "collisions [%]", "timeouts [%]", ""]  # fmt: skip
    cells = []
    for number, (idea, row) in enumerate(zip(chosen, rows, strict=True)):
        low, high = 100 * min(row.success), 100 * max(row.success)
        mean = 100 * float(np.mean(row.success))
        seeds = " ".join(f"{100 * gap:+.0f}" for gap in row.of_seeds)
        cells.append(
            [
                Cell(idea.key),
                Cell(idea.words),
                Cell(" ".join(f"`{change}`" for change in idea.changes) or "-"),
                Cell(f"{mean:.0f} [{low:.0f}, {high:.0f}]"),
                points_cell(row.difference) if number else Cell("-"),
                Cell(seeds if number else "-"),
                Cell(f"{row.v_max:.2f}"),
                Cell(f"{100 * row.collisions:.0f}"),
                Cell(f"{100 * row.timeouts:.0f}"),
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
        line = [idea.key, idea.words]
        for name, scale in names.items():
            values = [scale * numbers[name] for numbers in measured[idea.key]]
            digits = 0 if scale > 1 else 2
            line.append(
                f"{np.mean(values):.{digits}f} [{min(values):.{digits}f}, {max(values):.{digits}f}]"
            )
        cells.append([Cell(text) for text in line])
    return Grid("", headers, cells)


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
    titled(axes, "Success, points more than the recipe (bar: 95 % interval over trials)")
    axes.set_yticks(range(len(shown)), [row.key for row in shown])
    axes.invert_yaxis()
    return png(figure)
