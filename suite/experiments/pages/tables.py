"""Tables that several documents have, and the cells of all."""

from __future__ import annotations

from collections.abc import Sequence

from eval.judging.statistics import Interval, PairedDifference, paired_success
from eval.judging.tables import Tally, grids, percent
from suite.experiments.study.disturbed import Tested
from suite.experiments.study.intervals import Gap
from tracks.common.grid import Cell, Grid, table


def points_cell(difference: PairedDifference | Interval) -> Cell:
    """Return a difference of success rates in points with its interval, coloured by its sign."""
    value, low, high = (f"{round(100 * x) + 0.0:+.0f}" for x in difference[:3])
    tone = "good" if difference.low > 0 else "bad" if difference.high < 0 else ""
    return Cell(f"{value} [{low}, {high}]", tone)


def gap_cell(gap: Gap) -> Cell:
    """Return a difference as `points_cell` does, and in brackets each training seed's own."""
    cell = points_cell(gap.difference)
    each = " ".join(f"{round(100 * seed) + 0.0:+.0f}" for seed in gap.of_seeds)
    return Cell(f"{cell.text} ({each})", cell.tone)


def condition_grid(
    entries: Sequence[Tested], base: Tested, first: Sequence[str], title: str = ""
) -> Grid:
    """Return success and change under each of `entries`, a row each.

    Args:
        entries: conditions; their other policies are compared with the first.
        base: the undisturbed one.
        first: headers of what names a row: the size, or the name and the size.
        title: of the table.
    """
    headers, names = list(first), list(base.results)
    for name in names:
        mine = f"{name}: " if len(names) > 1 else ""
        headers += [f"{mine}success", f"{mine}change"]
    headers += [f"{name} - {names[0]}" for name in names[1:]]
    plain = (base.condition.vehicle, base.condition.sensors)
    lines = []
    for entry in entries:
        line: list[str | Cell] = [*(entry.condition.name, entry.condition.words)[-len(first) :]]
        same = entry.condition.vehicle is plain[0] and entry.condition.sensors == plain[1]
        for name in names:
            change = paired_success(entry.won(name), base.won(name))
            line += [percent(entry.success(name)), "" if same else points_cell(change)]
        mine = entry.won(names[0])
        line += [points_cell(paired_success(entry.won(name), mine)) for name in names[1:]]
        lines.append(line)
    return table(headers, lines, title)


def every_cell(cells: Sequence[Tally]) -> list[Grid]:
    """Return all numbers of judged cells."""
    return grids({"cells": cells, "paired": []})
