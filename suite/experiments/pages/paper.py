"""What the paper prints, read from paper.toml."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path
from typing import Any, NamedTuple


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
        """Return every method's cell on one track at one level."""
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
    table = _table("ablation")
    return table["source"], {key: Ablated(**row) for key, row in table["rows"].items()}


@functools.cache
def sim_to_sim() -> SimToSim:
    """Return the table "Sim-to-sim Performance"."""
    table = _table("sim_to_sim")
    names = {key: method["name"] for key, method in table["methods"].items()}
    cells = [
        Printed(key, track, level, won, table["trials"], v_max)
        for key, method in table["methods"].items()
        for track, rows in method.items()
        if track != "name"
        for level, won, v_max in zip(table["levels"], rows["won"], rows["v_max"], strict=True)
    ]
    return SimToSim(table["source"], tuple(table["levels"]), names, tuple(cells))
