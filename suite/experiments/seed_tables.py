"""The spread over training seeds, and the document that shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from eval.judging.tables import Cell as Judged
from eval.judging.tables import markdown_table
from suite.common.charts import LINES, png, titled
from suite.common.report import Cell, Grid, Picture, Report, Section
from suite.experiments.trainings import commit_of
from suite.judging.flying import policy_digest

if TYPE_CHECKING:
    from suite.experiments.seeds import Config

MEANING = (
    "Every policy flew the same trials. The standard deviation is over training seeds (n - 1); "
    "each cell's own sampling error is part of it, as the intervals further down show."
)


class Spread(NamedTuple):
    """How the training seeds of one recipe differ."""

    mean_success: dict[str, float]
    """Of each policy: mean success over its cells."""
    median: str
    """The policy whose mean success is the median; of an even number, the lower middle one."""
    mean: float
    """Over policies."""
    standard_deviation: float
    """Over policies; NaN of one."""


def spread(cells: Mapping[str, Sequence[Judged]]) -> Spread:
    """Return how the policies differ in mean success over their cells."""
    means = {name: float(np.mean([c.success.value for c in some])) for name, some in cells.items()}
    ordered = sorted(means, key=lambda name: means[name])
    values = list(means.values())
    return Spread(means, ordered[(len(ordered) - 1) // 2], float(np.mean(values)), _std(values))


def _std(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def seed_report(
    config: Config,
    policies: Mapping[str, str],
    cells: Mapping[str, Sequence[Judged]],
    found: Spread,
) -> Report:
    """Return the document.

    Args:
        config: what was asked.
        policies: folder or file of each policy by name.
        cells: of each policy, all on the same tracks and levels.
        found: their spread.
    """
    low, high = min(found.mean_success.values()), max(found.mean_success.values())
    recipe = "given policies" if config.policies else f"{config.preset} {' '.join(config.set)}"
    everything = [cell for some in cells.values() for cell in some]
    return Report(
        title="The same recipe from several training seeds",
        lead=(
            f"Mean success over the {len(next(iter(cells.values())))} cells: "
            f"{100 * found.mean:.1f} % over {len(cells)} training seeds, from {100 * low:.1f} to "
            f"{100 * high:.1f} (standard deviation {100 * found.standard_deviation:.1f} points). "
            f"The median is {found.median}."
        ),
        facts={
            "recipe": recipe.strip(),
            **{
                name: f"SHA-256 {policy_digest(path)[:16]}, trained at commit "
                f"{commit_of(Path(path))}"
                for name, path in policies.items()
            },
            "vehicle": config.vehicle,
            "judged seeds": f"{config.seed} to {config.seed + config.trials - 1}, the same for all",
        },
        sections=[
            Section(
                "Success and speed by training seed",
                [
                    _grid("Success [%]", cells, lambda c: c.success.value, 100, 0),
                    _grid("v_max, median over trials [m/s]", cells, lambda c: c.v_max.value, 1, 2),
                    MEANING,
                    Picture(_chart(cells), "Success of each training seed, cell by cell."),
                ],
            ),
            Section(
                "Every cell with its intervals",
                [markdown_table({"cells": everything, "paired": []}).strip("\n")],
            ),
        ],
    )


def _grid(
    title: str,
    cells: Mapping[str, Sequence[Judged]],
    pick: Callable[[Judged], float],
    scale: float,
    digits: int,
) -> Grid:
    """Return one number of every policy and cell, with its spread over policies below."""
    first = next(iter(cells.values()))
    headers = ["policy", "mean", *(f"{cell.track} {cell.difficulty}" for cell in first)]
    table = scale * np.array([[pick(cell) for cell in some] for some in cells.values()])
    table = np.column_stack([table.mean(axis=1), table])
    lines = list(zip(cells, table.tolist(), strict=True))
    columns = table.T.tolist()
    lines += [("mean", [float(np.mean(column)) for column in columns])]
    lines += [("standard deviation", [_std(column) for column in columns])]
    lines += [("least", list(map(min, columns))), ("most", list(map(max, columns)))]

    def text(name: str, value: float, number: int) -> str:
        finer = number == 0 or name in ("mean", "standard deviation")
        return f"{value:.{digits + finer}f}"

    rows = [[Cell(n), *(Cell(text(n, v, k)) for k, v in enumerate(values))] for n, values in lines]
    return Grid(title, headers, rows)


def _chart(cells: Mapping[str, Sequence[Judged]]) -> bytes:
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.subplots()
    first = next(iter(cells.values()))
    for number, (name, some) in enumerate(cells.items()):
        value, low, high = 100 * np.array([cell.success for cell in some]).T
        at = np.arange(len(some)) + 0.12 * (number - (len(cells) - 1) / 2)
        reach = np.maximum([value - low, high - value], 0)
        colour = LINES[number % len(LINES)]
        axes.errorbar(at, value, reach, fmt="o", ms=4, lw=1.2, color=colour, label=name)
    titled(axes, "Success with 95 % Wilson intervals [%]")
    axes.set_ylim(-3, 103)
    axes.set_xticks(range(len(first)), [f"{c.track}\nlevel {c.difficulty}" for c in first])
    axes.tick_params(labelsize=7)
    figure.legend(loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    return png(figure)
