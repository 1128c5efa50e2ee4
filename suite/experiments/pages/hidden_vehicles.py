"""Tables of loops on hidden vehicles: success, differences, laps, named effects and errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from eval.judging.tables import percent
from eval.worlds.trial import TrialResult
from suite.diagnose.report.parameters_json import components
from suite.experiments.pages.tables import gap_cell
from suite.experiments.study.intervals import Gap, nested
from suite.loop.compare import BEFORE
from suite.loop.hidden_effect import BOTH, CONTROL, DELTA, LABELS, NAMED, NOMINAL
from suite.loop.work import named_effects
from tracks.common.grid import Cell, Grid, table

ALL = "all"
PAIRS = {
    "named - control": (NAMED, CONTROL),
    "delta - control": (DELTA, CONTROL),
    "both - named": (BOTH, NAMED),
    "control - before": (CONTROL, BEFORE),
    "named - nothing hidden": (NAMED, NOMINAL),
}
"""Which pairs are compared."""


class Came(NamedTuple):
    """What one loop came to."""

    world: str
    training_seed: int
    results: dict[str, list[TrialResult]]
    """By policy; without those that are fine-tuned where nothing was named."""
    diagnosis: dict[str, Any]
    """Verdict, effects and gap."""
    errors: dict[str, float]
    """After 1 s of held-out flights, in position [m], by what flew."""


class Row(NamedTuple):
    """A world, or all of them."""

    world: str
    loops: int
    """Training seeds."""
    named: int
    """Loops in which the diagnosis named something."""
    success: dict[str, Interval]
    """By policy."""
    gaps: dict[str, Gap]
    """In success, by `PAIRS`."""
    laps: dict[str, tuple[float, int]]
    """By policy: median ratio of laps, and over how many trials."""


def rows_of(came: Sequence[Came]) -> list[Row]:
    """Return a row for every world, and one for all."""
    names = list(dict.fromkeys(one.world for one in came))
    every = [(name, [one for one in came if one.world == name]) for name in names]
    return [_row(name, some) for name, some in [*every, (ALL, came)]]


def _row(name: str, came: Sequence[Came]) -> Row:
    success, gaps, laps = {}, {}, {}
    # All policies over the same loops, or where nothing was named would count before only.
    told = [one for one in came if NAMED in one.results] or came
    for policy in LABELS:
        won = [_won(some, policy) for some in _by_seed(told, policy)]
        if won:
            trials = np.concatenate(won)
            success[policy] = wilson(float(trials.sum()), len(trials))
            laps[policy] = _lap_ratio(
                [(one.results[policy], one.results[NOMINAL]) for one in told
                 if policy in one.results]
            )  # fmt: skip
    for pair, (one, other) in PAIRS.items():
        apart = [_won(some, one) - _won(some, other) for some in _by_seed(came, one, other)]
        if apart:
            gaps[pair] = nested(apart)
    named = sum(bool(one.diagnosis["effects"]) for one in came)
    return Row(name, len(came), named, success, gaps, laps)


def _by_seed(came: Sequence[Came], *policies: str) -> list[list[Came]]:
    """Return the loops that have all these policies, those of one training seed together."""
    seeds = dict.fromkeys(loop.training_seed for loop in came)
    found = [
        [c for c in came if c.training_seed == seed and set(policies) <= set(c.results)]
        for seed in seeds
    ]
    return [some for some in found if some]


def _won(came: Sequence[Came], policy: str) -> np.ndarray:
    """Return success (trials,) of one training seed's loops: a trial's mean over their worlds.

    They fly the same trials, and where nothing is hidden the same flights, so that worlds add
    nothing to how many trials there are.
    """
    return np.mean([[row.success for row in one.results[policy]] for one in came], axis=0)


def _lap_ratio(
    pairs: Sequence[tuple[Sequence[TrialResult], Sequence[TrialResult]]],
) -> tuple[float, int]:
    ratios = [
        mine.time_s / theirs.time_s
        for ours, others in pairs
        for mine, theirs in zip(ours, others, strict=True)
        if mine.success and theirs.success
    ]
    return (float(np.median(ratios)) if ratios else float("nan")), len(ratios)


def by_world(rows: Sequence[Row]) -> dict[str, list[Grid]]:
    """Return success, its differences and laps by world, with their headings."""
    later = [policy for policy in LABELS if policy != NOMINAL]
    success = [
        [row.world, *(percent(row.success[p]) if p in row.success else "-" for p in LABELS)]
        for row in rows
    ]
    worth: list[list[str | Cell]] = [
        [row.world, *(gap_cell(row.gaps[p]) if p in row.gaps else "-" for p in PAIRS)]
        for row in rows
    ]
    laps = [
        [row.world, *("{:.3f} ({})".format(*row.laps[p]) if p in row.laps and row.laps[p][1]
                      else "-" for p in later)]
        for row in rows
    ]  # fmt: skip
    return {
        "Success": [table(["hidden", *LABELS.values()], success)],
        "Differences in success": [table(["hidden", *PAIRS], worth)],
        "Laps": [table(["hidden", *(LABELS[policy] for policy in later)], laps)],
    }


def named_grid(came: Sequence[Came], words: Mapping[str, str]) -> Grid:
    """Return what every diagnosis named, next to what is true."""
    lines = []
    for one in came:
        values = [
            f"{effect['name']} {part.label}: {part.shown()[0]}"
            for effect in one.diagnosis["effects"]
            for part in components(effect)
            if part.value is not None
        ]
        gap = ", ".join(
            f"{one.diagnosis['gap'][name]:.2f}" for name in ("before", "after", "noise_floor")
        )
        named = named_effects(one.diagnosis) or "nothing"
        line = [one.world, words[one.world], str(one.training_seed), one.diagnosis["verdict"]]
        lines.append([*line, named, "; ".join(values), gap])
    headers = ["hidden", "what", "training seed", "verdict", "named", "values"]
    return table([*headers, "held-out gap before, after, noise floor"], lines)


def errors_grid(came: Sequence[Came]) -> Grid:
    """Return the Delta Action Models' errors on held-out flights."""
    columns = list(dict.fromkeys(name for one in came for name in one.errors))
    lines = []
    for world in dict.fromkeys(one.world for one in came):
        mine = [one.errors for one in came if one.world == world]
        means = ([errors[c] for errors in mine if c in errors] for c in columns)
        lines.append([world, *(f"{np.mean(some):.3f}" if some else "-" for some in means)])
    return table(["hidden", *columns], lines)
