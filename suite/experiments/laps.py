"""How far from the limit: laps of policies beside plans made with everything known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import tyro

from eval.judging.judge import JudgeOptions, Record, fly
from eval.logs.flight import Flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import load_policy
from suite.common.console import Console
from suite.common.report import Report, Section
from suite.common.running.apart import Job
from suite.common.work import all_done
from suite.experiments.pages.document import Place
from suite.experiments.pages.laps import HOW, MEANINGS, cell_table, failures, lead, worst_tracks
from suite.experiments.planning.search import Effort, Plan, fly_plan, plans
from suite.experiments.study import judging, options
from suite.experiments.study.beside import Flown, beside
from suite.experiments.study.cache import code_digest, digest, engines
from suite.judging.flying import default_policy, who_flies, workers_for
from tracks.common.files import write_json
from tracks.input.ranges import Seed, Trials
from tracks.input.reading import read_json

TOGETHER = 2
"""Tracks of a cell that are planned side by side, as one piece of work."""
PLANS = "plans.json"
"""A piece's plans, in its folder."""


@dataclass(frozen=True)
class Config:
    """Plan laps with everything known, fly them in MuJoCo, and hold policies' laps against them."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it the shipped policy flies."""
    difficulty: str = "0,3,6,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 4
    """Tracks in every cell, each planned for and flown by every policy."""
    seed: Seed = 0
    """Seed of the first track; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


class Together(NamedTuple):
    """What is planned as one piece: tracks of a family at a level."""

    vehicle: Vehicle
    trials: Sequence[TrialSpec]
    effort: Effort


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; plans that are missing are made first."""
    vehicle = load_vehicle(config.vehicle)
    policies = judging.named_policies(config.policy or (default_policy(),))
    trials = judging.trials_of(config)
    found = planned(vehicle, trials, place, console)
    best = {plan.trial: fly_plan(vehicle, plan.trial, plan.numbers) for plan in found}
    flights = {
        name: policy_flights(policy, vehicle, trials, place) for name, policy in policies.items()
    }
    laps = {
        name: [beside(best[trial], mine[trial]) for trial in trials]
        for name, mine in flights.items()
    }
    report = Report(
        title="Laps: how far from the limit",
        lead=lead(found, laps),
        facts={
            **judging.policy_facts(policies),
            "tracks": f"three families, levels {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)}, the same for plans and policies",
            "vehicle": config.vehicle,
        },
        sections=[
            Section("Every cell", [cell_table(found, laps), MEANINGS]),
            Section("Where the most is left", worst_tracks(best, flights, laps)),
            Section("How a plan is made", [HOW, failures(found)]),
        ],
    )
    return report, {
        "plans": [plan._asdict() for plan in found],
        "laps": {name: [lap._asdict() for lap in mine] for name, mine in laps.items()},
    }


def planned(
    vehicle: Vehicle, trials: Sequence[TrialSpec], place: Place, console: Console
) -> list[Plan]:
    """Return a plan for each trial's track; those that were made are found in the cache."""
    cells: dict[tuple[str, int], list[TrialSpec]] = {}
    for trial in trials:
        cells.setdefault((trial.track, trial.difficulty), []).append(trial)
    rooms = ("tracks", "policies", "eval", "suite/diagnose/plans", "suite/experiments/planning")
    jobs = []
    for every in cells.values():
        for first in range(0, len(every), TOGETHER):
            piece = Together(vehicle, every[first : first + TOGETHER], Effort())
            about = {"cell": piece._asdict(), "code": code_digest(*rooms), "engines": engines()}
            jobs.append(Job(piece, place.cache / "laps" / digest(about)))
    rows = all_done(plan_piece, jobs, place.workers, console, "planning")
    by_trial = {plan.trial: plan for some in rows for plan in some}
    return [by_trial[trial] for trial in trials]


def plan_piece(job: Job, console: Console) -> list[Plan]:
    """Return the plans of a job's `Together`, made unless they are in its folder."""
    piece, path = job.task, job.folder / PLANS
    if not path.is_file():
        effort, (track, level, seed) = piece.effort, piece.trials[0]
        total = effort.first + effort.flown
        with console.progress(f"planning {track} {level}, from seed {seed}", total) as update:
            made = plans(piece.vehicle, piece.trials, effort, update)
        job.folder.mkdir(parents=True, exist_ok=True)
        write_json(path, [plan._asdict() for plan in made])
    return [Plan(**{**row, "trial": TrialSpec(**row["trial"])}) for row in read_json(path)]


def policy_flights(
    policy: str, vehicle: Vehicle, trials: Sequence[TrialSpec], place: Place
) -> dict[TrialSpec, Flown]:
    """Return how the judge sees a policy fly each trial in MuJoCo."""
    workers = workers_for(len(trials), place.workers, "mujoco")
    flier, found = who_flies(load_policy(policy), policy, False, workers), {}

    def keep(result: TrialResult, flight: Flight | None) -> None:
        assert flight is not None, "flights are recorded"
        found[result.trial] = result, flight

    fly(flier, trials, vehicle, "mujoco", JudgeOptions(workers=workers), keep, Record())
    return found
