"""Record flights as logs: one Parquet file per flight, and a list of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.logs.columns import DURATION_MIN
from suite.common.console import Console
from suite.common.provenance import refuse_other_run, write_run_record
from suite.common.stages import announce
from suite.judging.flying import (
    Course,
    about_policy,
    by_content,
    default_policy,
    flying_needs,
    load_in_manner,
    log_name,
    read_course,
    refuse_one_name,
    say_notes,
    who_flies,
    workers_for,
)
from suite.judging.requests import Collection, Manner
from tracks.common.files import write_json
from tracks.common.provenance import git_commit, stamp
from tracks.common.work import Workers
from tracks.input.reading import read_json

if TYPE_CHECKING:
    from eval.judging.results import Journal
    from eval.logs.flight import Flight
    from eval.worlds.trial import TrialResult, TrialSpec
    from policies.policy import Policy

LIST = "flights.json"
"""Name of the list of flights in the output folder."""
JOURNAL = "journal.jsonl"
"""Name of the file with a line for each finished flight; removed when the list is written."""


def collect(
    collection: Collection, out: Path, console: Console, workers: Workers | None = None
) -> dict[str, Any]:
    """Fly, and write one log per flight into `out`; the same call resumes an interrupted one.

    Returns:
        The contents of flights.json: the stamp, the settings, and the flights as rows of results
        with their `file` (null for a flight without a log: it is shorter than one second, or its
        values break a rule of flight logs, with a warning).

    Raises:
        ValueError: if a setting of `collection` cannot be used, or `out` holds the flights of
            another collection.
    """
    from eval.judging.judge import check_records
    from eval.judging.results import Journal

    course, manner = read_course(collection), Manner(speed=collection.speed)
    check_records(collection.simulator)
    refuse_one_name({trial.track for trial in course.trials})
    given = collection.policy or default_policy()
    policy = load_in_manner(given, collection.trust, manner)
    out = Path(out)
    refuse_other_run(out, collection)
    about = {
        "collection": collection,
        "policy": about_policy(given, policy),
        "vehicle": course.vehicle,
        "tracks": course.tracks,
        "git_commit": git_commit(),
    }
    identity = by_content(about)
    rows = _rows_there(out, identity)
    with Journal(out / JOURNAL, identity) as journal:
        rows |= {t: row for t, r in journal.done.items() if (row := _row(out, r)) is not None}
        _fly_missing(collection, course, policy, out, rows, journal, console, workers)
        found = _write_list(out, about, course, rows)
    (out / JOURNAL).unlink()
    write_run_record(out, collection, collection.seed)
    logs = [row for row in rows.values() if row["file"]]
    seconds = sum(row["time_s"] for row in logs)
    console.say(f"{len(logs)} flights, {seconds:.0f} s, in {out}")
    if len(logs) < len(rows):
        short = sum(row["time_s"] < DURATION_MIN for row in rows.values())
        console.say(
            f"{len(rows) - len(logs)} without a log, {short} of them under {DURATION_MIN:g} s"
        )
    return {**found, "out": str(out)}


Row = dict[str, Any]
"""A flight in the list."""


def _fly_missing(
    collection: Collection,
    course: Course,
    policy: Policy,
    out: Path,
    rows: dict[TrialSpec, Row],
    journal: Journal,
    console: Console,
    workers: Workers | None,
) -> None:
    """Fly the trials that `rows` lacks; write the log and the journal when a flight ends."""
    from eval.judging.judge import JudgeOptions, Record, fly
    from eval.worlds.trial import Rules

    missing = [trial for trial in course.trials if trial not in rows]
    workers = workers_for(len(missing), workers, collection.simulator)
    what = f"{len(missing)} flights in {collection.simulator}"
    announce(console, what, flying_needs(len(missing), workers, collection.simulator))
    say_notes(console, collection.simulator, course)
    given, manner = collection.policy or default_policy(), Manner(speed=collection.speed)
    rules = Rules(time_limit_s=collection.time_limit_s)
    options = JudgeOptions(workers=workers, rules=rules, sensors=course.sensors)
    with console.progress("flights", len(course.trials)) as update:

        def keep(result: TrialResult, flight: Flight | None) -> None:
            name = None
            if flight is not None and result.time_s >= DURATION_MIN:
                name = _write_log(out, result, flight, console)
            rows[result.trial] = {"file": name, **result._asdict()}
            journal.append(result)
            update(len(rows), result.ended_by)

        if missing:
            fly(
                who_flies(policy, given, collection.trust, workers, manner),
                missing,
                course.vehicle,
                collection.simulator,
                options,
                keep,
                Record(depth=False),
                course.tracks,
            )


def _write_list(
    out: Path, about: dict[str, Any], course: Course, rows: dict[TrialSpec, Row]
) -> dict[str, Any]:
    """Write the list of flights, in the order of the trials, and return it."""
    flights = [rows[trial] for trial in course.trials]
    found = {**stamp(1, about["collection"].seed), **about, "flights": flights}
    write_json(out / LIST, found)
    return found


def _row(out: Path, result: TrialResult) -> Row | None:
    """Return the row of a flight in the journal; None if its log is missing."""
    name = None
    if result.time_s >= DURATION_MIN:
        name = log_name(result.track, result.difficulty, result.seed)
        if not (out / name).is_file():
            return None
    return {"file": name, **result._asdict()}


def _write_log(out: Path, result: TrialResult, flight: Flight, console: Console) -> str | None:
    """Write a log and return its name; None, with a warning, if the log is refused."""
    from eval.logs.columns import FlightLogError
    from eval.logs.flight_log import log_from_flight, write_flight

    name = log_name(result.track, result.difficulty, result.seed)
    try:
        write_flight(out / name, log_from_flight(flight, name))
    except FlightLogError as error:
        console.note(f"warning: no log of this flight: {error}")
        return None
    return name


def _rows_there(out: Path, about: dict[str, Any]) -> dict[TrialSpec, Row]:
    """Return the rows of an earlier call; refuse those of another collection (`by_content`)."""
    from eval.worlds.trial import TrialSpec

    path = out / LIST
    if not path.is_file():
        return {}
    try:
        found = read_json(path)
        same = by_content({key: found[key] for key in about}) == about
        rows = {
            TrialSpec(row["track"], row["difficulty"], row["seed"]): row for row in found["flights"]
        }
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a list of flights ({error}); move it away") from error
    if not same:
        raise ValueError(
            f"{path}: is of another collection or another version of the code; give another --out "
            "or move it away"
        )
    return {
        t: row for t, row in rows.items() if row["file"] is None or (out / row["file"]).is_file()
    }
