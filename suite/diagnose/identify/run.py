"""Reads flight logs, estimates the vehicle's parameters, and writes a vehicle file with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.logs.faults.check import CheckContext
from eval.logs.faults.checked import COMPENSATED, read_checked
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.common.console import Console, counted
from suite.common.provenance import is_marked, refuse_foreign, stamp
from suite.diagnose.data.sampling import without_slow_rotors
from suite.diagnose.estimate.parameters import refuse_own_motion
from suite.diagnose.identify.drive import unmodelled_effects
from suite.diagnose.identify.identify import PARTS, identify
from suite.diagnose.identify.numbers import number_lines, numbers_json
from tracks.common.files import check_no_input, check_place

SCHEMA = 1
"""Version of the JSON that `suite identify` prints."""
MADE_BY = "by suite identify"
"""Mark in the first line of a vehicle file that this command wrote."""


def identify_files(
    flights: Sequence[Path],
    vehicle: str,
    out: Path,
    leave: Sequence[str],
    console: Console,
    accept: Sequence[str] = (),
) -> dict[str, Any]:
    """Estimate the parameters of a vehicle from log files, and write its file.

    The parts `leave` (of `PARTS`) are not fitted, and the interface faults `accept` do not stop the
    command. Returned is the JSON object that `--json` prints.

    Raises:
        ValueError: if flights or vehicle cannot be used, or `out` is no place for the file.
    """
    check_out(out, vehicle)
    for part in leave:
        if part not in PARTS:
            raise ValueError(f"--leave {part!r}: allowed: {', '.join(PARTS)}")
    if set(PARTS) <= set(leave):
        raise ValueError(f"--leave {' '.join(leave)}: nothing remains to estimate")
    # Read the files, and check the logs for faults of interfaces.
    start = load_vehicle(vehicle)
    refuse_own_motion(start)
    estimated = [] if "inertia" in leave else ["vehicle_inertia"]
    accepted = [*accept, *COMPENSATED, *estimated]
    checked = read_checked(flights, CheckContext(start), accepted, partial=True)
    logs, slow = without_slow_rotors(checked.logs)
    warnings = [*checked.warnings, *slow]
    console.say(
        f"{counted(len(logs), 'flight')}, {sum(log.duration_s for log in logs):.0f} s in all"
    )
    if unmodelled := unmodelled_effects(start):
        warnings.append(
            f"{start.name} has {', '.join(unmodelled)}: the fits do not model them, so the "
            "estimates include their share, and they stay in the file; start without them"
        )
    identified = identify(logs, start, leave)
    flown = counted(len(logs), "flight")
    lines = [f"From {vehicle} {MADE_BY}, {flown} ({identified.drive}); 95 % intervals:"]
    lines += number_lines(identified.numbers)
    header = "\n".join([*lines, *(f"not identifiable: {t}" for t in identified.not_identified)])
    try:
        save_vehicle(identified.vehicle, out, header)
    except ValueError as error:
        raise ValueError(f"{out}: not written: {error}\n{header}") from error
    return {
        "vehicle": str(out),
        "start": vehicle,
        "drive": identified.drive,
        "parameters": numbers_json(identified.numbers),
        "not_identified": list(identified.not_identified),
        "left": identified.residual_rms,
        "flights": [log.name for log in logs],
        "findings": checked.findings,
        "warnings": [*warnings, *identified.notes],
        **stamp(SCHEMA, None),
    }


def check_out(out: Path, vehicle: str = "") -> None:
    """Refuse to write a file at `out` before the work for it.

    Raises:
        ValueError: for an ending that is not .toml, the file `vehicle` to start from, or a file
            that suite identify has not written.
        OSError: where it cannot be written.
    """
    if out.suffix.lower() != ".toml":
        raise ValueError(f"--out is {str(out)!r}; its ending must be .toml")
    check_place(out)
    check_no_input(out, [vehicle])
    refuse_foreign(out, MADE_BY)


def is_identified(vehicle: str) -> bool:
    """Return whether `vehicle` is a file that suite identify wrote."""
    return is_marked(Path(vehicle), MADE_BY)
