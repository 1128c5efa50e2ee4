"""The tables printed in Su et al. 2026 (paper.toml), and the goals of our policy by cell.

A cell is the trials of one track at one level of difficulty.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from eval.judging.tables import Tally, percent
from tracks.common.grid import Grid, table

SURE = 0.90
"""Goal for the lower end of our Wilson interval if the printed success rate is 1."""
FLOORS = {0: 0.99, 3: 0.98, 6: 0.97, 9: 0.95}
"""Goal for the success rate of the shipped policy, by level."""


class Printed(NamedTuple):
    """One method on one track at one level, as printed."""

    method: str
    """Its key in paper.toml."""
    track: str
    level: int
    won: int
    """Number of successful trials."""
    trials: int
    v_max: float
    """[m/s]; the paper does not say over what it is the maximum."""


class SimToSim(NamedTuple):
    """The paper's table "Sim-to-sim Performance"."""

    source: str
    """Citation of the table."""
    levels: tuple[int, ...]
    methods: dict[str, str]
    """Names of the methods by key, in the order of the table."""
    cells: tuple[Printed, ...]

    def at(self, track: str, level: int) -> list[Printed]:
        """Return the cells of all methods on one track at one level."""
        return [cell for cell in self.cells if (cell.track, cell.level) == (track, level)]


class Ablated(NamedTuple):
    """One setting of the ablation, as printed."""

    success_cross: float
    """Share of trials with all four gates and no collision."""
    collision_free: float
    """Share of trials without a collision."""
    v_max: float
    """[m/s]; the paper does not say over what it is the maximum."""


def _read_table(name: str) -> dict[str, Any]:
    path = Path(__file__).with_name("paper.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))[name]


@functools.cache
def ablation() -> tuple[str, dict[str, Ablated]]:
    """Return the source and the rows of the table "Performance Comparison with and without AVF"."""
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
    """The goals of one cell; a miss is the distance to a goal, 0 if it is met."""

    track: str
    level: int
    success: float
    """Goal: the best printed success rate; for 1 the interval must begin at `SURE` or above."""
    success_miss: float
    """Distance to that goal."""
    floor: float
    """Goal: the entry of `FLOORS`."""
    floor_miss: float
    """Distance to that goal."""
    v_max: float
    """Goal: the largest printed v_max [m/s]."""
    v_max_miss: float
    """Distance of the median over trials to that goal [m/s]."""
    of_ten_miss: float | None = None
    """Distance of the mean largest v_max of ten trials to that goal; None for fewer trials
    [m/s]."""


def goals(cells: Sequence[Tally]) -> list[Goal]:
    """Return the goals of every cell that the paper prints."""
    printed = sim_to_sim()
    cell_goals = []
    for cell in cells:
        others = printed.at(cell.track, cell.difficulty)
        if not others:
            continue
        success, v_max_of_ten = cell.success, cell.v_max_of_ten
        rate = max(other.won / other.trials for other in others)
        v_max = max(other.v_max for other in others)
        floor = FLOORS[cell.difficulty]
        cell_goals.append(
            Goal(
                cell.track,
                cell.difficulty,
                success=rate,
                success_miss=max(0.0, SURE - success.low if rate == 1 else rate - success.value),
                floor=floor,
                floor_miss=max(0.0, floor - success.value),
                v_max=v_max,
                v_max_miss=max(0.0, v_max - cell.v_max.value),
                of_ten_miss=None if v_max_of_ten is None else max(0.0, v_max - v_max_of_ten),
            )
        )
    return cell_goals


def goal_grid(cells: Sequence[Tally]) -> Grid:
    """Return a table of the cells of one policy and their goals."""
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
    return f"{miss:.{digits}f} {unit}" if miss else "met"
