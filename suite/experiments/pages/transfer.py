"""The tables of `suite reproduce transfer`: trials in the trainer's dynamics and the judge's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import paired_success, wilson
from eval.judging.tables import percent
from eval.worlds.trial import TrialSpec
from suite.experiments.pages.tables import points_cell
from tracks.common.grid import Cell, Grid, table
from tracks.families import JUDGED

POINT = "point mass"
QUADROTOR = "quadrotor"
JUDGE = "judge"
SOURCES = {
    "policy": "it fails in both of the trainer's: what it saw, remembered or planned",
    "dynamics": f"it succeeds in the {POINT} and fails in the {QUADROTOR}: what it does there a "
    "quadrotor does not follow",
    "simulator": f"it succeeds in the trainer's {QUADROTOR}: the judge's steps, contacts, images",
}
"""Where a failed trial comes from, in words."""


class Row(NamedTuple):
    """What a trial came to in each dynamics."""

    trial: TrialSpec
    point: bool
    """Success in the trainer's point mass."""
    quadrotor: bool
    """In its quadrotor."""
    judge: bool
    """Before the judge."""

    @property
    def source(self) -> str | None:
        """A key of `SOURCES`; None for a trial that the judge saw succeed."""
        if self.judge:
            return None
        if self.quadrotor:
            return "simulator"
        return "dynamics" if self.point else "policy"


def overall(rows: Mapping[str, Sequence[Row]]) -> Grid:
    """Return success in each dynamics, and how far it is from that before the judge."""
    headers = ["policy", "flown in", "success", f"minus {JUDGE}"]
    lines: list[list[str | Cell]] = []
    for name, mine in rows.items():
        judged = np.array([row.judge for row in mine])
        for kind, won in columns(mine).items():
            gap: str | Cell = "" if kind == JUDGE else points_cell(paired_success(won, judged))
            lines.append([name, kind, percent(wilson(int(won.sum()), len(won))), gap])
    return table(headers, lines)


def columns(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Return success (N,) bool in each dynamics."""
    return {
        POINT: np.array([row.point for row in rows]),
        QUADROTOR: np.array([row.quadrotor for row in rows]),
        JUDGE: np.array([row.judge for row in rows]),
    }


def cells(rows: Mapping[str, Sequence[Row]]) -> Grid:
    """Return the same for every track and level."""
    headers = ["policy", "track", "level", POINT, QUADROTOR, JUDGE]
    lines = []
    for name, mine in rows.items():
        for track in JUDGED:
            for level in dict.fromkeys(row.trial.difficulty for row in mine):
                cell = [row for row in mine if row.trial[:2] == (track, level)]
                rates = (wilson(int(won.sum()), len(won)) for won in columns(cell).values())
                lines.append([name, track, str(level), *map(percent, rates)])
    return table(headers, lines)


def by_source(rows: Mapping[str, Sequence[Row]]) -> Grid:
    """Return how many trials failed before the judge, by where that comes from."""
    headers = ["policy", "track", "failed", *SOURCES]
    lines = []
    for name, mine in rows.items():
        for track in JUDGED:
            found = [row.source for row in mine if row.trial.track == track and row.source]
            lines.append([name, track, str(len(found)), *(str(found.count(s)) for s in SOURCES)])
    return table(headers, lines)


def source_words() -> str:
    """Return what is said below that table."""
    each = "\n".join(f"- {source}: {words}." for source, words in SOURCES.items())
    return (
        f"Trials that the judge saw fail:\n\n{each}\n\nA near miss ends either way by a hair, so "
        "single trials say less than the rates above: those that the judge saw succeed may fail in "
        "the others, too."
    )


def lead(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return what the page says first."""
    sentences = []
    for name, mine in rows.items():
        rate = {kind: f"{100 * won.mean():.1f} %" for kind, won in columns(mine).items()}
        sources = [row.source for row in mine if row.source]
        parts = ", ".join(f"{sources.count(source)} {source}" for source in SOURCES)
        sentences.append(
            f"{name} succeeds in {rate[POINT]} of the trials in the trainer's {POINT}, in "
            f"{rate[QUADROTOR]} in its {QUADROTOR} and in {rate[JUDGE]} before the {JUDGE}, where "
            f"{len(sources)} fail: {parts}."
        )
    return " ".join(sentences)
