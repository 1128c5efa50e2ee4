"""The tables printed in Su et al. 2026 (paper.toml), and the goals of our policy by cell."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from eval.judging.tables import Tally, percent
from tracks.common.grid import Grid, table

SURE = 0.90
"""Goal for the lower end of the Wilson interval of our success rate, in a cell in which the paper
prints a success rate of 1. No measured rate can be better than 1, so the interval is compared."""
FLOORS = {0: 0.99, 3: 0.98, 6: 0.97, 9: 0.95}
"""Level -> second goal for the success rate: a fixed lower limit, whatever the paper prints."""


class Printed(NamedTuple):
    """Printed result of one method in one cell."""

    method: str
    """Key of the method in paper.toml."""
    track: str
    level: int
    won: int
    """Number of successful trials."""
    trials: int
    v_max: float
    """Largest speed [m/s]; the paper does not say whether of one trial or of all."""


class SimToSim(NamedTuple):
    """The paper's table "Sim-to-sim Performance"."""

    source: str
    """Citation of the table."""
    levels: tuple[int, ...]
    methods: dict[str, str]
    """Key of each method -> its printed name, in the order of the table."""
    cells: tuple[Printed, ...]
    """Results of all methods in all cells."""

    def at(self, track: str, level: int) -> list[Printed]:
        """Return the cells of all methods on one track at one level."""
        return [cell for cell in self.cells if (cell.track, cell.level) == (track, level)]


class Ablated(NamedTuple):
    """Printed result of one setting of the ablation."""

    success_cross: float
    """Share of trials with all four gates and no collision."""
    collision_free: float
    """Share of trials without a collision."""
    v_max: float
    """Largest speed [m/s]; the paper does not say whether of one trial or of all."""


def _read_table(name: str) -> dict[str, Any]:
    path = Path(__file__).with_name("paper.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))[name]


@functools.cache
def ablation() -> tuple[str, dict[str, Ablated]]:
    """Return the table "Performance Comparison with and without AVF": its citation, and its rows.

    The key of a row is a key of the settings on the page `ablation`, such as "field 0.4".
    """
    printed = _read_table("ablation")
    return printed["source"], {key: Ablated(**row) for key, row in printed["rows"].items()}


@functools.cache
def sim_to_sim() -> SimToSim:
    """Return the table "Sim-to-sim Performance"."""
    printed = _read_table("sim_to_sim")
    levels, methods = printed["levels"], printed["methods"]
    names = {key: method["name"] for key, method in methods.items()}
    cells = [
        Printed(key, track, level, won, printed["trials"], v_max)
        for key, method in methods.items()
        for track, rows in method.items()
        if track != "name"
        for level, won, v_max in zip(levels, rows["won"], rows["v_max"], strict=True)
    ]
    return SimToSim(printed["source"], tuple(levels), names, tuple(cells))


class Goal(NamedTuple):
    """The three goals of one cell, and the distances to them, which are 0 if a goal is met."""

    track: str
    level: int
    success: float
    """First goal: the best printed success rate. If that is 1, the interval of our success rate
    must begin at `SURE` or above instead."""
    success_miss: float
    """Distance of our success rate, or of the lower end of its interval, to the first goal."""
    floor: float
    """Second goal: the success rate that `FLOORS` demands at this level."""
    floor_miss: float
    """Distance of our success rate to the second goal."""
    v_max: float
    """Third goal: the largest printed v_max [m/s]."""
    v_max_miss: float
    """Distance of our median v_max over trials to the third goal [m/s]."""
    of_ten_miss: float | None = None
    """Distance of the mean of our largest v_max of ten trials to the third goal [m/s]; None with
    fewer than ten trials."""


def goals(cells: Sequence[Tally]) -> list[Goal]:
    """Return the goals of those of `cells` that the paper prints, and the distances to them."""
    printed = sim_to_sim()
    cell_goals = []
    for cell in cells:
        printed_cells = printed.at(cell.track, cell.difficulty)
        if not printed_cells:
            continue
        success, v_max_of_ten = cell.success, cell.v_max_of_ten
        best_rate = max(other.won / other.trials for other in printed_cells)
        v_max = max(other.v_max for other in printed_cells)
        floor = FLOORS[cell.difficulty]
        cell_goals.append(
            Goal(
                cell.track,
                cell.difficulty,
                success=best_rate,
                success_miss=max(
                    0.0, SURE - success.low if best_rate == 1 else best_rate - success.value
                ),
                floor=floor,
                floor_miss=max(0.0, floor - success.value),
                v_max=v_max,
                v_max_miss=max(0.0, v_max - cell.v_max.value),
                of_ten_miss=None if v_max_of_ten is None else max(0.0, v_max - v_max_of_ten),
            )
        )
    return cell_goals


def goal_grid(cells: Sequence[Tally]) -> Grid:
    """Return a table of the printed cells: the results of our policy, and the goals."""
    by_key = {(cell.track, cell.difficulty): cell for cell in cells}
    headers = ["track", "level", "success", "best of the others", "missed by", "floor",
               "missed by", "v_max [m/s]", "largest of the others", "missed by"]  # fmt: skip
    lines = [
        (
            goal.track,
            str(goal.level),
            percent(by_key[goal.track, goal.level].success),
            f"{100 * goal.success:.0f} %",
            _miss_text(100 * goal.success_miss, "points"),
            f"{100 * goal.floor:.0f} %",
            _miss_text(100 * goal.floor_miss, "points"),
            f"{by_key[goal.track, goal.level].v_max.value:.2f}",
            f"{goal.v_max:.1f}",
            _miss_text(goal.v_max_miss, "m/s", digits=2),
        )
        for goal in goals(cells)
    ]
    return table(headers, lines)


def _miss_text(miss: float, unit: str, digits: int = 1) -> str:
    """Return the distance to a goal as text, "met" for 0."""
    return f"{miss:.{digits}f} {unit}" if miss else "met"
