"""Any number of policies on the same trials, each compared with named others."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, bootstrap_mean, bootstrap_median, paired_success
from eval.worlds.trial import TrialResult
from suite.loop.compare import difference_cell, rate, same_trials, value_text
from tracks.common.grid import Cell, Grid, table


class Difference(NamedTuple):
    """One policy's success minus another's on the same trials."""

    against: str
    """The other's name."""
    success: Interval
    """Newcombe's paired interval."""
    p_value: float
    """Exact McNemar test, two-sided."""


class Standing(NamedTuple):
    """The results of one policy."""

    name: str
    success: Interval
    """Rate, Wilson."""
    by_cell: dict[str, Interval]
    """The same on every track and level, as "zigzag 3"."""
    gates: Interval
    """Mean number of gates passed, bootstrap."""
    v_mean: Interval
    """Median over trials [m/s], bootstrap."""
    differences: list[Difference]
    """Against each reference but itself."""


def standings(
    results: Mapping[str, Sequence[TrialResult]], references: Sequence[str]
) -> list[Standing]:
    """Return a standing for every policy, in the order of `results`.

    Args:
        results: by policy, of the same trials in the same order.
        references: policies that the others are compared with.

    Raises:
        ValueError: if the trials differ.
    """
    trials = same_trials(results)
    won = {name: np.array([row.success for row in rows]) for name, rows in results.items()}
    inside = {
        f"{track} {level}": [trial[:2] == (track, level) for trial in trials]
        for track, level in dict.fromkeys(trial[:2] for trial in trials)
    }
    found = []
    for name, rows in results.items():
        seed = zlib.crc32(name.encode())
        apart = {other: paired_success(won[name], won[other]) for other in references}
        found.append(
            Standing(
                name=name,
                success=rate(won[name]),
                by_cell={cell: rate(won[name][chosen]) for cell, chosen in inside.items()},
                gates=bootstrap_mean(np.array([row.gates_passed for row in rows]), seed),
                v_mean=bootstrap_median(np.array([row.v_mean for row in rows]), seed),
                differences=[
                    Difference(other, Interval(*pair[:3]), pair.p_value)
                    for other, pair in apart.items()
                    if other != name
                ],
            )
        )
    return found


def overall_grid(
    found: Sequence[Standing], references: Sequence[str], labels: Mapping[str, str], trials: int
) -> Grid:
    """Return a row a policy: success, its differences, gates and speed."""
    headers = ["policy", "success [%]"]
    for other in references:
        headers += [f"minus {labels[other]}", "p"]
    rows = []
    for one in found:
        row: list[str | Cell] = [labels[one.name], value_text(one.success, 100, 0)]
        apart = {difference.against: difference for difference in one.differences}
        for other in references:
            less = apart.get(other)
            row += [difference_cell(less.success), f"{less.p_value:.2g}"] if less else ["", ""]
        rows.append([*row, *(value_text(value, 1, 2) for value in (one.gates, one.v_mean))])
    headers += ["gates passed, mean", "mean speed, median [m/s]"]
    return table(headers, rows, f"Over {trials} trials of each policy")


def cell_grid(found: Sequence[Standing], labels: Mapping[str, str]) -> Grid:
    """Return a row a track and level, a column a policy: success."""
    headers = ["track and level", *(labels[one.name] for one in found)]
    rows = [
        [cell, *(value_text(one.by_cell[cell], 100, 0) for one in found)]
        for cell in found[0].by_cell
    ]
    return table(headers, rows, "Success by track and level [%]")
