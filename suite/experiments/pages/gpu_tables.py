"""The tables of the page `gpu`: speed of training and judging, and the comparison with the CPU.

A world is one simulated scene and drone of a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from eval.judging.tables import percent
from tracks.common.grid import Grid, table_of

MODELS = {"quadrotor": "quadrotors", "point": "point masses"}
"""Dynamics of the training: key -> name in tables."""
Numbers = Mapping[str, Any]
"""Measured values of one row of a table, by name."""


def trainer_grid(rows: Sequence[Numbers], steps: int, best: float) -> Grid:
    """Return a table of the speed of training, a row per model and number of worlds.

    A row has model, worlds, seconds and operations of a gradient step, which is `steps` decisions
    of a world. `best` is the device's best speed in a matrix product [operations/s].
    """
    return table_of(
        rows,
        ("trains", lambda row: MODELS[row["model"]]),
        ("worlds", lambda row: f"{row['worlds']}"),
        ("decisions/s", lambda row: f"{row['worlds'] * steps / row['seconds']:,.0f}"),
        ("a gradient step [ms]", lambda row: f"{1e3 * row['seconds']:,.0f}"),
        ("TFLOP/s", lambda row: f"{row['operations'] / row['seconds'] / 1e12:.2f}"),
        (
            "share of the largest matrix-product speed",
            lambda row: f"{row['operations'] / row['seconds'] / best:.1%}",
        ),
    )


def judge_grid(rows: Sequence[Numbers]) -> Grid:
    """Return a table of the speed of the judge, a row per number of trials at once."""
    return table_of(
        rows,
        ("trials at once", lambda row: f"{row['worlds']}"),
        ("decisions/s", lambda row: f"{row['decisions_per_s']:,.0f}"),
        ("simulated seconds per second", lambda row: f"{row['flown_s_per_s']:,.0f}"),
        ("all of them [s]", lambda row: f"{row['seconds']:.1f}"),
    )


def pairs_grid(pairs: Mapping[str, Numbers]) -> Grid:
    """Return a table of the trials with the same result on CPU and accelerator.

    It has a row per simulator on the CPU.
    """

    def difference(row: Numbers) -> str:
        return "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * x for x in row["difference"]))

    return table_of(
        [{"name": name, **numbers} for name, numbers in pairs.items()],
        ("compared with", lambda row: row["name"]),
        ("trials", lambda row: f"{row['trials']}"),
        ("the same success", lambda row: f"{row['same_success']}"),
        ("the same ending", lambda row: f"{row['same_ending']}"),
        ("success, GPU minus CPU [points, 95 %]", difference),
    )


def training_grid(short: Numbers) -> Grid:
    """Return a table of one row with the results of the short training."""
    return table_of(
        [short],
        ("worlds", lambda row: f"{row['worlds']}"),
        ("gradient steps", lambda row: f"{row['iterations']}"),
        ("time with compiling [s]", lambda row: f"{row['seconds']:.0f}"),
        ("decisions/s", lambda row: f"{row['decisions_per_s']:,.0f}"),
        ("success (95 %)", lambda row: percent(row["success"])),
        ("v_max, median [m/s]", lambda row: f"{row['v_max']:.1f}" if row["v_max"] else ""),
    )
