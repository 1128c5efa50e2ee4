"""What the page on hidden worlds shows: success, what it is worth, laps, names and errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from eval.judging.tables import percent
from eval.worlds.trial import TrialResult
from suite.diagnose.report.parameters_json import components
from suite.experiments.pages.tables import gap_cell, points_cell
from suite.experiments.study.intervals import WHAT_COUNTS, Gap, nested
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
"""What is held against what."""
HOW = (
    "Every policy is fine-tuned from the same one, for as many gradient steps on the same tracks. "
    "Control: through the simulation's quadrotor as it is; with delta: through it with a Delta "
    "Action Model of the flights; with the named effect: through the quadrotor that the diagnosis "
    "corrected from the same flights; with both: through that with a Delta Action Model of what it "
    "still lacks. All randomise their quadrotor as the recipe does. The first column flies the "
    "simulation's vehicle, all others the hidden world.",
    "Success over the training seeds from which something was named, [95 % Wilson intervals]; over "
    "all worlds each trial counts once, with its mean, as all worlds fly the same.",
)
WORTH = (
    "Differences in points over the same trials, with 95 % bootstrap intervals that draw training "
    "seeds anew and the trials of each; in brackets each training seed's own. Not corrected for "
    f"there being several. {WHAT_COUNTS} A loop whose diagnosis names nothing has no fine-tuned "
    "policies, and counts in none."
)
LAPS = (
    "Lap over that of the policy where nothing is hidden on the same trial, median over the "
    "trials that both finish; how many these are."
)
ERRORS = (
    "Held-out flights as measured, flown again for 1 s: error in position [m], mean over the "
    "training seeds. The noise of the start is in every number. The diagnosis, which corrected the "
    "quadrotor, has seen some of these flights; no Delta Action Model has."
)


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


def lead(rows: Sequence[Row]) -> str:
    """Return in sentences what was lost and what gives it back."""
    *worlds, over = rows

    def rate(policy: str) -> str:
        found = over.success.get(policy)
        return "-" if found is None else f"{100 * found.value:.0f} %"

    told = "There" if over.named in (0, over.loops) else "In those"
    text = (
        f"Hidden worlds: {len(worlds)}, loops: {over.loops}. The diagnosis names something in "
        f"{over.named} of {over.loops}. {told} {rate(BEFORE)} succeed, of {rate(NOMINAL)} where "
        "nothing is hidden."
    )
    if NAMED not in over.success:
        return text

    def apart(pair: str) -> str:
        return f"{points_cell(over.gaps[pair].difference).text} points"

    text += (
        f" Fine-tuned with what it names {rate(NAMED)} succeed, with a Delta Action Model "
        f"{rate(DELTA)}, with both {rate(BOTH)}, and as the control {rate(CONTROL)}: the named "
        f"effect is worth {apart('named - control')}, the Delta Action Model "
        f"{apart('delta - control')}, and on top of the named effect {apart('both - named')}."
    )
    for pair, words in (
        ("named - control", "The named effect gains"),
        ("delta - control", "The Delta Action Model gains"),
    ):
        told = {
            verdict: [row.world for row in worlds
                      if pair in row.gaps and row.gaps[pair].verdict == verdict]
            for verdict in ("gain", "loss")
        }  # fmt: skip
        text += f" {words} in: {', '.join(told['gain']) or 'none'}"
        text += f"; loses in: {', '.join(told['loss'])}." if told["loss"] else "."
    return text


def success_grid(rows: Sequence[Row]) -> Grid:
    """Return success by world and policy."""
    lines = [
        [row.world, *(percent(row.success[p]) if p in row.success else "-" for p in LABELS)]
        for row in rows
    ]
    return table(["hidden", *LABELS.values()], lines)


def worth_grid(rows: Sequence[Row]) -> Grid:
    """Return differences by world."""
    lines: list[list[str | Cell]] = []
    for row in rows:
        line: list[str | Cell] = [row.world]
        line += [gap_cell(row.gaps[pair]) if pair in row.gaps else "-" for pair in PAIRS]
        lines.append(line)
    return table(["hidden", *PAIRS], lines)


def lap_grid(rows: Sequence[Row]) -> Grid:
    """Return laps by world and policy."""
    later = [policy for policy in LABELS if policy != NOMINAL]
    lines = [
        [
            row.world,
            *("{:.3f} ({})".format(*row.laps[p]) if p in row.laps and row.laps[p][1] else "-"
              for p in later),
        ]
        for row in rows
    ]  # fmt: skip
    return table(["hidden", *(LABELS[policy] for policy in later)], lines)


def named_grid(came: Sequence[Came], words: Mapping[str, str]) -> Grid:
    """Return what every diagnosis said, beside what is true."""
    lines = []
    for one in came:
        values = [
            f"{effect['name']} {label}: {value:.4g}"
            for effect in one.diagnosis["effects"]
            for label, value, _ in components(effect["parameters"])
            if value is not None
        ]
        gap = one.diagnosis["gap"]
        lines.append(
            [
                one.world,
                words[one.world],
                str(one.training_seed),
                one.diagnosis["verdict"],
                named_effects(one.diagnosis) or "nothing",
                "; ".join(values),
                f"{gap['before']:.2f}, {gap['after']:.2f}, {gap['noise_floor']:.2f}",
            ]
        )
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
