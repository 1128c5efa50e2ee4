"""From flight logs to diagnosis.json, vehicle.toml and report.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.flight_log import read_flights
from eval.vehicle_file import load_vehicle, save_vehicle
from suite.console import Console
from suite.delta.run import flight_files
from suite.diagnose.answer import answer
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report import page
from suite.report import write_report
from tracks.files import plain, write_json
from tracks.provenance import stamp

SCHEMA = 1
"""Version of diagnosis.json."""


def diagnose_files(
    paths: Sequence[Path], vehicle_name: str, drive: str, out: Path, console: Console
) -> dict[str, Any]:
    """Diagnose flights in files; write the three files and return what diagnosis.json holds.

    Args:
        paths: flight logs, or folders of them.
        vehicle_name: a vehicle file or a shipped name.
        drive: "auto", "commands" or "motors".
        out: folder for the three files.
        console: told of the work as it goes.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    vehicle = load_vehicle(vehicle_name)
    logs, warnings = read_flights(flight_files(paths))
    for warning in warnings:
        console.note(f"warning: {warning}")
    result = diagnose(logs, vehicle, drive, console.note)
    found: dict[str, Any] = plain(answer(result))
    found["warnings"] = [*warnings, *found["warnings"]]
    found = {**found, **stamp(SCHEMA, None)}
    out.mkdir(parents=True, exist_ok=True)
    names = ", ".join(effect["name"] for effect in found["effects"]) or "nothing"
    comment = f"{vehicle.name} with what suite diagnose named: {names}"
    save_vehicle(result.vehicle, out / "vehicle.toml", comment)
    write_report(out / "report.html", page(result, found))
    write_json(out / "diagnosis.json", found)
    return found
