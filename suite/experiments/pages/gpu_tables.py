"""The tables of what an accelerator reaches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from eval.judging.tables import percent
from tracks.common.grid import Grid, table

MODELS = {"quadrotor": "quadrotors", "point": "point masses"}
"""What trains, by key."""


def trainer_grid(rows: Sequence[Mapping[str, Any]], steps: int, best: float) -> Grid:
    """Return the trainer's speed: a row a model and number of worlds.

    Args:
        rows: model, worlds, seconds and operations of a gradient step.
        steps: decisions of a world in it.
        best: operations a second of a product of matrices.
    """
    lines = [
        (
            MODELS[row["model"]],
            f"{row['worlds']}",
            f"{row['worlds'] * steps / row['seconds']:,.0f}",
            f"{1e3 * row['seconds']:,.0f}",
            f"{row['operations'] / row['seconds'] / 1e12:.2f}",
            f"{row['operations'] / row['seconds'] / best:.1%}",
        )
        for row in rows
    ]
    headers = (
        *("trains", "worlds", "decisions/s", "a gradient step [ms]", "TFLOP/s"),
        "share of the product's",
    )
    return table(headers, lines)


def judge_grid(judged: Sequence[Mapping[str, Any]]) -> Grid:
    """Return the judge's speed, a row a number of trials at once."""
    lines = [
        (
            f"{row['worlds']}",
            f"{row['decisions_per_s']:,.0f}",
            f"{row['flown_s_per_s']:,.0f}",
            f"{row['seconds']:.1f}",
        )
        for row in judged
    ]
    headers = ("trials at once", "decisions/s", "seconds flown a second", "all of them [s]")
    return table(headers, lines)


def pairs_grid(pairs: Mapping[str, Mapping[str, Any]]) -> Grid:
    """Return how alike trials end on the accelerator and on the CPU, a row a simulator."""
    lines = [
        (
            name,
            f"{found['trials']}",
            f"{found['same_success']}",
            f"{found['same_ending']}",
            "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * x for x in found["difference"])),
        )
        for name, found in pairs.items()
    ]
    headers = (
        *("compared with", "trials", "the same success", "the same ending"),
        "success here minus there [points, 95 %]",
    )
    return table(headers, lines)


def training_grid(short: Mapping[str, Any]) -> Grid:
    """Return what the short training came to, in one row."""
    line = (
        f"{short['worlds']}",
        f"{short['iterations']}",
        f"{short['seconds']:.0f}",
        f"{short['decisions_per_s']:,.0f}",
        percent(short["success"]),
        "" if short["v_max"] is None else f"{short['v_max']:.1f}",
    )
    headers = (
        *("worlds", "gradient steps", "time with compiling [s]", "decisions/s"),
        *("success (95 %)", "v_max, median [m/s]"),
    )
    return table(headers, [line])
