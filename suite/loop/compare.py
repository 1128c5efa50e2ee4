"""Compare the policies that a loop judged on the same trials: numbers, tables and sentences."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import (
    Interval,
    PairedDifference,
    bootstrap,
    paired_success,
    wilson,
)
from eval.judging.tables import percent, with_interval
from eval.worlds.trial import TrialResult
from tracks.common.grid import Cell, Grid, table

BEFORE = "before"
"""Name of the policy before fine-tuning, which every loop has."""
CAVEAT = (
    "Intervals are 95 % over trials, for these policies: another training seed gives other "
    "policies. Differences are paired by trial. The intervals of single rows are not corrected for "
    "multiple comparisons."
)
"""Note on the intervals, for the text below the tables."""


class Difference(NamedTuple):
    """Difference of the success rates of two policies on the same trials."""

    against: str
    """Name of the policy whose rate is subtracted."""
    success: Interval
    """The difference with Newcombe's paired interval."""
    p_value: float
    """p-value of the difference."""


class PolicyResult(NamedTuple):
    """The results of one policy."""

    name: str
    success: Interval
    """Success rate over all trials, with Wilson's interval."""
    by_cell: dict[str, Interval]
    """Success rate in each cell, by track and level such as "zigzag 3"."""
    gates: Interval
    """Mean number of passed gates, with a bootstrap interval."""
    v_mean: Interval
    """Median over trials of the mean speed, with a bootstrap interval [m/s]."""
    differences: list[Difference]
    """Differences to each reference policy, without the policy itself."""


def policy_results(
    results: Mapping[str, Sequence[TrialResult]], references: Sequence[str]
) -> list[PolicyResult]:
    """Return the results of every policy, in the order of `results`.

    All policies have the same trials in the same order. The others are compared with the
    `references`.

    Raises:
        ValueError: if the trials differ.
    """
    first, *others = results
    trials = [row.trial for row in results[first]]
    for name in others:
        if [row.trial for row in results[name]] != trials:
            raise ValueError(f"{name!r} and {first!r} were not flown on the same trials")
    # Cell (track, level) -> indices of its trials.
    cells: dict[tuple[str, int], list[int]] = {}
    for index, trial in enumerate(trials):
        cells.setdefault((trial.track, trial.difficulty), []).append(index)
    successes = {name: np.array([row.success for row in rows]) for name, rows in results.items()}
    summaries = []
    for name, rows in results.items():
        # The seed of the bootstrap: the same numbers on every machine.
        seed, success = zlib.crc32(name.encode()), successes[name]
        pairs = [(r, paired_success(success, successes[r])) for r in references if r != name]
        summaries.append(
            PolicyResult(
                name=name,
                success=success_rate(success),
                by_cell={
                    f"{track} {level}": success_rate(success[indices])
                    for (track, level), indices in cells.items()
                },
                gates=bootstrap(np.array([row.gates_passed for row in rows]), seed, np.mean),
                v_mean=bootstrap(np.array([row.v_mean for row in rows]), seed),
                differences=[
                    Difference(reference, Interval(*pair[:3]), pair.p_value)
                    for reference, pair in pairs
                ],
            )
        )
    return summaries


def success_rate(success: np.ndarray) -> Interval:
    """Return the share of true values with Wilson's interval."""
    return wilson(int(success.sum()), len(success))


def overall_grid(
    results: Sequence[PolicyResult],
    references: Sequence[str],
    labels: Mapping[str, str],
    trials: int,
) -> Grid:
    """Return the table over all trials, a row per policy: success, differences, gates and speed.

    Each of the `references` has a column, in which the others are compared with it.
    """
    headers = ["policy", "success", *(f"minus {labels[reference]}" for reference in references)]
    rows = []
    for result in results:
        row: list[str | Cell] = [labels[result.name], percent(result.success)]
        differences = {difference.against: difference for difference in result.differences}
        for reference in references:
            difference = differences.get(reference)
            row.append(difference_cell(difference.success) if difference else "")
        rows.append([*row, *(with_interval(value) for value in (result.gates, result.v_mean))])
    headers += ["gates passed, mean", "mean speed, median [m/s]"]
    return table(headers, rows, f"Over {trials} trials of each policy")


def cell_grid(results: Sequence[PolicyResult], labels: Mapping[str, str]) -> Grid:
    """Return the table of success rates, with a row per track and level and a column per policy."""
    headers = ["track and level", *(labels[result.name] for result in results)]
    rows = [
        [cell, *(percent(result.by_cell[cell]) for result in results)]
        for cell in results[0].by_cell
    ]
    return table(headers, rows, "Success by track and level")


def difference_cell(interval: Interval | PairedDifference) -> Cell:
    """Return a difference of rates with its sign and interval, in percentage points.

    It is coloured if the interval excludes zero. A narrow interval, and one with an end that would
    be rounded to zero, has a decimal place.
    """
    ends = 100 * interval.low, 100 * interval.high
    digits = int(ends[1] - ends[0] < 3.0 or 0.0 in [round(end, 0) for end in ends])
    # Adding zero turns a rounded -0 into +0.
    value, low, high = (f"{round(100 * x, digits) + 0.0:+.{digits}f}" for x in interval[:3])
    tone = "good" if interval.low > 0 else "bad" if interval.high < 0 else ""
    return Cell(f"{value} [{low}, {high}]", tone)


def significance(difference: Interval, above: str = "more than", below: str = "fewer than") -> str:
    """Return how a sentence names a difference, by its interval.

    It is `above` or `below` if the interval excludes zero, else "not significantly different from".
    """
    if difference.low > 0:
        return above
    return below if difference.high < 0 else "not significantly different from"


def points(difference: Interval) -> str:
    """Return a difference of success rates with its interval, in percentage points."""
    value, interval = difference_cell(difference).text.split(" ", 1)
    return f"{value} points {interval}"
