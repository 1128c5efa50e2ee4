"""From real flights to diagnosis.json, vehicle.toml and a report, by their views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.logs.flight_log import FlightLog
from eval.quadrotor.vehicle_file import save_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.common.console import Console
from suite.common.report import write_report
from suite.diagnose.data.windows import remembers
from suite.diagnose.report.views_json import views_json
from suite.diagnose.report.views_page import views_page
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.views.by_views import diagnose_by_views
from tracks.common.files import plain, write_json
from tracks.common.provenance import stamp


def only_views(logs: Sequence[FlightLog], vehicle: Vehicle) -> bool:
    """Return whether rollouts cannot be flown.

    Something is missing, or what drives is known by motor commands alone, or by those to a rate
    loop that remembers.
    """
    return any(
        log.partial or (log.rotor_speed is None and (log.rate_cmd_b is None or remembers(vehicle)))
        for log in logs
    )


def diagnose_views(
    logs: Sequence[FlightLog],
    references: Sequence[FlightLog],
    vehicle: Vehicle,
    out: Path,
    console: Console,
    schema: int,
    seed: int,
    warnings: Sequence[str] = (),
    limits: Thresholds = THRESHOLDS,
) -> dict[str, Any]:
    """Diagnose `logs` by their views; write what was found and return what diagnosis.json holds.

    Args:
        logs: flights.
        references: flights of the same vehicle before what changed; none for what is missing.
        vehicle: what a simulation uses.
        out: folder for the files.
        console: told of the work as it goes.
        schema: version of diagnosis.json.
        seed: of all draws.
        warnings: of the files.
        limits: of every step.

    Raises:
        ValueError: for flights that cannot be used.
    """
    result = diagnose_by_views(logs, vehicle, references, console.note, seed, limits)
    told = views_json(result)
    told["warnings"] = [*warnings, *told["warnings"]]
    found = {**plain(told), **stamp(schema, seed)}
    out.mkdir(parents=True, exist_ok=True)
    names = ", ".join(effect["name"] for effect in found["effects"]) or "nothing"
    comment = f"{vehicle.name} with what suite diagnose named: {names}"
    save_vehicle(result.vehicle, out / "vehicle.toml", comment)
    toml = (out / "vehicle.toml").read_text(encoding="utf-8")
    write_report(out / "report.html", views_page(result, found, toml))
    write_json(out / "diagnosis.json", found)
    return found
