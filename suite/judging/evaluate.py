"""Judge policies (`suite eval`): fly the trials in a simulator and write tables of the results.

The result of each trial is written to a journal when it ends, so an interrupted evaluation
continues. An entry is a policy in one manner (commanded speed, with or without safety monitor);
each has a journal.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.plans import VEHICLE, OverPlan, over_plan
from eval.judging.policy_checks.faults import notes_of
from eval.judging.policy_checks.in_flight import action_report
from eval.judging.results import Journal, write_results
from eval.judging.tables import grids, markdown_table, summarise, with_interval
from eval.quadrotor.vehicle_file import load_vehicle, vehicle_table
from eval.sensors.sensors_file import sensors_table
from eval.worlds.trial import TrialResult
from policies.policy import Policy
from suite.common.console import Console, command_line, counted
from suite.common.provenance import engines, refuse_other_run, write_run_record
from suite.common.stages import announce, refuse_other_options
from suite.judging.comparing import TRACK, paired_sentence
from suite.judging.content import PolicyContent
from suite.judging.flying import (
    Manner,
    default_policy,
    fly_trials,
    flying_estimate,
    load_in_manner,
    manners,
    policy_for_workers,
    policy_labels,
    policy_record,
    without_paths,
    workers_for,
)
from suite.judging.requests import Evaluation
from suite.judging.trials import TrialSet, read_trial_set, show_notes
from tracks.common.files import digest_of
from tracks.common.grid import rich_table
from tracks.common.provenance import stamp
from tracks.common.work import Workers


class Entry(NamedTuple):
    """A policy that flies all trials in one manner, a row of the tables."""

    source: str
    """Name or path of the policy, as the user gave it."""
    policy: Policy
    """The loaded policy, which flies in this manner."""
    content: PolicyContent
    """Its files as they were loaded."""
    label: str
    """Label of the entry in tables."""
    manner: Manner
    """Commanded speed, and whether the safety monitor checks the actions."""


def evaluate(
    evaluation: Evaluation, out: Path, console: Console, workers: Workers | None = None
) -> dict[str, Any]:
    """Fly all trials and write trials.parquet, table.md, summary.json and run.json into `out`.

    The same call after an interruption flies the remaining trials; `workers`, the processes or
    cluster that fly them, may differ. The journals are removed when the tables are written.

    Returns:
        The contents of summary.json: the results (`cells` and `paired` of
        `eval.judging.tables.summarise`, `over_plan` of `eval.judging.plans.over_plan`), the
        settings, and `out`.

    Raises:
        ValueError: for invalid values in `evaluation`, before the first flight.
    """
    # Read the options: trials, and entries.
    trial_set, out = read_trial_set(evaluation), Path(out)
    refuse_other_run(out, evaluation)
    # Journals of an interrupted evaluation are checked when they are opened.
    if not any(out.glob("journal-*.jsonl")):
        refuse_other_options(out, evaluation)
    sources = tuple(evaluation.policies or (default_policy(),))
    policies = [load_in_manner(source, evaluation.trust) for source in sources]
    contents = [PolicyContent.of(source, evaluation.trust) for source in sources]
    labels = policy_labels(sources, [policy.name for policy in policies])
    entries = [
        Entry(source, manner(policy), content, manner.label(label), manner)
        for manner in manners(evaluation.speed, evaluation.monitor)
        for source, policy, content, label in zip(sources, policies, contents, labels, strict=True)
    ]
    names = [entry.label for entry in entries]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        # Tables would merge the two entries.
        raise ValueError(
            f"{repeated} would be judged twice; give each --policy and each --speed once "
            "(speeds are compared to 6 digits)"
        )
    # Announce the work, and fly what the journals lack.
    count = len(trial_set.trials)
    workers = workers_for(count, workers, evaluation.simulator)
    first: dict[str, str] = {}
    for label, content in zip(labels, contents, strict=True):
        if (other := first.setdefault(content.digest, label)) != label:
            console.note(f"{other} and {label} have the same policy: expect no difference")
    if (out / "trials.parquet").is_file():
        console.note(f"{out} holds an evaluation; its results will be overwritten")
    total = count * len(entries)
    needs = flying_estimate(total, workers, evaluation.simulator)
    journals = _open_journals(evaluation, trial_set, entries, out)
    announce(console, f"{counted(total, 'trial')} in {evaluation.simulator}", needs)
    show_notes(console, evaluation.simulator, trial_set, [each.spec for each in policies])
    for warning in dict.fromkeys(each for policy in policies for each in notes_of(policy)):
        console.note(str(warning))
    results: list[TrialResult] = []
    for entry, journal in zip(entries, journals, strict=True):
        results += _fly_entry(evaluation, trial_set, entry, workers, journal, console)
    # Write the tables; then the journals are no longer needed.
    laps = _laps_over_plan(results, trial_set)
    actions = {entry.label: _actions(entry, results, console) for entry in entries}
    summary: dict[str, Any] = {
        **summarise(results),
        "over_plan": laps,
        "actions": actions,
        "sentences": _sentences(results),
        "judged": evaluation,
        "policies": [policy_record(entry.source, entry.policy, entry.content) for entry in entries],
        "sha256": file_digests(trial_set),
        "flown_otherwise": trial_set.differences,
    }
    table = f"{_caption(evaluation)}\n\n{markdown_table(summary)}"
    write_results(out, results, table_markdown=table, summary=summary, seed=evaluation.seed)
    write_run_record(out, evaluation, evaluation.seed)
    # A journal stays if it has trials that this command does not request.
    unfinished = {journal.path for journal in journals if journal.others(trial_set.trials)}
    for path in out.glob("journal-*.jsonl"):  # also journals of an earlier command
        if path not in unfinished:
            path.unlink()
    # Print the results.
    console.say(_caption(evaluation))
    for grid in grids(summary):
        console.show(rich_table(grid))
    for sentence in summary["sentences"]:
        console.say(sentence)
    for lap in (lap for lap in laps if lap.finished):
        prefix = f"{lap.policy}: " if len(laps) > 1 else ""
        tracks = counted(lap.finished, "track")
        console.say(
            f"{prefix}laps take {with_interval(lap.ratio)} times a planned lap (median of "
            f"{tracks}; a plan knows the whole track)"
        )
    console.say(f"written: {out / 'trials.parquet'}, table.md, summary.json")
    if not all(row.success for row in results if not row.policy.endswith("+monitor")):
        trust = ["--trust"] * evaluation.trust
        line = command_line("suite", "view", out, "--pick", "failed", *trust)
        console.say(f"next, to see what went wrong: {line}")
    return {**stamp(1, evaluation.seed), **summary, "out": str(out)}


def _caption(evaluation: Evaluation) -> str:
    """Return the conditions of all trials, for the text above the tables."""
    last, deadline = evaluation.seed + evaluation.trials - 1, evaluation.deadline_s
    return (
        f"Vehicle {evaluation.vehicle}, sensors {evaluation.sensors}, simulator "
        f"{evaluation.simulator}, seeds {evaluation.seed} to {last}, time limit "
        f"{evaluation.time_limit_s:g} s"
        + ("." if deadline is None else f", deadline of an action {deadline:g} s.")
    )


def _laps_over_plan(results: Sequence[TrialResult], trial_set: TrialSet) -> list[OverPlan]:
    """Return each policy's lap times divided by planned ones; none for another vehicle.

    The planned laps are shipped, for one vehicle and for families of tracks only. A simulator that
    differs from the vehicle file flies another vehicle.
    """
    is_planned = vehicle_table(trial_set.vehicle) == vehicle_table(load_vehicle(VEHICLE))
    if trial_set.differences or not is_planned:
        return []
    return over_plan([row for row in results if row.track not in trial_set.tracks])


def _sentences(results: Sequence[TrialResult]) -> list[str]:
    """Return a sentence for each policy but the first one, on its difference to the first one."""
    successes: dict[str, dict[Any, bool]] = {}
    for row in results:
        successes.setdefault(row.policy, {})[row.trial] = row.success
    (first, reference), *others = successes.items()
    expected = np.array(list(reference.values()))
    return [
        paired_sentence(name, first, np.array([success[trial] for trial in reference]), expected)
        for name, success in others
    ]


def _actions(entry: Entry, results: Sequence[TrialResult], console: Console) -> dict[str, Any]:
    """Return the counts of an entry's actions; print how many exceeded the limits, and warnings."""
    rows = [result for result in results if result.policy == entry.label]
    actions = action_report(rows, entry.policy.spec.action)
    if limited := sum(row.limited_actions for row in rows):
        console.say(
            f"{entry.label}: {limited} of {actions['decisions']} actions exceeded the limits and "
            "were reduced"
        )
    for warning in actions["warnings"]:
        console.note(f"warning: {entry.label}: {warning}")
    return actions


def file_digests(trial_set: TrialSet) -> dict[str, str]:
    """Return the SHA-256 of the vehicle, of the sensors and of tracks from files, by name.

    It is computed from the values in a file, so comments do not change it.
    """
    contents: dict[str, object] = {"vehicle": vehicle_table(trial_set.vehicle)}
    if trial_set.sensors.models:
        contents["sensors"] = sensors_table(trial_set.sensors)
    contents |= {f"{TRACK}{name}": track for name, track in trial_set.tracks.items()}
    return {name: digest_of(content) for name, content in contents.items()}


def _open_journals(
    evaluation: Evaluation, trial_set: TrialSet, entries: Sequence[Entry], out: Path
) -> list[Journal]:
    """Return the journal of each entry, in `out`.

    Raises:
        ValueError: if an existing journal has other settings; then no new journal is made.
    """
    paths = [out / f"journal-{number}.jsonl" for number in range(len(entries))]
    journals = {}
    pairs = zip(paths, entries, strict=True)
    # Existing journals are opened first: one of them may be refused.
    for path, entry in sorted(pairs, key=lambda pair: not pair[0].exists()):
        settings = {
            **stamp(1, None),
            "engines": engines(),
            "policy": policy_record(entry.source, entry.policy, entry.content),
            "speed": entry.manner.speed,
            "vehicle": trial_set.vehicle,
            "sensors": trial_set.sensors,
            "world": evaluation.simulator,
            "deadline_s": evaluation.deadline_s,
            "time_limit_s": evaluation.time_limit_s,
            "tracks": trial_set.tracks,
        }
        journals[path] = Journal(path, without_paths(settings))
    return [journals[path] for path in paths]


def _fly_entry(
    evaluation: Evaluation,
    trial_set: TrialSet,
    entry: Entry,
    workers: Workers,
    journal: Journal,
    console: Console,
) -> list[TrialResult]:
    """Fly the trials of an entry that its journal lacks; return all results, in order."""
    label, trials = entry.label, trial_set.trials
    with journal:
        missing = journal.missing(trials)
        before = len(trials) - len(missing)
        if before:
            console.note(f"{label}: flown before: {counted(before, 'trial')}")
        if others := journal.others(trials):
            console.note(
                f"{label}: {others} further trials were flown before, which this command does not "
                f"request: the table is without them, {journal.path.name} keeps them"
            )
        flown = before
        won = sum(journal.done[trial].success for trial in trials if trial in journal.done)
        with console.progress(label, len(trials), begun=before) as update:

            def keep(result: TrialResult, flight: object) -> None:
                nonlocal flown, won
                journal.append(result._replace(policy=label))
                flown, won = flown + 1, won + result.success
                update(flown, f"{won / flown:.0%} success")

            policy = policy_for_workers(entry.policy, entry.content, workers, entry.manner)
            fly_trials(policy, evaluation, trial_set, workers, missing, keep)
        # An earlier command may have had other policies, and another label for this one.
        return [journal.done[trial]._replace(policy=label) for trial in trials]
