"""From flight logs to a vehicle file with the numbers that they identify."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.logs.faults.check import CheckContext, check_before_diagnosis, lines_of
from eval.logs.flight_log import read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.common.console import Console
from suite.common.provenance import stamp
from suite.delta.run import flight_files
from suite.diagnose.data.sampling import without_slow_rotors
from suite.diagnose.estimate.parameters import refuse_own_motion
from suite.diagnose.identify.drive import unknown_to_the_fits
from suite.diagnose.identify.identify import Identified, identify
from suite.diagnose.identify.numbers import as_json, lines_of_numbers

SCHEMA = 1
PARTS = ("drag", "motors", "inertia", "lag", "loop")
"""What `--leave` may name."""
MADE = "by suite identify"
"""In the first line of a vehicle file that this command wrote."""


def identify_files(
    flights: Sequence[Path],
    vehicle: str,
    out: Path,
    leave: Sequence[str],
    console: Console,
    accept: Sequence[str] = (),
) -> dict[str, Any]:
    """Identify a vehicle from log files, and write its file.

    Args:
        flights: logs or folders of them.
        vehicle: file or shipped name to start from.
        out: the vehicle file to write.
        leave: of `PARTS`, what stays as it is.
        console: for people.
        accept: faults of the interface that are known, and go on all the same.

    Returns:
        What `--json` prints.

    Raises:
        ValueError: for flights or a vehicle that cannot be used.
    """
    for part in leave:
        if part not in PARTS:
            raise ValueError(f"--leave {part!r}: allowed: {', '.join(PARTS)}")
    if set(PARTS) <= set(leave):
        raise ValueError(f"--leave {' '.join(leave)}: nothing remains to estimate")
    start = load_vehicle(vehicle)
    refuse_own_motion(start)
    logs, warnings = read_flights(flight_files(flights), partial=True)
    findings = check_before_diagnosis(logs, CheckContext(start), accept)
    logs, slow = without_slow_rotors(logs)
    warnings = [*warnings, *lines_of(findings), *slow]
    console.say(f"{_counted(len(logs))}, {sum(log.duration_s for log in logs):.0f} s in all")
    if unknown := unknown_to_the_fits(start):
        warnings = [
            *warnings,
            f"{start.name} has {', '.join(unknown)}: the fits do not model them, so the "
            "estimates include their share, and they stay in the file; start without them",
        ]
    found = identify(logs, start, leave)
    head = _head(found, vehicle)
    try:
        save_vehicle(found.vehicle, out, head)
    except ValueError as error:
        raise ValueError(f"{out}: not written: {error}\n{head}") from error
    return {
        "vehicle": str(out),
        "start": vehicle,
        "drive": found.drive,
        "parameters": as_json(found.numbers),
        "not_identified": list(found.not_identified),
        "left": found.left,
        "flights": list(found.flights),
        "findings": findings,
        "warnings": [*warnings, *found.notes],
        **stamp(SCHEMA, None),
    }


def _counted(flights: int) -> str:
    return "1 flight" if flights == 1 else f"{flights} flights"


def is_identified(vehicle: str) -> bool:
    """Return whether `vehicle` is a file that suite identify wrote."""
    path = Path(vehicle)
    if not path.is_file():
        return False
    first = path.read_text(encoding="utf-8").partition("\n")[0]
    return first.startswith("#") and MADE in first


def _head(found: Identified, start: str) -> str:
    flights = _counted(len(found.flights))
    lines = [f"From {start} {MADE}, {flights} ({found.drive}); 95 % intervals:"]
    lines += lines_of_numbers(found.numbers)
    lines += [f"not identifiable: {text}" for text in found.not_identified]
    return "\n".join(lines)
