"""Record flights as logs: one Parquet file each, and a list of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.logs.columns import DURATION_MIN
from suite.common.console import Console
from suite.common.estimate import announce
from suite.common.provenance import write_run_record
from suite.judging.flying import (
    about_policy,
    default_policy,
    flying_needs,
    options_for,
    read_course,
    say_differences,
    who_flies,
)
from suite.judging.requests import Collection
from tracks.common.files import plain, write_json
from tracks.common.provenance import stamp
from tracks.input.reading import read_json

if TYPE_CHECKING:
    from eval.logs.flight import Flight
    from eval.worlds.trial import TrialResult, TrialSpec

LIST = "flights.json"
"""Name of the list of flights in the output folder."""


def collect(collection: Collection, out: Path, console: Console) -> dict[str, Any]:
    """Fly and write a log a flight into `out`; the same call after an interruption goes on.

    Returns:
        What flights.json holds: the stamp, what was collected, and the flights as rows of results
        with their `file` (null for a flight that is no log: under one second, or refused with a
        warning because its numbers break a rule of flight logs).

    Raises:
        ValueError: for anything in `collection` that cannot be used, or where `out` holds the
            flights of another collection.
    """
    from eval.judging.judge import Record, fly
    from policies.policy import load_policy

    course = read_course(collection)
    trials = course.trials
    asked = collection.policy or default_policy()
    policy = load_policy(asked, collection.trust)
    out = Path(out)
    about = {
        "collection": collection,
        "policy": about_policy(asked, policy),
        "vehicle": course.vehicle,
    }
    rows = _rows_there(out, plain(about))
    missing = [trial for trial in trials if trial not in rows]
    options = options_for(len(missing), None, collection.world)
    what = f"{len(missing)} flights in the {collection.world} world"
    processes = options.processes or 1
    announce(console, what, flying_needs(len(missing), processes, collection.world))
    say_differences(console, collection.world, course)

    def write_list() -> dict[str, Any]:
        flights = [rows[trial] for trial in trials if trial in rows]
        found = {**stamp(1, collection.seed), **about, "flights": flights}
        write_json(out / LIST, found)
        return found

    with console.progress("flights", len(trials)) as update:

        def keep(result: TrialResult, flight: Flight | None) -> None:
            name = None
            if flight is not None and result.time_s >= DURATION_MIN:
                name = _write_log(out, result, flight, console)
            rows[result.trial] = {"file": name, **result._asdict()}
            write_list()
            update(len(rows), result.ended_by)

        if missing:
            fly(
                who_flies(policy, asked, collection.trust, options.processes),
                missing,
                course.vehicle,
                collection.world,
                options,
                keep,
                Record(depth=False),
                course.tracks,
            )
    found = write_list()
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


def _write_log(out: Path, result: TrialResult, flight: Flight, console: Console) -> str | None:
    """Return the name of the log that was written, None with a warning where it is refused."""
    from eval.logs.columns import FlightLogError
    from eval.logs.flight_log import log_from_flight, write_flight

    name = f"{Path(result.track).stem}-{result.difficulty}-{result.seed}.parquet"
    try:
        write_flight(out / name, log_from_flight(flight, name))
    except FlightLogError as error:
        console.note(f"warning: no log of this flight: {error}")
        return None
    return name


def _rows_there(out: Path, about: dict[str, Any]) -> dict[TrialSpec, dict[str, Any]]:
    """Return the rows of an earlier, interrupted call of the same collection."""
    from eval.worlds.trial import TrialSpec

    path = out / LIST
    if not path.is_file():
        return {}
    try:
        found = read_json(path)
        same = {key: found[key] for key in about} == about
        rows = {
            TrialSpec(row["track"], row["difficulty"], row["seed"]): row for row in found["flights"]
        }
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a list of flights ({error}); move it away") from error
    if not same:
        raise ValueError(f"{path}: of another collection; give another --out or move it away")
    return {
        t: row for t, row in rows.items() if row["file"] is None or (out / row["file"]).is_file()
    }
