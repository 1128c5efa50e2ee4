"""The paper's printed tables (paper.toml), and how far each cell of a policy is from its goal."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from eval.judging.tables import Tally, percent
from tracks.common.grid import Grid, table

SURE = 0.90
"""Where the printed rate is 1, the least lower end of our Wilson interval."""
FLOORS = {0: 0.99, 3: 0.98, 6: 0.97, 9: 0.95}
"""Least success rate of the shipped policy, by level."""


class Printed(NamedTuple):
    """One method on one track at one level, as printed."""

    method: str
    """Its key in paper.toml."""
    track: str
    level: int
    won: int
    trials: int
    v_max: float
    """[m/s]; the paper does not say over what it is the maximum."""


class SimToSim(NamedTuple):
    """The paper's table of judged policies."""

    source: str
    levels: tuple[int, ...]
    methods: dict[str, str]
    """Names by key, in the order of the table."""
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


def _table(name: str) -> dict[str, Any]:
    path = Path(__file__).with_name("paper.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))[name]


@functools.cache
def ablation() -> tuple[str, dict[str, Ablated]]:
    """Return the source and the rows of the table "Performance Comparison with and without AVF"."""
    found = _table("ablation")
    return found["source"], {key: Ablated(**row) for key, row in found["rows"].items()}


@functools.cache
def sim_to_sim() -> SimToSim:
    """Return the table "Sim-to-sim Performance"."""
    found = _table("sim_to_sim")
    names = {key: method["name"] for key, method in found["methods"].items()}
    cells = [
        Printed(key, track, level, won, found["trials"], v_max)
        for key, method in found["methods"].items()
        for track, rows in method.items()
        if track != "name"
        for level, won, v_max in zip(found["levels"], rows["won"], rows["v_max"], strict=True)
    ]
    return SimToSim(found["source"], tuple(found["levels"]), names, tuple(cells))


class Goal(NamedTuple):
    """One cell and its goals; a miss is the distance to a goal, 0 if it is met."""

    track: str
    level: int
    success: float
    """Goal: the best printed rate; for 1 the interval must begin at `SURE` or above."""
    success_miss: float
    floor: float
    """Goal: the entry of `FLOORS`."""
    floor_miss: float
    v_max: float
    """Goal: the largest printed one [m/s]."""
    v_max_miss: float
    """Of the median over trials [m/s]."""
    of_ten_miss: float | None = None
    """Of the mean largest v_max of ten trials; None with fewer trials [m/s]."""


def goals(cells: Sequence[Tally]) -> list[Goal]:
    """Return the goals of every cell that the paper prints."""
    printed = sim_to_sim()
    found = []
    for cell in cells:
        others = printed.at(cell.track, cell.difficulty)
        if not others:
            continue
        rate = max(other.won / other.trials for other in others)
        v_max = max(other.v_max for other in others)
        missed = SURE - cell.success.low if rate == 1 else rate - cell.success.value
        floor = FLOORS[cell.difficulty]
        of_floor, of_speed = floor - cell.success.value, v_max - cell.v_max.value
        rates = rate, max(0.0, missed), floor, max(0.0, of_floor)
        of_ten = cell.v_max_of_ten
        ten_miss = None if of_ten is None else max(0.0, v_max - of_ten)
        speed = v_max, max(0.0, of_speed), ten_miss
        found.append(Goal(cell.track, cell.difficulty, *rates, *speed))
    return found


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
            _missed(100 * goal.success_miss, "points"),
            f"{100 * goal.floor:.0f} %",
            _missed(100 * goal.floor_miss, "points"),
            f"{by_key[goal.track, goal.level].v_max.value:.2f}",
            f"{goal.v_max:.1f}",
            _missed(goal.v_max_miss, "m/s", digits=2),
        )
        for goal in goals(cells)
    ]
    return table(headers, lines)


def _missed(by: float, unit: str, digits: int = 1) -> str:
    return f"{by:.{digits}f} {unit}" if by else "met"
