"""Judge policies: fly the trials, save each as it ends, write the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.console import Console
from suite.common.provenance import refuse_other_run, write_run_record
from suite.common.stages import announce
from suite.judging.flying import (
    Course,
    about_policy,
    by_content,
    default_policy,
    flying_needs,
    labels,
    load_in_manner,
    read_course,
    say_notes,
    who_flies,
    workers_for,
)
from suite.judging.requests import Evaluation, Manner, manners
from tracks.common.files import digest_of
from tracks.common.grid import rich_table
from tracks.common.provenance import stamp
from tracks.common.work import Workers

if TYPE_CHECKING:
    from eval.judging.plans import OverPlan
    from eval.judging.results import Journal
    from eval.sensors.sensors_file import SensorSet
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialResult
    from policies.policy import Policy
    from tracks.track import Track


class Entry(NamedTuple):
    """A policy that flies all trials in one manner."""

    source: str
    """The given name or path."""
    policy: Policy
    """The loaded policy, in its manner."""
    label: str
    """Its label in tables."""
    manner: Manner


def evaluate(
    evaluation: Evaluation, out: Path, console: Console, workers: Workers | None = None
) -> dict[str, Any]:
    """Fly all trials and write trials.parquet, table.md, summary.json and run.json into `out`.

    Each trial is saved in a journal as it ends: the same call after an interruption flies the
    remaining ones, with any `workers`. The journals are removed when the tables are written.

    Returns:
        The summary: `cells` and `paired` of `eval.judging.tables.summarise`, `over_plan` of
        `eval.judging.plans.over_plan`, and the settings.

    Raises:
        ValueError: for invalid values in `evaluation`, before the first flight.
    """
    from eval.judging.outputs import notes_of
    from eval.judging.results import write_results
    from eval.judging.tables import grids, markdown_table, summarise, with_interval

    course, out = read_course(evaluation), Path(out)
    refuse_other_run(out, evaluation)
    given = tuple(evaluation.policies or (default_policy(),))
    policies = [load_in_manner(name, evaluation.trust) for name in given]
    plain = list(zip(given, policies, labels(given, [p.name for p in policies]), strict=True))
    entries = [
        Entry(name, manner(policy), manner.label(label), manner)
        for manner in manners(evaluation.speed, evaluation.monitor)
        for name, policy, label in plain
    ]
    _refuse_twice([entry.label for entry in entries])
    count = len(course.trials)
    workers = workers_for(count, workers, evaluation.simulator)
    if (out / "trials.parquet").is_file():
        console.note(f"{out} holds an evaluation; its results will be overwritten")
    flown = count * len(entries)
    needs = flying_needs(flown, workers, evaluation.simulator)
    journals = _open_journals(evaluation, course, entries, out)
    announce(console, f"{flown} trials in {evaluation.simulator}", needs)
    say_notes(console, evaluation.simulator, course)
    for warning in dict.fromkeys(each for policy in policies for each in notes_of(policy)):
        console.note(str(warning))
    results: list[TrialResult] = []
    for entry, journal in zip(entries, journals, strict=True):
        results += _fly_one(evaluation, course, entry, workers, journal, console)
    over = _over_plan(results, course)
    actions = {entry.label: _actions(entry, results, console) for entry in entries}
    summary = {
        **summarise(results),
        "over_plan": over,
        "actions": actions,
        "sentences": _sentences(results),
        "judged": evaluation,
        "policies": [about_policy(entry.source, entry.policy) for entry in entries],
        "sha256": file_digests(course.vehicle, course.tracks, course.sensors),
        "flown_otherwise": course.differences,
    }
    write_results(
        out,
        results,
        table_markdown=markdown_table(summary),
        summary=summary,
        seed=evaluation.seed,
    )
    write_run_record(out, evaluation, evaluation.seed)
    kept = {journal.path for journal in journals if journal.others(course.trials)}
    for path in out.glob("journal-*.jsonl"):  # also journals of an earlier command
        if path not in kept:
            path.unlink()
    for grid in grids(summary):
        console.show(rich_table(grid))
    for sentence in summary["sentences"]:
        console.say(sentence)
    for one in (one for one in over if one.finished):
        whose = f"{one.policy}: " if len(over) > 1 else ""
        tracks = f"{one.finished} track{'s' * (one.finished != 1)}"
        console.say(
            f"{whose}laps take {with_interval(one.ratio)} times a planned lap (median of {tracks}; "
            "a plan knows the whole track)"
        )
    console.say(f"written: {out / 'trials.parquet'}, table.md, summary.json")
    if not all(row.success for row in results if row.policy == results[0].policy):
        console.say(f"next: suite view {out} --pick failed shows what went wrong")
    return {**stamp(1, evaluation.seed), **summary, "out": str(out)}


def _over_plan(results: Sequence[TrialResult], course: Course) -> list[OverPlan]:
    """Return lap times over planned lap times, if the vehicle is the one of the plans."""
    from eval.judging.plans import VEHICLE, over_plan
    from eval.quadrotor.vehicle_file import load_vehicle, vehicle_table

    if vehicle_table(course.vehicle) != vehicle_table(load_vehicle(VEHICLE)):
        return []
    return over_plan([row for row in results if row.track not in course.tracks])


def _sentences(results: Sequence[TrialResult]) -> list[str]:
    """Return a sentence for each other policy on its difference to the first one."""
    import numpy as np

    from suite.judging.comparing import paired_sentence

    flown: dict[str, dict[Any, bool]] = {}
    for row in results:
        flown.setdefault(row.policy, {})[row.trial] = row.success
    (first, one), *others = flown.items()
    return [
        paired_sentence(name, first, *(np.array([each[t] for t in one]) for each in (other, one)))
        for name, other in others
    ]


def _actions(entry: Entry, results: Sequence[TrialResult], console: Console) -> dict[str, Any]:
    """Return and print the share of limited actions of a policy, and warnings."""
    from eval.judging.outputs import action_report

    rows = [result for result in results if result.policy == entry.label]
    found = action_report(rows, entry.policy.spec.action)
    if found["decisions"]:
        console.say(
            f"{entry.label}: {found['limited']:.1%} of {found['decisions']} actions exceeded the "
            "limits and were reduced"
        )
    for warning in found["warnings"]:
        console.note(f"warning: {entry.label}: {warning}")
    return found


def file_digests(
    vehicle: Vehicle, tracks: Mapping[str, Track], sensors: SensorSet
) -> dict[str, str]:
    """Return the SHA-256 of vehicle, sensors and tracks, by name.

    It is that of the parsed content: comments in a file do not matter.
    """
    from eval.quadrotor.vehicle_file import vehicle_table
    from eval.sensors.sensors_file import sensors_table

    parts: dict[str, object] = {"vehicle": vehicle_table(vehicle)}
    if sensors.models:
        parts["sensors"] = sensors_table(sensors)
    parts |= {f"track {name}": track for name, track in tracks.items()}
    return {what: digest_of(part) for what, part in parts.items()}


def _refuse_twice(called: list[str]) -> None:
    """Refuse two entries with one label, which tables would merge."""
    for label in called:
        if called.count(label) > 1:
            raise ValueError(
                f"{label} would be judged twice; give each --policy and each --speed once "
                "(speeds are compared to 6 digits)"
            )


def _open_journals(
    evaluation: Evaluation, course: Course, entries: Sequence[Entry], out: Path
) -> list[Journal]:
    """Return the journal in `out` of each of `entries`.

    Raises:
        ValueError: if an existing one is of other settings; none is made then.
    """
    from eval.judging.results import Journal

    paths = [out / f"journal-{number}.jsonl" for number in range(len(entries))]
    opened = {}
    pairs = zip(paths, entries, strict=True)
    for path, entry in sorted(pairs, key=lambda pair: not pair[0].exists()):
        about = {
            **stamp(1, None),
            "policy": about_policy(entry.source, entry.policy),
            "speed": entry.manner.speed,
            "vehicle": course.vehicle,
            "sensors": course.sensors,
            "world": evaluation.simulator,
            "deadline_s": evaluation.deadline_s,
            "time_limit_s": evaluation.time_limit_s,
            "tracks": course.tracks,
        }
        opened[path] = Journal(path, by_content(about))
    return [opened[path] for path in paths]


def _fly_one(
    evaluation: Evaluation,
    course: Course,
    entry: Entry,
    workers: Workers,
    journal: Journal,
    console: Console,
) -> list[TrialResult]:
    """Return the results of one policy in the trials' order."""
    from eval.judging.guard import ActionLimits
    from eval.judging.judge import JudgeOptions, fly
    from eval.worlds.trial import Rules

    label = entry.label
    options = JudgeOptions(
        workers=workers,
        rules=Rules(time_limit_s=evaluation.time_limit_s),
        limits=ActionLimits(deadline_s=evaluation.deadline_s),
        sensors=course.sensors,
    )
    with journal:
        missing = journal.missing(course.trials)
        if len(missing) < len(course.trials):
            console.note(f"{label}: {len(course.trials) - len(missing)} trials were flown before")
        if others := journal.others(course.trials):
            console.note(
                f"{label}: {others} further trials were flown before and are not asked for now: "
                f"the table is without them, {journal.path.name} keeps them"
            )
        with console.progress(label, len(course.trials)) as update:

            def keep(result: TrialResult, flight: object) -> None:
                journal.append(result._replace(policy=label))
                done = len(journal.done)
                share = sum(r.success for r in journal.done.values()) / done
                update(done, f"{share:.0%} success")

            fly(
                who_flies(entry.policy, entry.source, evaluation.trust, workers, entry.manner),
                missing,
                course.vehicle,
                evaluation.simulator,
                options,
                keep,
                tracks=course.tracks,
            )
        # An earlier run may have had other policies and another label.
        return [journal.done[trial]._replace(policy=label) for trial in course.trials]
