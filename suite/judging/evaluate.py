"""Judge policies: fly the trials, keep each as it ends, write the tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from suite.common.choices import at_least, parse_levels, parse_tracks
from suite.common.console import Console
from suite.common.estimate import Estimate, announce
from suite.common.provenance import write_run_record
from suite.judging.flying import (
    PROCESS_BYTES,
    SECONDS_A_TRIAL,
    START_SECONDS,
    about_policy,
    custom_tracks,
    default_policy,
    labels,
    options_for,
    trial_list,
    who_flies,
)
from tracks.common.provenance import stamp

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialResult, TrialSpec
    from policies.policy import Policy
    from tracks.track import Track


@dataclass(frozen=True)
class Judgement:
    """What is to be judged."""

    policies: tuple[str, ...] = ()
    """Shipped names, checkpoint folders or policy files; none means the shipped default."""
    track: str = "all"
    """As in `suite.common.choices.parse_tracks`."""
    difficulty: str = "0"
    """As in `suite.common.choices.parse_levels`."""
    trials: int = 10
    """Trials of every policy on every track at every level."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file."""
    world: str = "mujoco"
    """Where they fly."""
    processes: int | None = None
    """Processes that share the trials; None takes what is worth it."""
    deadline_s: float | None = None
    """A policy's answer for a batch that takes longer is late and not flown [s]; None: never."""
    trust: bool = False
    """Also load policy files that can run code."""


@dataclass(frozen=True)
class _Flown:
    judgement: Judgement
    trials: list[TrialSpec]
    tracks: dict[str, Track]
    vehicle: Vehicle
    out: Path


def evaluate(judgement: Judgement, out: Path, console: Console) -> dict[str, Any]:
    """Fly all trials and write trials.parquet, table.md, summary.json and run.json into `out`.

    Each trial is kept in a journal as it ends: the same call after an interruption flies the
    rest. The journals go when the tables are written.

    Returns:
        The summary: `cells` and `paired` of `eval.judging.tables.summarise`, and what was judged.

    Raises:
        ValueError: for anything in `judgement` that cannot be used, before the first flight.
    """
    from eval.judging.results import write_results
    from eval.judging.tables import markdown_table, rich_tables, summarise
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds import world_class
    from policies.policy import load_policy

    world_class(judgement.world)
    at_least("--trials", judgement.trials, 1)
    at_least("--seed", judgement.seed, 0)
    names = parse_tracks(judgement.track)
    trials = trial_list(names, parse_levels(judgement.difficulty), judgement.trials, judgement.seed)
    task = _Flown(
        judgement, trials, custom_tracks(names), load_vehicle(judgement.vehicle), Path(out)
    )
    asked = judgement.policies or (default_policy(),)
    policies = [load_policy(name, judgement.trust) for name in asked]
    called = labels(asked, [policy.name for policy in policies])
    options = options_for(len(trials), judgement.processes, judgement.world)
    processes = options.processes or 1
    seconds = START_SECONDS + len(trials) * len(asked) * SECONDS_A_TRIAL / processes
    what = f"{len(trials) * len(asked)} trials in the {judgement.world} world"
    announce(console, what, Estimate(seconds, processes * PROCESS_BYTES))
    results: list[TrialResult] = []
    journals: list[Path] = []
    for number, (name, policy, label) in enumerate(zip(asked, policies, called, strict=True)):
        journal = task.out / f"journal-{number}.jsonl"
        journals.append(journal)
        results += _fly_one(task, name, policy, label, journal, console)
    summary = {
        **summarise(results),
        "judged": judgement,
        "policies": [about_policy(*pair) for pair in zip(asked, policies, strict=True)],
    }
    write_results(
        task.out,
        results,
        table_markdown=markdown_table(summary),
        summary=summary,
        seed=judgement.seed,
    )
    write_run_record(task.out, judgement, judgement.seed)
    for journal in journals:
        journal.unlink()
    for table in rich_tables(summary):
        console.show(table)
    console.say(f"written: {task.out / 'trials.parquet'}, table.md, summary.json")
    return {**stamp(1, judgement.seed), **summary, "out": str(task.out)}


def _fly_one(
    task: _Flown, name: str, policy: Policy, label: str, journal_path: Path, console: Console
) -> list[TrialResult]:
    """Return the results of one policy in the order of the trials, journal first."""
    from dataclasses import replace

    from eval.judging.guard import ActionLimits
    from eval.judging.judge import fly
    from eval.judging.results import Journal

    judgement = task.judgement
    about = {
        **stamp(1, None),
        "policy": about_policy(name, policy),
        "vehicle": task.vehicle,
        "world": judgement.world,
        "deadline_s": judgement.deadline_s,
        "tracks": task.tracks,
    }
    options = options_for(len(task.trials), judgement.processes, judgement.world)
    options = replace(options, limits=ActionLimits(deadline_s=judgement.deadline_s))
    with Journal(journal_path, about) as journal:
        missing = journal.missing(task.trials)
        if len(missing) < len(task.trials):
            console.note(f"{label}: {len(task.trials) - len(missing)} trials were flown before")
        with console.progress(label, len(task.trials)) as update:

            def keep(result: TrialResult, flight: object) -> None:
                journal.append(result._replace(policy=label))
                done = len(journal.done)
                share = sum(r.success for r in journal.done.values()) / done
                update(done, f"{share:.0%} success")

            fly(
                who_flies(policy, name, judgement.trust, options.processes),
                missing,
                task.vehicle,
                judgement.world,
                options,
                keep,
                tracks=task.tracks,
            )
        return [journal.done[trial] for trial in task.trials]
