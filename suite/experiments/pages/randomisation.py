"""What the page on randomisation shows: what each spread is worth, under what, and by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, wilson
from suite.experiments.pages.tables import gap_cell, points_cell
from suite.experiments.study.disturbed import Grown, Tested
from suite.experiments.study.intervals import WHAT_COUNTS, Gap, nested
from tracks.common.grid import Cell, Grid, table

FIXED, RANDOMISED, WITHOUT = "fixed", "randomised", "without "
"""Settings; the last is followed by a spread's name."""
UNDISTURBED, ALL, OWN = "undisturbed", "all disturbances", "its own"
"""What settings are compared under."""
AGAINST = {
    "mass": "mass",
    "thrust": "thrust_scale",
    "rotor lag": "motor lag",
    "drag": "drag",
    "delay": "latency",
    "rate gain": "rate_gain",
    "centre of mass": "com_offset",
    "torque trim": "torque_trim",
    "wind": "wind",
    "image": "depth noise",
}
"""The disturbance that each spread is there for."""
MEANING = (
    "Points of success that the recipe is above the same recipe without the spread: undisturbed, "
    "under the disturbance that the spread is there for (all its sizes), and under all of them; in "
    "brackets each training seed's own. The last row is the recipe against one that varies "
    "nothing.",
    "Intervals: 95 %, bootstrap, drawing training seeds anew and the trials of each, a trial with "
    f"all its conditions; not corrected for there being several rows. {WHAT_COUNTS}",
)
BY_SEED = "Success undisturbed, under all disturbances [%]."
CAPTION = "Success with 95 % Wilson intervals, of the recipe and where nothing is varied."


class Worth(NamedTuple):
    """The recipe against another setting under some conditions, all of them together."""

    rates: tuple[Interval, Interval]
    """Success of the other and of the recipe, with Wilson intervals."""
    gap: Gap
    """In success, the recipe - the other."""


def worth_of(
    still: Tested, tested: Sequence[Tested], sizes: Sequence[int]
) -> dict[str, dict[str, Worth]]:
    """Return what each setting but the recipe lacks, by its name and by what it is disturbed by.

    Args:
        still: undisturbed, with every setting's trials, one training seed's after the other.
        tested: disturbed.
        sizes: trials of each training seed, in their order.
    """
    found = {}
    for name in still.results:
        if name == RANDOMISED:
            continue
        own = AGAINST.get(name.removeprefix(WITHOUT))
        under = {
            UNDISTURBED: [still],
            OWN: [entry for entry in tested if entry.condition.name == own],
            ALL: list(tested),
        }
        found[name] = {
            what: compare(name, entries, sizes) for what, entries in under.items() if entries
        }
    return found


def compare(name: str, entries: Sequence[Tested], sizes: Sequence[int]) -> Worth:
    """Return the recipe against the setting `name` over all of `entries` together."""
    other, recipe = (np.array([e.won(each) for e in entries]) for each in (name, RANDOMISED))
    # A trial counts once, with its mean over conditions, under which all fly the same trials.
    other, recipe = other.mean(axis=0), recipe.mean(axis=0)
    first, second = (wilson(float(won.sum()), won.size) for won in (other, recipe))
    apart = recipe - other
    return Worth((first, second), nested(np.split(apart, np.cumsum(sizes)[:-1])))


def lead(worth: Mapping[str, Mapping[str, Worth]]) -> str:
    """Return in sentences what randomisation gains and loses, and what of it does."""
    said = []
    for what in (ALL, UNDISTURBED):
        if what in worth[FIXED]:
            entry = worth[FIXED][what]
            other, recipe = (100 * rate.value for rate in entry.rates)
            said.append(
                f"{'over ' if what == ALL else ''}{what} {recipe:.0f} % succeed where dynamics "
                f"were randomised in training and {other:.0f} % where nothing was "
                f"({points_cell(entry.gap.difference).text} points)"
            )
    text = "; ".join(said)
    words = [f"{text[0].upper()}{text[1:]}."]
    left_out = {name.removeprefix(WITHOUT): mine for name, mine in worth.items() if name != FIXED}
    for what, where in ((OWN, "under its own disturbance"), (ALL, "over all disturbances")):
        for verdict, meant in (("gain", "What pays"), ("loss", "What costs")):
            named = [
                f"{name} {points_cell(mine[what].gap.difference).text}"
                for name, mine in left_out.items()
                if what in mine and mine[what].gap.verdict == verdict
            ]
            if named or verdict == "gain":
                words.append(f"{meant} {where}: {', '.join(named) or 'nothing for certain'}.")
    return " ".join(words) if left_out else words[0]


def worth_grid(worth: Mapping[str, Mapping[str, Worth]]) -> Grid:
    """Return what each spread is worth, and last all of them."""
    lines = []
    for name in sorted(worth, key=lambda setting: setting == FIXED):
        mine, spread = worth[name], name.removeprefix(WITHOUT)
        line: list[str | Cell] = ["all of them" if name == FIXED else spread]
        line.append(AGAINST.get(spread, "-"))
        for what in (UNDISTURBED, OWN, ALL):
            line.append(gap_cell(mine[what].gap) if what in mine else "-")
        verdicts = [mine[what].gap.verdict if what in mine else "unclear" for what in (OWN, ALL)]
        line += ["" if verdict == "unclear" else verdict for verdict in verdicts]
        lines.append(line)
    headers = ["spread", "its own disturbance", UNDISTURBED, OWN, ALL, f"{OWN}?", "all?"]
    return table(headers, lines)


def success_grid(tested: Sequence[Tested]) -> Grid:
    """Return the success of every setting under every condition."""
    names = list(tested[0].results)
    lines = [
        [
            f"{entry.condition.name} {entry.condition.words}".strip(),
            *(f"{100 * entry.success(name).value:.0f}" for name in names),
        ]
        for entry in tested
    ]
    return table(["success [%]", *names], lines)


def seeds_grid(
    shares: Mapping[int, Sequence[object]], still: Tested, tested: Sequence[Tested]
) -> Grid:
    """Return every training's success, undisturbed and disturbed."""
    cuts = np.cumsum([len(share) for share in shares.values()])[:-1]

    def by_seed(entries: Sequence[Tested], name: str) -> list[float]:
        won = np.mean([entry.won(name) for entry in entries], axis=0)
        return [100 * float(part.mean()) for part in np.split(won, cuts)]

    lines = []
    for name in still.results:
        pairs = zip(by_seed([still], name), by_seed(tested, name), strict=True)
        lines.append([name, *(f"{calm:.0f}, {worse:.0f}" for calm, worse in pairs)])
    headers = [f"training seed {seed}, {len(share)} trials" for seed, share in shares.items()]
    return table(["setting", *headers], lines)


def two_of(grown: Grown) -> Grown:
    """Return sweeps with the recipe and the one that varies nothing alone."""
    return {
        sweep: [
            point._replace(results={name: point.results[name] for name in (FIXED, RANDOMISED)})
            for point in points
        ]
        for sweep, points in grown.items()
    }
