"""Tables for people and summary.json's numbers: one cell a policy, track and level."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eval.judging.statistics import (
    Interval,
    bootstrap_median,
    paired_bootstrap,
    paired_success,
    wilson,
)
from eval.worlds.trial import ENDINGS, TrialResult

if TYPE_CHECKING:
    from rich.table import Table

NOTE = (
    "Success: rate with its 95 % Wilson interval. v_max, v_mean, lap: median over the cell's "
    "trials (lap: over its finished ones) with its 95 % bootstrap interval; v_max is each trial's "
    "largest speed before any contact."
)
"""What stands under every table."""
HEADERS = (
    "policy",
    "track",
    "level",
    "trials",
    "success",
    "gates",
    "v_max [m/s]",
    "v_mean [m/s]",
    "lap [s]",
    "ended otherwise by",
)


class Cell(NamedTuple):
    """What the trials of one policy on one track at one level come to."""

    policy: str
    track: str
    difficulty: int
    trials: int
    success: Interval
    gates_passed: float
    """Mean number of gates."""
    v_max: Interval
    """Median over trials [m/s]."""
    v_mean: Interval
    """Median over trials [m/s]."""
    lap_s: Interval
    """Median over finished trials [s]; NaN where there is none."""
    ended_by: dict[str, int]
    """How many trials ended how."""


class Pairing(NamedTuple):
    """How much a policy differs from the first one on the same trials."""

    policy: str
    against: str
    track: str
    difficulty: int
    trials: int
    success: Interval
    """Difference of success rates."""
    p_value: float
    """Exact McNemar test, two-sided."""
    v_mean: Interval
    """Median difference of mean speeds [m/s]."""


def summarise(results: Sequence[TrialResult]) -> dict[str, Any]:
    """Return the cells, and the pairings with the first policy where there are several.

    The keys are `cells` and `paired`, lists of `Cell` and `Pairing` in order of appearance.
    """
    groups: dict[tuple[str, str, int], list[TrialResult]] = {}
    for result in results:
        groups.setdefault((result.policy, result.track, result.difficulty), []).append(result)
    cells = [_cell(*key, rows) for key, rows in groups.items()]
    policies = list(dict.fromkeys(result.policy for result in results))
    paired = []
    for (policy, track, difficulty), rows in groups.items():
        against = groups.get((policies[0], track, difficulty), [])
        if policy != policies[0]:
            pairing = _pairing(policy, policies[0], track, difficulty, rows, against)
            paired += [pairing] if pairing else []
    return {"cells": cells, "paired": paired}


def _seed(*key: object) -> int:
    """Return a bootstrap seed that a cell keeps whatever else is in the table."""
    return zlib.crc32(repr(key).encode())


def _cell(policy: str, track: str, difficulty: int, rows: list[TrialResult]) -> Cell:
    seed = _seed(track, difficulty)

    def median(values: list[float]) -> Interval:
        return bootstrap_median(np.array(values), seed)

    return Cell(
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
    )


def _pairing(
    policy: str,
    against: str,
    track: str,
    difficulty: int,
    rows: list[TrialResult],
    others: list[TrialResult],
) -> Pairing | None:
    by_trial = {other.trial: other for other in others}
    pairs = [(row, by_trial[row.trial]) for row in rows if row.trial in by_trial]
    if not pairs:
        return None
    first, second = zip(*pairs, strict=True)
    success = paired_success(
        np.array([row.success for row in first]), np.array([row.success for row in second])
    )
    speed = paired_bootstrap(
        np.array([row.v_mean for row in first]),
        np.array([row.v_mean for row in second]),
        _seed(track, difficulty),
    )
    interval = Interval(success.value, success.low, success.high)
    return Pairing(policy, against, track, difficulty, len(pairs), interval, success.p_value, speed)


def percent(interval: Interval) -> str:
    """Return a rate with its interval: "94 % [88, 97]"."""
    value, low, high = (100 * x for x in interval)
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"


def _number(interval: Interval) -> str:
    if np.isnan(interval.value):
        return "-"
    return f"{interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def _rows(cells: Sequence[Cell]) -> list[tuple[str, ...]]:
    rows = []
    for cell in cells:
        ended = [f"{how} {n}" for how, n in cell.ended_by.items() if how != "finished"]
        rows.append(
            (
                cell.policy,
                cell.track,
                str(cell.difficulty),
                str(cell.trials),
                percent(cell.success),
                f"{cell.gates_passed:.1f}",
                _number(cell.v_max),
                _number(cell.v_mean),
                _number(cell.lap_s),
                ", ".join(ended) or "-",
            )
        )
    return rows


_PAIR_HEADERS = ("difference", "track", "level", "pairs", "success", "p (McNemar)", "v_mean [m/s]")


def _pair_rows(paired: Sequence[Pairing]) -> list[tuple[str, ...]]:
    def points(interval: Interval) -> str:
        value, low, high = (100 * x for x in interval)
        return f"{value:+.0f} [{low:+.0f}, {high:+.0f}] points"

    return [
        (
            f"{pair.policy} - {pair.against}",
            pair.track,
            str(pair.difficulty),
            str(pair.trials),
            points(pair.success),
            f"{pair.p_value:.3g}",
            f"{pair.v_mean.value:+.2f} [{pair.v_mean.low:+.2f}, {pair.v_mean.high:+.2f}]",
        )
        for pair in paired
    ]


def markdown_table(summary: dict[str, Any]) -> str:
    """Return what `summarise` gave as Markdown."""

    def table(headers: Sequence[str], rows: list[tuple[str, ...]]) -> str:
        lines = [headers, ["---"] * len(headers), *rows]
        return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in r) + " |" for r in lines)

    parts = [table(HEADERS, _rows(summary["cells"])), NOTE]
    if summary["paired"]:
        parts += [
            table(_PAIR_HEADERS, _pair_rows(summary["paired"])),
            "Differences are on the same trials; success: Newcombe's paired interval.",
        ]
    return "\n\n".join(parts) + "\n"


def rich_tables(summary: dict[str, Any]) -> list[Table]:
    """Return what `summarise` gave as tables for a terminal, the note as caption."""
    from rich.table import Table

    def table(headers: Sequence[str], rows: list[tuple[str, ...]], caption: str) -> Table:
        made = Table(*headers, caption=caption, caption_justify="left")
        for row in rows:
            made.add_row(*row)
        return made

    tables = [table(HEADERS, _rows(summary["cells"]), NOTE)]
    if summary["paired"]:
        tables.append(
            table(
                _PAIR_HEADERS, _pair_rows(summary["paired"]), "Differences are on the same trials."
            )
        )
    return tables
