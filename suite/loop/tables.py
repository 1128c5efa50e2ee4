"""Tables and sentences on the policies that a loop compares (`compare.py` computes the numbers).

The loop fine-tunes a policy and compares it with the policy before. "delta" in tables is the Delta
Action Model, a network that corrects actions so that simulated flights match measured ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eval.judging.statistics import Interval, PairedDifference
from suite.loop.compare import CellComparison, Measure, PolicyResult
from tracks.common.grid import Cell, Grid, table

CAVEAT = (
    "Intervals are 95 % over trials, for these three policies: another training seed gives other "
    "policies. The intervals of single rows are not corrected for multiple comparisons."
)
"""Note on the intervals, for the text below the tables."""


def comparison_grids(rows: Sequence[CellComparison]) -> list[Grid]:
    """Return tables of success, gates, mean speed and largest speed, each with a row per cell."""
    return [
        _grid("Success, all gates without a collision [%]", rows, "success", 100, 0),
        _grid("Gates passed, mean", rows, "gates", 1, 2),
        _grid("Mean speed of a trial, median [m/s]", rows, "v_mean", 1, 2),
        _grid("Largest speed of a trial, median [m/s]", rows, "v_max", 1, 2),
    ]


def _grid(
    title: str, rows: Sequence[CellComparison], field: str, scale: float, digits: int
) -> Grid:
    """Return the table of the measure `field`; the table of success has p-values as well.

    Numbers are multiplied by `scale` and have `digits` decimals.
    """
    has_test = field == "success"
    headers = ["track", "level", "trials", "before", "tuned without delta", "tuned with delta"]
    headers += ["with - without", *(["p (McNemar)"] if has_test else []), "with - before"]
    lines = []
    for row in rows:
        measure: Measure = getattr(row, field)
        level = "all" if row.difficulty is None else str(row.difficulty)
        # A measure has three values, then two differences.
        to_control, to_before = (difference_cell(d, scale, digits) for d in measure[3:])
        values = [value_text(interval, scale, digits) for interval in measure[:3]]
        p_value = [f"{row.p_value:.2g}"] if has_test else []
        lines.append([row.track, level, str(row.trials), *values, to_control, *p_value, to_before])
    return table(headers, lines, title, strong_last=True)


def overall_grid(
    results: Sequence[PolicyResult],
    references: Sequence[str],
    labels: Mapping[str, str],
    trials: int,
) -> Grid:
    """Return the table over all trials, a row per policy: success, differences, gates and speed.

    Args:
        results: results of the policies.
        references: names of the policies with which the others are compared, two columns each.
        labels: label of each policy in the table.
        trials: number of trials of each policy.
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


def verdict(overall: CellComparison) -> str:
    """Return a sentence on the effect of fine-tuning with the Delta Action Model."""
    success = overall.success
    return (
        f"Fine-tuned with the Delta Action Model, {100 * success.with_delta.value:.0f} % of "
        f"{overall.trials} trials succeed: {significance(success.with_minus_without)} the same "
        f"fine-tuning without it ({100 * success.without.value:.0f} %; "
        f"difference {points(success.with_minus_without)}); before, "
        f"{100 * success.before.value:.0f} %."
    )
