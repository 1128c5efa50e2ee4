"""The document of `suite reproduce robustness`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval, PairedDifference, paired_success, wilson
from eval.judging.tables import percent
from eval.worlds.trial import TrialResult
from suite.common.report import Cell, Grid, Picture, Report, Section
from suite.experiments.conditions import STATE_UNIT, Condition, Sweep, log_faults
from suite.experiments.robust_charts import effects_chart, sweeps_chart
from suite.judging.flying import policy_digest

if TYPE_CHECKING:
    from suite.experiments.robustness import Config

MEANINGS = (
    "Success: rate over all tracks with its 95 % Wilson interval. Change: against the same policy "
    "undisturbed on the same trials, in points, with Newcombe's paired 95 % interval; the "
    "intervals are not corrected for there being many conditions."
)
OF_EFFECTS = (
    "Each effect alone, added to the vehicle at the upper end of its usual size (`suite effects "
    "NAME`); where the vehicle has more of it already, it keeps that. The autopilot and the policy "
    "do not know."
)


class Tested(NamedTuple):
    """A condition and how every policy did under it, on the same trials."""

    condition: Condition
    results: Mapping[str, Sequence[TrialResult]]
    """By what tables call the policy."""

    def success(self, policy: str) -> Interval:
        """Return the rate over all tracks and levels."""
        return wilson(int(self.won(policy).sum()), len(self.results[policy]))

    def won(self, policy: str) -> np.ndarray:
        """Return which trials succeeded, (n,) bool."""
        return np.array([row.success for row in self.results[policy]])


def robust_report(
    config: Config,
    policies: Mapping[str, str],
    effects: Sequence[Tested],
    grown: Mapping[Sweep, Sequence[Tested]],
) -> tuple[Report, dict[str, Any]]:
    """Return the document and the numbers that go beside it.

    Args:
        config: what was asked.
        policies: name or path of each policy by what tables call it.
        effects: the undisturbed condition first, then the effects.
        grown: the points of each sweep, the undisturbed first.
    """
    base, names = effects[0], list(policies)
    sections = []
    if len(effects) > 1:
        parts = [
            OF_EFFECTS,
            Picture(
                effects_chart(effects, names),
                "Success under each effect, 95 % Wilson intervals; dashed: undisturbed.",
            ),
            condition_grid("", effects, base, names, ("effect", "total")),
            MEANINGS,
            f"{_listed(log_faults())} are faults of a log, not of the flight, and change nothing "
            "here; errors of what the policy senses are below.",
        ]
        sections.append(Section("Every effect at its usual size", parts))
    if grown:
        unit = STATE_UNIT
        parts = [
            Picture(
                sweeps_chart(grown, names),
                "Success against growing disturbances, 95 % Wilson intervals; the leftmost point "
                "is the vehicle as it is.",
            ),
            *(
                condition_grid(sweep.name, points, base, names, (sweep.axis,))
                for sweep, points in grown.items()
            ),
            "The sensors' noise is in the policy's observation only; the autopilot below it sees "
            "the truth. Depth: white noise on every pixel's inverse depth. Gate-pose error: each "
            "gate is shown elsewhere, the same for the whole trial. State estimate: position "
            f"{unit.pos_m:g} m, velocity {unit.vel:g} m/s, attitude 1 deg, each axis, times the "
            f"factor, changing over {unit.correlation_s:g} s. The wind blows along (-0.6, 0.8, 0).",
        ]
        sections.append(Section("Growing disturbances", parts))
    trials = len(base.results[names[0]])
    last = config.seed + config.trials - 1
    report = Report(
        title="Robustness: what the policy survives",
        lead=_lead(names[0], effects, grown),
        facts={
            **{
                name: f"{path}, SHA-256 {policy_digest(path)[:16]}"
                for name, path in policies.items()
            },
            "trials": f"three tracks, level {config.difficulty}, seeds {config.seed} to {last}: "
            f"{trials} trials a condition, the same in all",
            "vehicle": config.vehicle,
        },
        sections=sections,
    )
    numbers = {
        "config": config,
        "conditions": [
            tested_numbers(entry, base, names)
            for entry in (*effects, *(point for points in grown.values() for point in points))
        ],
    }
    return report, numbers


def _lead(policy: str, effects: Sequence[Tested], grown: Mapping[Sweep, Sequence[Tested]]) -> str:
    base = effects[0].success(policy)
    text = f"Undisturbed, {policy} succeeds in {percent(base)} of the trials."
    if len(effects) > 1:
        worst = sorted(effects[1:], key=lambda entry: entry.success(policy).value)[:3]
        each = (
            f"{e.condition.name} ({e.condition.words}) {100 * e.success(policy).value:.0f} %"
            for e in worst
        )
        text += f" The effects that cost most: {', '.join(each)}."
    halves = []
    for sweep, points in grown.items():
        lost = [p for p in points if p.success(policy).value < base.value / 2]
        reached = f"at {lost[0].condition.words}" if lost else "nowhere in the sweep"
        halves.append(f"{sweep.name} {reached}")
    if halves:
        text += f" Success falls below half of that: {', '.join(halves)}."
    return text


def condition_grid(
    title: str,
    entries: Sequence[Tested],
    base: Tested,
    names: Sequence[str],
    first: Sequence[str],
) -> Grid:
    """Return success and change under each of `entries`, a row each.

    Args:
        title: of the table.
        entries: conditions.
        base: the undisturbed one.
        names: of the policies; the others are compared with the first.
        first: headers of what names a row: the size, or the name and the size.
    """
    headers = list(first)
    for name in names:
        mine = f"{name}: " if len(names) > 1 else ""
        headers += [f"{mine}success", f"{mine}change"]
    headers += [f"{name} - {names[0]}" for name in names[1:]]
    rows = []
    for entry in entries:
        about = (entry.condition.name, entry.condition.words)[-len(first) :]
        row = [Cell(text) for text in about]
        for name in names:
            same = entry.condition.vehicle is base.condition.vehicle and (
                entry.condition.noise == base.condition.noise
            )
            change = Cell("") if same else points_cell(
                paired_success(entry.won(name), base.won(name))
            )  # fmt: skip
            row += [Cell(percent(entry.success(name))), change]
        row += [points_cell(paired_success(entry.won(n), entry.won(names[0]))) for n in names[1:]]
        rows.append(row)
    return Grid(title, headers, rows)


def points_cell(difference: PairedDifference | Interval) -> Cell:
    """Return a difference of success rates in points with its interval, coloured by its sign."""
    value, low, high = (f"{round(100 * x) + 0.0:+.0f}" for x in difference[:3])
    tone = "good" if difference.low > 0 else "bad" if difference.high < 0 else ""
    return Cell(f"{value} [{low}, {high}]", tone)


def tested_numbers(entry: Tested, base: Tested, names: Sequence[str]) -> dict[str, Any]:
    """Return one condition as JSON holds it, track by track too."""
    found: dict[str, Any] = {
        "name": entry.condition.name,
        "size": entry.condition.size,
        "words": entry.condition.words,
        "noise": entry.condition.noise,
        "effects": dict(entry.condition.vehicle.effects),
        "policies": {},
    }
    for name in names:
        rows = entry.results[name]
        tracks = dict.fromkeys(row.track for row in rows)
        found["policies"][name] = {
            "success": entry.success(name),
            "change": paired_success(entry.won(name), base.won(name)),
            "tracks": {
                track: float(np.mean([row.success for row in rows if row.track == track]))
                for track in tracks
            },
            "v_max": float(np.median([row.v_max for row in rows])),
            "v_mean": float(np.median([row.v_mean for row in rows])),
        }
    return found


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}"
