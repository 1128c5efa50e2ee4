"""Reads flight logs for a fit, and refuses those with faults that it would take for physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.check import CheckContext, check_files, check_log, signals_of
from eval.logs.faults.finding import Finding, line
from eval.logs.faults.vehicle import check_same_vehicle
from eval.logs.flight_log import FlightLog, columns_from_log, flight_files, read_flights
from tracks.common.names import unknown_name

COMPENSATED = ("motor_map", "battery_scaling")
"""Faults of a vehicle file that `suite identify` and `suite delta` compensate: they accept them."""


class CheckedFlights(NamedTuple):
    """Flights that were read and checked."""

    logs: Sequence[FlightLog]
    """The flights."""
    earlier: Sequence[FlightLog] = ()
    """Flights of the vehicle before a change."""
    findings: Sequence[dict[str, Any]] = ()
    """What the checks found, as records with the flight's name; None is the vehicle file."""
    warnings: Sequence[str] = ()
    """Lines about files that cannot be used, and about findings that do not stop the command."""


def read_checked(
    paths: Sequence[Path],
    against: CheckContext,
    accept: Sequence[str] = (),
    earlier: Sequence[Path] = (),
    partial: bool = False,
) -> CheckedFlights:
    """Read flight logs and folders of them, and check them as `check_flights` does.

    Partial logs are accepted with `partial`.

    Raises:
        ValueError: if no log can be used, or as by `check_flights`.
    """
    logs, warnings = read_flights(flight_files(paths), partial)
    before: list[FlightLog] = []
    if earlier:
        before, notes = read_flights(flight_files(earlier), partial)
        warnings = [*warnings, *notes]
    findings = check_flights(logs, against, accept, before)
    return CheckedFlights(logs, before, findings, [*warnings, *lines_of(findings)])


def check_flights(
    logs: Sequence[FlightLog],
    against: CheckContext,
    accept: Sequence[str] = (),
    earlier: Sequence[FlightLog] = (),
) -> list[dict[str, Any]]:
    """Return the findings of logs and files as records, before a fit to the logs.

    Known faults that are named in `accept` are ignored. The vehicle of `earlier` flights, before a
    change, may have another name.

    Raises:
        ValueError: for a fault that a fit would take for physics, or two copies of a flight, of
            which one could be held out to test the fit to the other.
    """
    flights = [*logs, *earlier]
    for number, log in enumerate(flights):
        for other in flights[:number]:
            if _is_copy(log, other):
                raise ValueError(f"{other.name} and {log.name} are the same flight: give it once")
    unknown = [fault for fault in accept if fault not in FAULTS]
    if unknown:
        raise unknown_name("fault", unknown[0], list(FAULTS))
    found: list[tuple[Finding, str | None]] = [(f, None) for f in check_files(against)]
    for log in flights:
        found += [(finding, log.name) for finding in check_log(log, against)[0]]
    found += [*check_same_vehicle(logs), *check_same_vehicle(earlier)]
    stops = [(f, name) for f, name in found if f.is_open and f.fault not in accept]
    if stops:
        lines = [f"{name or 'the vehicle file'}: {line(f)}" for f, name in stops]
        faults = " ".join(sorted({f.fault for f, _ in stops}))
        raise ValueError(
            "\n".join(["an estimate from these flights would be wrong:", *lines])
            + f"\ncorrect it, or continue anyway with --accept {faults}"
        )
    return [{**f._asdict(), "flight": name} for f, name in found if f.status != "ok"]


def _is_copy(log: FlightLog, other: FlightLog) -> bool:
    """Return whether two logs have the same rows: equal times and equal values of all signals."""

    def is_same(ours: np.ndarray, theirs: np.ndarray) -> bool:
        """Return whether the values are equal, but for the rounding of a CSV file."""
        return np.allclose(ours, theirs, rtol=0.0, atol=1e-5, equal_nan=True)

    # Most pairs of flights have other times, so their signals are not compared.
    if log.time_s.shape != other.time_s.shape or not is_same(log.time_s, other.time_s):
        return False
    ours, theirs = (signals_of(columns_from_log(one)) for one in (log, other))
    return ours.keys() == theirs.keys() and all(is_same(ours[k], theirs[k]) for k in ours)


def lines_of(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines of text for the doubts and notes that name a fault or another vehicle.

    A report prints them as warnings. Flights with the same evidence share a line.
    """
    flights: dict[tuple[str, str], list[str]] = {}
    for record in records:
        about = record["fault"] or ("vehicle" if record["signal"] == "vehicle" else "")
        if about and record["status"] in ("doubt", "note"):
            names = flights.setdefault((about, record["evidence"]), [])
            names.append(record["flight"] or "vehicle file")
    return [
        f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}: {about}: {evidence}"
        for (about, evidence), names in flights.items()
    ]
