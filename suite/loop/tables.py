"""Tables and sentences on the policies that a loop compares (`compare.py` computes the numbers).

The loop fine-tunes a policy and compares it with the policy before. "delta" in tables is the Delta
Action Model, a network that corrects actions so that simulated flights match measured ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eval.judging.statistics import Interval, PairedDifference
from suite.loop.compare import PolicyResult
from tracks.common.grid import Cell, Grid, table

CAVEAT = (
    "Intervals are 95 % over trials, for these policies: another training seed gives other "
    "policies. Differences are paired by trial. The intervals of single rows are not corrected for "
    "multiple comparisons."
)
"""Note on the intervals, for the text below the tables."""


def overall_grid(
    results: Sequence[PolicyResult],
    references: Sequence[str],
    labels: Mapping[str, str],
    trials: int,
) -> Grid:
    """Return the table over all trials, a row per policy: success, differences, gates and speed.

    Each of the `references` has two columns, in which the others are compared with it.
    """
    headers = ["policy", "success [%]"]
    for reference in references:
        headers += [f"minus {labels[reference]}", "p"]
    rows = []
    for result in results:
        row: list[str | Cell] = [labels[result.name], value_text(result.success, 100, 0)]
        differences = {difference.against: difference for difference in result.differences}
        for reference in references:
            difference = differences.get(reference)
            if difference:
                row += [difference_cell(difference.success), f"{difference.p_value:.2g}"]
            else:
                row += ["", ""]
        rows.append([*row, *(value_text(value, 1, 2) for value in (result.gates, result.v_mean))])
    headers += ["gates passed, mean", "mean speed, median [m/s]"]
    return table(headers, rows, f"Over {trials} trials of each policy")


def cell_grid(results: Sequence[PolicyResult], labels: Mapping[str, str]) -> Grid:
    """Return the table of success rates, with a row per track and level and a column per policy."""
    headers = ["track and level", *(labels[result.name] for result in results)]
    rows = [
        [cell, *(value_text(result.by_cell[cell], 100, 0) for result in results)]
        for cell in results[0].by_cell
    ]
    return table(headers, rows, "Success by track and level [%]")


def value_text(interval: Interval, scale: float, digits: int) -> str:
    """Return a number with its interval for a table; both are multiplied by `scale`."""
    value, low, high = (f"{scale * x:.{digits}f}" for x in interval)
    return f"{value} [{low}, {high}]"


def difference_cell(
    interval: Interval | PairedDifference, scale: float = 100, digits: int = 0
) -> Cell:
    """Return a difference with its sign and interval, coloured if the interval excludes zero.

    By default it is a difference of rates, written in percentage points.
    """
    # Adding zero turns a rounded -0 into +0.
    value, low, high = (f"{round(scale * x, digits) + 0.0:+.{digits}f}" for x in interval[:3])
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
