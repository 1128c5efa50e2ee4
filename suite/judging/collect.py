"""Record simulated flights as logs (`suite collect`): a Parquet file per flight, and a list.

The same call after an interruption continues it. Finished flights are known from the list of an
earlier call, and from a journal, a file with a line for each finished flight.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from eval.effects.log_faults import apply_log_faults
from eval.judging.judge import Record
from eval.judging.results import Journal
from eval.logs.columns import DURATION_MIN, FlightLogError
from eval.logs.flight import Flight
from eval.logs.flight_log import log_from_flight, logs_in, write_flight
from eval.quadrotor.vehicle_file import save_vehicle, vehicle_table
from eval.vehicles.vehicle import Vehicle
from eval.worlds import nearest
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import Policy
from suite.common.console import Console, counted
from suite.common.errors import WorkFailed
from suite.common.provenance import engines, refuse_other_run, write_run_record
from suite.common.stages import announce
from suite.judging.content import PolicyContent
from suite.judging.flying import (
    Manner,
    default_policy,
    fly_trials,
    flying_estimate,
    load_in_manner,
    policy_for_workers,
    policy_record,
    without_paths,
    workers_for,
)
from suite.judging.requests import Collection
from suite.judging.trials import TrialSet, log_name, read_trial_set, refuse_equal_names, show_notes
from tracks.common.files import write_json
from tracks.common.provenance import differences, first_changes, git_commit, stamp
from tracks.common.work import Workers
from tracks.input.reading import read_json

LIST = "flights.json"
"""Name of the list of flights in the output folder."""
JOURNAL = "journal.jsonl"
"""Name of the file with a line for each finished flight; removed when the list is written."""
AS_FLOWN = "vehicle_as_flown.toml"
"""Name of the vehicle file that describes the flights, if the given one does not: the simulator
then has other equations (`eval.worlds.nearest`)."""


def collect(
    collection: Collection, out: Path, console: Console, workers: Workers | None = None
) -> dict[str, Any]:
    """Fly, and write one log per flight into `out`; the same call resumes an interrupted one.

    Returns:
        The contents of flights.json: version and seed, the settings, and a row for each flight with
        its result and the name of its log, `file`. It is null for a flight without a log. Such a
        flight is shorter than one second, or its log breaks a rule of flight logs; then there is a
        warning. `as_flown` is `AS_FLOWN` if that file is written, else null.

    Raises:
        ValueError: if a setting of `collection` cannot be used, or `out` holds other flights.
        WorkFailed: if no flight has a log; the list is written.
    """
    trial_set, manner = read_trial_set(collection), Manner(speed=collection.speed)
    refuse_equal_names({trial.track for trial in trial_set.trials})
    source = collection.policy or default_policy()
    policy = load_in_manner(source, collection.trust, manner)
    content = PolicyContent.of(source, collection.trust)
    out = Path(out)
    refuse_other_run(out, collection)
    # What must be the same for a list or a journal to be continued.
    settings = {
        "collection": collection,
        "policy": policy_record(source, policy, content),
        "vehicle": trial_set.vehicle,
        "sensors": trial_set.sensors,
        "tracks": trial_set.tracks,
        "git_commit": git_commit(),
        "engines": engines(),
    }
    identity = without_paths(settings)
    # Rows of flights that exist, then of the missing ones.
    rows = _existing_rows(out, identity)
    if (out / JOURNAL).is_file():  # of an interrupted call: refused with what differs
        Journal(out / JOURNAL, identity).close()
    _refuse_other_logs(out, trial_set)
    with Journal(out / JOURNAL, identity) as journal:
        described = _write_vehicle(collection, trial_set.vehicle, out, console)
        as_flown = None if described is trial_set.vehicle else AS_FLOWN
        rows |= {t: row for t, r in journal.done.items() if (row := _row(out, r)) is not None}
        written = _Logs(out, described, rows, journal, console)
        load = partial(policy_for_workers, policy, content, manner=manner)
        show_notes(console, collection.simulator, trial_set, [policy.spec])
        _fly_missing(collection, trial_set, load, written, workers)
        flights = [rows[trial] for trial in trial_set.trials]
        made = {"as_flown": as_flown, "flights": flights}
        listing = {**stamp(1, collection.seed), **settings, **made}
        write_json(out / LIST, listing)
    (out / JOURNAL).unlink()
    write_run_record(out, collection, collection.seed)
    logs = [row for row in rows.values() if row["file"]]
    seconds = sum(row["time_s"] for row in logs)
    console.say(f"{counted(len(logs), 'flight')}, {seconds:.0f} s, in {out}")
    if len(logs) < len(rows):
        short = sum(row["time_s"] < DURATION_MIN for row in rows.values())
        console.say(
            f"{len(rows) - len(logs)} without a log, {short} of them under {DURATION_MIN:g} s; "
            f"{LIST} has how each ended"
        )
    if as_flown:
        console.say(
            f"{out / as_flown} describes these flights: give it to suite diagnose (--vehicle), "
            "which otherwise names the simulator's own effects"
        )
    if not logs:
        raise WorkFailed(
            f"no flight has a log; {out / LIST} tells how each ended: give another --policy, or a "
            "lower --difficulty"
        )
    return {**listing, "out": str(out)}


def _write_vehicle(
    collection: Collection, vehicle: Vehicle, out: Path, console: Console
) -> Vehicle:
    """Return the vehicle that describes the flights; write its file if it is not `vehicle`.

    With a value beyond the bounds of vehicle files it is `vehicle` too, with a warning.
    """
    described = nearest(collection.simulator, vehicle)
    if vehicle_table(described) == vehicle_table(vehicle):
        return vehicle
    try:
        save_vehicle(described, out / AS_FLOWN, f"flights of the simulator {collection.simulator}")
    except ValueError as error:
        console.note(f"warning: no vehicle file describes these flights: {error}")
        return vehicle
    return described


Row = dict[str, Any]
"""A flight in the list: its result, and the name of its log as `file`."""


class _Logs(NamedTuple):
    """What is written of the flights that end."""

    out: Path
    vehicle: Vehicle
    """The vehicle of the logs."""
    rows: dict[TrialSpec, Row]
    """Rows of the list so far."""
    journal: Journal
    console: Console

    def add(self, result: TrialResult, flight: Flight | None) -> None:
        """Write the log of a flight, its line in the journal and its row."""
        name = None
        if flight is not None and result.time_s >= DURATION_MIN:
            name = _write_log(self.out, result, flight, self.vehicle, self.console)
        if name is None:  # a log of an earlier collection may have this name
            _log_path(self.out, result.trial).unlink(missing_ok=True)
        self.rows[result.trial] = {"file": name, **result._asdict()}
        self.journal.append(result)


def _fly_missing(
    collection: Collection,
    trial_set: TrialSet,
    load: Callable[[Workers], Policy | Callable[[], Policy]],
    logs: _Logs,
    workers: Workers | None,
) -> None:
    """Fly the trials that are missing in the rows; `load` returns the policy for the workers."""
    rows, console = logs.rows, logs.console
    missing = [trial for trial in trial_set.trials if trial not in rows]
    workers = workers_for(len(missing), workers, collection.simulator)
    if missing:
        title = f"{counted(len(missing), 'flight')} in {collection.simulator}"
        announce(console, title, flying_estimate(len(missing), workers, collection.simulator))
    with console.progress("flights", len(trial_set.trials), begun=len(rows)) as update:

        def keep(result: TrialResult, flight: Flight | None) -> None:
            logs.add(result, flight)
            update(len(rows), result.ended_by)

        if missing:
            fly_trials(load(workers), collection, trial_set, workers, missing, keep, Record())


def _row(out: Path, result: TrialResult) -> Row | None:
    """Return the row of a flight in the journal; None if its log is missing, to fly it again."""
    name = None
    if result.time_s >= DURATION_MIN:
        path = _log_path(out, result.trial)
        if not path.is_file():
            return None
        name = path.name
    return {"file": name, **result._asdict()}


def _log_path(out: Path, trial: TrialSpec) -> Path:
    """Return the path of a trial's log."""
    return out / log_name(*trial)


def _write_log(
    out: Path, result: TrialResult, flight: Flight, vehicle: Vehicle, console: Console
) -> str | None:
    """Write a log, with the name and the log faults of `vehicle`, and return its name.

    It is None, with a warning, if the log is refused.
    """
    path = _log_path(out, result.trial)
    flight = flight._replace(about={**flight.about, "vehicle": vehicle.name})
    logged = flight._replace(**apply_log_faults(vehicle.effects, flight._asdict()))
    try:
        write_flight(path, log_from_flight(logged, path.name))
    except FlightLogError as error:
        console.note(f"warning: no log of this flight: {error}")
        return None
    return path.name


def _refuse_other_logs(out: Path, trial_set: TrialSet) -> None:
    """Refuse a folder with logs of other commands: a diagnosis would mix them with these."""
    names = {log_name(*trial) for trial in trial_set.trials}
    if others := [log.name for log in logs_in(out) if log.name not in names]:
        raise ValueError(
            f"{out} holds other flight logs ({others[0]} and so on), which suite diagnose would "
            "mix with the new ones; give another --out"
        )


def _existing_rows(out: Path, identity: dict[str, Any]) -> dict[TrialSpec, Row]:
    """Return the rows of an earlier call's list whose logs exist.

    `identity` are the settings of this call, without paths of files.

    Raises:
        ValueError: if the list cannot be read, or is that of another collection.
    """
    path = out / LIST
    if not path.is_file():
        return {}
    try:
        listing = read_json(path)
        stored = without_paths({key: listing.get(key) for key in identity})
        rows = {
            TrialSpec(row["track"], row["difficulty"], row["seed"]): row
            for row in listing["flights"]
        }
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a list of flights ({error}); move it away") from error
    if stored != identity:
        raise ValueError(
            f"{path}: is of other flights ({first_changes(differences(stored, identity))}); give "
            "another --out or move it away"
        )
    return {
        trial: row
        for trial, row in rows.items()
        if row["file"] is None or (out / row["file"]).is_file()
    }
