"""What the page on laps shows: cells, the tracks where the most is left, and how plans are made."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.judging.statistics import Interval, bootstrap_median
from eval.judging.tables import with_interval
from eval.worlds.trial import TrialSpec, track_of
from suite.common.report import Picture
from suite.experiments.planning.search import Plan
from suite.experiments.study.beside import Flown, Lap, goes_around
from tracks.common.grid import Grid, table
from tracks.families import JUDGED

WORST = 10
"""Tracks that are listed."""
MEANINGS = (
    "Plan: the lap that the judge has seen in MuJoCo, median [least, most] over the tracks whose "
    "plan was flown to the end. It is an upper bound on the least lap, found by a local search: "
    "a faster one may well be there. Policy: the median lap over the trials that it finishes on "
    "those tracks. Ratio: the policy's lap over the plan's on the same track, median over tracks "
    "with its 95 % bootstrap interval, which with one or two tracks is only their range. Path: "
    "the same for the metres flown. Around: trials in which the direction of flight turns by a "
    "whole circle on the way to one gate."
)
HOW = (
    "A plan is a reference path, a cubic B-spline over time, and what is judged is how it is "
    "flown: by a pilot with the true state, through the same autopilot as a policy's actions (a "
    "decision every step of the attitude loop, the heading towards the next gate, the vehicle's "
    "delay, rate loop, rotor lag and saturation). A search by differential flatness, in which "
    "gates, solids, thrust and turning rate are limits, gives two first plans a track; a second "
    "one follows the gradient of the lap through the differentiable quadrotor at the judge's own "
    "steps. The judge then flies the plan in MuJoCo as it flies any policy; where that fails, "
    "the search goes on with more distance from all surfaces, and the fastest that finishes "
    "counts. A plan sees no image, knows all gates beforehand and has no noise: no policy with a "
    "camera need come near it."
)


def _ratio(laps: Sequence[Lap]) -> Interval:
    return bootstrap_median(np.array([lap.ratio for lap in laps if lap.ratio is not None]))


def _median(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}" if known else "-"


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    return f"{np.median(values):.2f} [{min(values):.2f}, {max(values):.2f}]"


def cell_table(found: Sequence[Plan], laps: Mapping[str, Sequence[Lap]]) -> Grid:
    """Return plans and policies cell by cell, then over all cells."""
    headers = ["track", "level", "plan [s]", "plans flown", "policy", "finished", "lap [s]"]
    headers += ["ratio", "path", "around"]
    lines = []
    cells = list(dict.fromkeys(plan.trial[:2] for plan in found))
    cells.sort(key=lambda cell: (JUDGED.index(cell[0]), cell[1]))
    for cell in [*cells, None]:
        plan = [p for p in found if cell in (None, p.trial[:2])]
        done = [p.lap_s for p in plan if p.flown]
        for name, every in laps.items():
            mine = [lap for lap in every if cell in (None, lap.trial[:2])]
            both = [lap for lap in mine if lap.ratio is not None]
            lines.append([
                cell[0] if cell else "all", str(cell[1]) if cell else "",
                _spread(done), f"{len(done)} of {len(plan)}", name,
                f"{sum(lap.policy_s is not None for lap in mine)} of {len(mine)}",
                _median([lap.policy_s for lap in both]), with_interval(_ratio(mine)),
                _median([lap.path for lap in mine]),
                f"{sum(map(goes_around, mine))} of {len(mine)}",
            ])  # fmt: skip
    return table(headers, lines)


def worst_tracks(
    best: Mapping[TrialSpec, Flown],
    flights: Mapping[str, Mapping[TrialSpec, Flown]],
    laps: Mapping[str, Sequence[Lap]],
) -> list[str | Grid | Picture]:
    """Return the tracks with the largest ratios, and a picture of the first policy's first."""
    headers = ["policy", "track", "level", "seed", "plan [s]", "lap [s]", "ratio", "path"]
    headers += ["most turned", "slowest then [m/s]"]
    lines, parts = [], []
    for name, every in laps.items():
        both = sorted((lap for lap in every if lap.ratio), key=lambda lap: -(lap.ratio or 0.0))
        for lap in both[:WORST]:
            leg = lap.around
            assert leg is not None, "it has finished"
            lines.append([
                name, lap.trial.track, str(lap.trial.difficulty), str(lap.trial.seed),
                f"{lap.planned_s:.2f}", f"{lap.policy_s:.2f}", f"{lap.ratio:.2f}",
                f"{lap.path:.2f}", f"{leg.turns:.2f} circles to gate {leg.gate}",
                f"{leg.slowest:.1f}",
            ])  # fmt: skip
        if both and not parts:
            parts.append(_picture(name, best, flights[name], both[0].trial))
    if not lines:
        return ["There is no track that a plan and a policy both finish."]
    words = (
        f"Of each policy the tracks with the largest ratio, {WORST} at most, and the leg on which "
        "it turned most."
    )
    return [words, table(headers, lines), *parts]


def _picture(
    name: str,
    best: Mapping[TrialSpec, Flown],
    mine: Mapping[TrialSpec, Flown],
    trial: TrialSpec,
) -> Picture:
    from eval.view.picture import write_grid

    track = track_of({}, trial)
    shown = [(track, flight, result) for result, flight in (best[trial], mine[trial])]
    with tempfile.TemporaryDirectory() as folder:
        path = write_grid(Path(folder) / "laps.png", shown, columns=2)
        caption = f"The track with the largest ratio: the plan (left) and {name} (right)."
        return Picture(path.read_bytes(), caption)


def failures(found: Sequence[Plan]) -> str:
    """Say which plans MuJoCo has not seen finish."""
    left = [plan for plan in found if not plan.flown]
    if not left:
        return "Every plan was flown to the end in MuJoCo; none is left out."
    each = (f"{p.trial.track} {p.trial.difficulty} seed {p.trial.seed} ({p.ending})" for p in left)
    return (
        f"{len(left)} of {len(found)} tracks have no plan that MuJoCo saw finish, and are left out "
        f"of laps and ratios: {', '.join(each)}."
    )


def lead(found: Sequence[Plan], laps: Mapping[str, Sequence[Lap]]) -> str:
    """Return what came out, in a few sentences."""
    flown = sum(plan.flown for plan in found)
    sentences = [
        f"Planned with everything known, {flown} of {len(found)} tracks have a lap that the judge "
        "has seen flown in MuJoCo."
    ]
    for name, mine in laps.items():
        both = [lap for lap in mine if lap.ratio is not None]
        around = [lap for lap in both if goes_around(lap)]
        if not both:
            sentences.append(f"{name} finishes none of them, so that its laps have no ratio.")
            continue
        text = (
            f"{name} takes {with_interval(_ratio(mine))} times as long (median over the "
            f"{len(both)} tracks that both finish, 95 % interval)"
        )
        if around:
            others = [lap for lap in both if not goes_around(lap)]
            text += (
                f"; in {len(around)} of them it goes around on the way to a gate, and takes "
                f"{_median([lap.ratio for lap in around])} times as long"
            )
            if others:
                text += f", in the others {_median([lap.ratio for lap in others])}"
        sentences.append(f"{text}.")
    sentences.append("A plan is an upper bound on the least lap, not a proof of it.")
    return " ".join(sentences)
