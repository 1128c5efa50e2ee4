"""Success under every effect of the catalogue and under growing disturbances, policies in pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro

from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture, Report, Section
from suite.experiments.pages.document import Place
from suite.experiments.pages.tables import condition_grid
from suite.experiments.study import disturbed, judging, options
from suite.experiments.study.conditions import STATE_UNIT, Condition, log_faults
from suite.experiments.study.disturbed import Grown, Tested
from suite.judging.flying import default_policy
from tracks.input.ranges import Seed, Trials

UNDISTURBED = "undisturbed"
MEANINGS = (
    "Success: rate over all tracks with its 95 % Wilson interval. Change: against the same policy "
    "undisturbed on the same trials, in points, with Newcombe's paired 95 % interval; the "
    "intervals are not corrected for there being many conditions."
)
OF_EFFECTS = (
    "Each effect alone, added to the vehicle at the upper end of its usual size (`suite effects "
    "NAME`); where the vehicle has more of it already, it keeps that, and where its file may not "
    "hold so much, it has the most that it may. The autopilot and the policy do not know."
)
OF_SWEEPS = (
    "The sensors' noise is in the policy's observation only; the autopilot below it sees "
    "the truth. Depth: white noise on every pixel's inverse depth. Gate-pose error: each "
    "gate is shown elsewhere, the same for the whole trial. State estimate: position "
    f"{STATE_UNIT.pos_m:g} m, velocity {STATE_UNIT.vel:g} m/s, attitude 1 deg, each axis, times "
    f"the factor, changing over {STATE_UNIT.correlation_s:g} s. Ages: the state, or the image, "
    "that the policy decides on is so old; a jittering age is drawn anew for each decision, evenly "
    "from 0 to twice its mean, that of the state and that of the image apart; a lost image is "
    "replaced by the one before. The wind blows along (-0.6, 0.8, 0)."
)


@dataclass(frozen=True)
class Config:
    """Judge policies under every physical effect and under growing disturbances.

    All fly the same trials under every condition. A policy trained with another randomisation
    beside the first shows what that randomisation buys.
    """

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it the shipped policy flies."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 32
    """Trials of every policy on every track at every level under every condition."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """What is disturbed: a shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Only these effects and sweeps, by name; by default all."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what is missing is flown first."""
    vehicle = load_vehicle(config.vehicle)
    policies = judging.named_policies(config.policy or (default_policy(),))
    alone, sweeps = disturbed.asked_conditions(vehicle, config.only)
    base, trials = Condition(UNDISTURBED, 0.0, "", vehicle), judging.trials_of(config)
    fliers = {name: [(policy, trials)] for name, policy in policies.items()}
    effects, grown = disturbed.flown_under(
        [base, *alone], sweeps, fliers, place.cache, console, place.workers
    )
    report = Report(
        title="Robustness: what the policy survives",
        lead=_lead(next(iter(policies)), effects, grown),
        facts={
            **judging.policy_facts(policies),
            "trials": f"three tracks, level {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} trials a condition, the same in all",
            "vehicle": config.vehicle,
        },
        sections=[*_of_effects(effects), *_of_sweeps(grown, effects[0], bool(alone))],
    )
    tested = [*effects, *(point for points in grown.values() for point in points)]
    return report, {"conditions": [disturbed.tested_numbers(entry, effects[0]) for entry in tested]}


def _of_effects(effects: Sequence[Tested]) -> list[Section]:
    from suite.experiments.pages.charts import effects_chart

    if len(effects) == 1:
        return []
    caption = "Success under each effect, 95 % Wilson intervals; dashed: undisturbed."
    *some, last = log_faults()
    parts = [
        OF_EFFECTS,
        Picture(effects_chart(effects), caption),
        condition_grid(effects, effects[0], ("effect", "total")),
        MEANINGS,
        f"{', '.join(some)} and {last} are faults of a log, not of the flight, and change nothing "
        "here; errors of what the policy senses are below.",
    ]
    return [Section("Every effect at its usual size", parts)]


def _of_sweeps(grown: Grown, base: Tested, explained: bool) -> list[Section]:
    from suite.experiments.pages.charts import sweeps_chart

    if not grown:
        return []
    caption = (
        "Success against growing disturbances, 95 % Wilson intervals; the leftmost point is the "
        "vehicle as it is."
    )
    grids = [condition_grid(points, base, (s.axis,), s.name) for s, points in grown.items()]
    # Said once a page, and above where there are effects.
    words = [OF_SWEEPS] if explained else [MEANINGS, OF_SWEEPS]
    parts = [Picture(sweeps_chart(grown), caption), *grids, *words]
    return [Section("Growing disturbances", parts)]


def _lead(policy: str, effects: Sequence[Tested], grown: Grown) -> str:
    base = effects[0].success(policy)
    text = f"Undisturbed, {policy} succeeds in {percent(base)} of the trials."
    if len(effects) > 1:
        worse = [entry for entry in effects[1:] if entry.success(policy).value < base.value]
        worst = sorted(worse, key=lambda entry: entry.success(policy).value)[:3]
        each = (
            f"{e.condition.name} ({e.condition.words}) {100 * e.success(policy).value:.0f} %"
            for e in worst
        )
        text += f" The effects that cost most: {', '.join(each) or 'none does'}."
    halves = []
    for sweep, points in grown.items():
        lost = [p for p in points if p.success(policy).value < base.value / 2]
        reached = f"at {lost[0].condition.words}" if lost else "nowhere in the sweep"
        halves.append(f"{sweep.name} {reached}")
    if halves:
        text += f" Success falls below half of that: {', '.join(halves)}."
    return text
