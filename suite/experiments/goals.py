"""What is asked of each cell of the table, and by how much a policy misses it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from eval.judging.tables import Cell
from suite.experiments.paper import sim_to_sim

SURE = 0.90
"""Where others won all of their few trials, our Wilson interval must reach down to this."""
FLOORS = {0: 0.97, 3: 0.97, 6: 0.90, 9: 0.70}
"""Success that the shipped policy must reach, by level."""


class Goal(NamedTuple):
    """One cell against what is asked of it; a miss of 0 is met."""

    track: str
    level: int
    success: float
    """What is asked: the best printed rate; 1 asks for an interval from `SURE` up."""
    success_miss: float
    floor: float
    """The shipped policy's success."""
    floor_miss: float
    v_max: float
    """What is asked: the largest printed [m/s]."""
    v_max_miss: float
    """[m/s]."""

    @property
    def met(self) -> bool:
        """Say whether nothing is missed."""
        return not (self.success_miss or self.floor_miss or self.v_max_miss)


def goals(cells: Sequence[Cell]) -> list[Goal]:
    """Return the goal of every cell that the paper prints."""
    printed = sim_to_sim()
    found = []
    for cell in cells:
        others = printed.at(cell.track, cell.difficulty)
        if not others:
            continue
        rate = max(other.won / other.trials for other in others)
        v_max = max(other.v_max for other in others)
        reached = SURE - cell.success.low if rate == 1 else rate - cell.success.value
        floor = FLOORS[cell.difficulty]
        found.append(
            Goal(
                cell.track,
                cell.difficulty,
                rate,
                max(0.0, reached),
                floor,
                max(0.0, floor - cell.success.value),
                v_max,
                max(0.0, v_max - cell.v_max.value),
            )
        )
    return found


def verdict(found: Sequence[Goal]) -> str:
    """Return in two sentences how many cells meet the goal, and where the most is missing."""
    met = sum(goal.met for goal in found)
    won = sum(goal.success_miss == 0 for goal in found)
    fast = sum(goal.v_max_miss == 0 for goal in found)
    text = (
        f"{met} of {len(found)} cells meet the whole goal: {won} in success against the better of "
        f"paper and baseline, {fast} in v_max against both."
    )
    worst = max(found, key=lambda goal: goal.success_miss)
    slowest = max(found, key=lambda goal: goal.v_max_miss)
    if worst.success_miss:
        text += (
            f" Success misses most on {worst.track} at level {worst.level}, "
            f"by {100 * worst.success_miss:.0f} points;"
        )
    if slowest.v_max_miss:
        text += (
            f" v_max misses most on {slowest.track} at level {slowest.level}, "
            f"by {slowest.v_max_miss:.1f} m/s."
        )
    return text.rstrip(";") + ("" if text.endswith(".") else ".")
