"""Compute the numbers of summary.json, and print them as tables."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import (
    Interval,
    bootstrap,
    expected_largest,
    paired_success,
    wilson,
)
from eval.worlds.trial import ENDINGS, TrialResult
from tracks.common.grid import Grid, markdown, table_of

PRINTED_TRIALS = 10
"""Number of trials of a cell in the published tables with which results are compared."""
NOTE = (
    "Success: rate with its 95 % Wilson interval. v_max, v_mean, lap: median over the cell's "
    "trials (lap: over its finished ones), from six on with a 95 % bootstrap interval; v_max is "
    "each trial's largest speed before any contact."
)
"""Note below every table."""
PAIR_NOTE = "Differences are on the same trials; success: Newcombe's paired interval."
"""Note below the table of differences."""


class Tally(NamedTuple):
    """The results of one cell: a policy on one track family at one level."""

    policy: str
    track: str
    difficulty: int
    trials: int
    success: Interval
    gates_passed: float
    """Mean number of passed gates."""
    v_max: Interval
    """Largest speed of a trial, median over trials [m/s]."""
    v_mean: Interval
    """Mean speed of a trial, median over trials [m/s]."""
    lap_s: Interval
    """Median lap time over finished trials [s]; NaN where there is none. The ends of intervals of
    fewer than six values are NaN."""
    ended_by: dict[str, int]
    """Ending -> number of trials with it."""
    late: int = 0
    """Number of timeouts because the policy's output was late or missing."""
    v_max_of_ten: float | None = None
    """Expected largest v_max of ten random trials [m/s]; None with fewer trials."""


class Pairing(NamedTuple):
    """The differences between a policy and the first policy (`against`) on the same trials."""

    policy: str
    against: str
    track: str
    difficulty: int
    trials: int
    success: Interval
    """Difference of success rates."""
    p_value: float
    """Two-sided p-value of the exact McNemar test."""
    v_mean: Interval
    """Median difference of mean speeds [m/s]."""


def summarise(results: Sequence[TrialResult]) -> dict[str, Any]:
    """Return the results by cell, and the differences from the first policy.

    The keys of the result are `cells`, a list of `Tally`, and `paired`, a list of `Pairing` (empty
    for one policy), both in order of appearance.
    """
    groups: dict[tuple[str, str, int], list[TrialResult]] = {}
    for result in results:
        groups.setdefault((result.policy, result.track, result.difficulty), []).append(result)
    cells = [_cell(*key, rows) for key, rows in groups.items()]
    paired = []
    for (policy, track, level), rows in groups.items():
        first = results[0].policy
        others = {other.trial: other for other in groups.get((first, track, level), [])}
        pairs = [(row, others[row.trial]) for row in rows if row.trial in others]
        if policy != first and pairs:
            paired.append(_pairing(*zip(*pairs, strict=True)))
    return {"cells": cells, "paired": paired}


def _seed(*key: object) -> int:
    """Return the bootstrap seed of a cell, which does not depend on the other cells."""
    return zlib.crc32(repr(key).encode())


def _cell(policy: str, track: str, difficulty: int, rows: list[TrialResult]) -> Tally:
    """Return the results of a cell with the trials `rows`."""
    seed = _seed(track, difficulty)

    def median(values: list[float]) -> Interval:
        return bootstrap(np.array(values), seed)

    return Tally(
        policy,
        track,
        difficulty,
        len(rows),
        wilson(sum(row.success for row in rows), len(rows)),
        float(np.mean([row.gates_passed for row in rows])),
        median([row.v_max for row in rows]),
        median([row.v_mean for row in rows]),
        median([row.time_s for row in rows if row.success]),
        {how: n for how in ENDINGS if (n := sum(row.ended_by == how for row in rows))},
        sum(row.late_actions for row in rows),
        expected_largest(np.array([row.v_max for row in rows]), PRINTED_TRIALS),
    )


def _pairing(rows: Sequence[TrialResult], others: Sequence[TrialResult]) -> Pairing:
    """Return the differences of a cell's `rows` from another policy's, on the same trials."""
    policy, against, track, level = rows[0].policy, others[0].policy, *rows[0].trial[:2]
    success = paired_success(*(np.array([row.success for row in each]) for each in (rows, others)))
    faster = [row.v_mean - other.v_mean for row, other in zip(rows, others, strict=True)]
    speed = bootstrap(np.array(faster), _seed(track, level))
    interval = Interval(*success[:3])
    return Pairing(policy, against, track, level, len(rows), interval, success.p_value, speed)


def rate_text(rate: float, digits: int = 0) -> str:
    """Return a rate in per cent, with more decimal places where it would be rounded to 0 or 100."""
    while rate not in (0.0, 1.0) and round(100 * rate, digits) in (0.0, 100.0):
        digits += 1
    return f"{100 * rate:.{digits}f}"


def percent(interval: Interval) -> str:
    """Return a rate with its interval: "94 % [88, 97]", "99.7 % [98, 100]".

    The ends have decimal places where the rounded interval would not contain the rate.
    """
    value, (low, high) = rate_text(interval.value), (100 * x for x in interval[1:])
    contains = round(low) <= float(value) <= round(high)
    digits = 0 if contains else len(value.partition(".")[2])
    return f"{value} % [{low:.{digits}f}, {high:.{digits}f}]"


def with_interval(interval: Interval, scale: float = 1.0, form: str = ".2f") -> str:
    """Return a number with its interval, times `scale`: "6.55 [6.31, 6.70]".

    Without an interval it is "6.55", and "-" without a number.
    """
    if np.isnan(interval.value):
        return "-"
    value, low, high = (f"{scale * x:{form}}" for x in interval)
    return value if np.isnan(interval.low) else f"{value} [{low}, {high}]"


def grids(summary: dict[str, Any]) -> list[Grid]:
    """Return the result of `summarise` as tables: the cells, and the differences if any."""
    tables = [_cell_grid(summary["cells"])]
    if summary["paired"]:
        tables.append(_pair_grid(summary["paired"]))
    return tables


def markdown_table(summary: dict[str, Any]) -> str:
    """Return the result of `summarise` as Markdown."""
    return "\n".join(map(markdown, grids(summary)))


def _cell_grid(cells: Sequence[Tally]) -> Grid:
    """Return a table with a line for each cell."""
    return table_of(
        cells,
        ("policy", lambda cell: cell.policy),
        ("track", lambda cell: cell.track),
        ("level", lambda cell: str(cell.difficulty)),
        ("trials", lambda cell: str(cell.trials)),
        ("success", lambda cell: percent(cell.success)),
        ("gates", lambda cell: f"{cell.gates_passed:.1f}"),
        ("v_max [m/s]", lambda cell: with_interval(cell.v_max)),
        ("v_mean [m/s]", lambda cell: with_interval(cell.v_mean)),
        ("lap [s]", lambda cell: with_interval(cell.lap_s)),
        ("ended otherwise by", _other_endings),
        note=NOTE,
    )


def _other_endings(cell: Tally) -> str:
    ended = [f"{how} {n}" for how, n in cell.ended_by.items() if how != "finished"]
    ended += [f"of these {cell.late} by a late or missing answer"] if cell.late else []
    return ", ".join(ended) or "-"


def _pair_grid(paired: Sequence[Pairing]) -> Grid:
    """Return a table of the differences from the first policy."""
    return table_of(
        paired,
        ("difference", lambda pair: f"{pair.policy} - {pair.against}"),
        ("track", lambda pair: pair.track),
        ("level", lambda pair: str(pair.difficulty)),
        ("pairs", lambda pair: str(pair.trials)),
        ("success", lambda pair: f"{with_interval(pair.success, 100, '+.1f')} points"),
        ("p (McNemar)", lambda pair: f"{pair.p_value:.3g}"),
        ("v_mean [m/s]", lambda pair: with_interval(pair.v_mean, form="+.2f")),
        note=PAIR_NOTE,
    )
