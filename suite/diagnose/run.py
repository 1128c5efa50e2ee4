"""From flight logs to diagnosis.json, vehicle.toml, report.html, a recording and a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from eval.logs.flight_log import FlightLog, read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.common.console import Console
from suite.common.report import write_report
from suite.delta.run import flight_files
from suite.diagnose.diagnose import Diagnosis, diagnose
from suite.diagnose.plans.plan import fly_plan, write_plan_of
from suite.diagnose.report.answer import answer
from suite.diagnose.report.page import page
from suite.diagnose.report.recording import write_rollouts
from suite.diagnose.verdict.black_box import Contests, compare_black_box
from suite.diagnose.verdict.delta_model import BlackBoxConfig
from suite.diagnose.verdict.proof import as_json, gather
from tracks.common.files import plain, write_json
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of diagnosis.json."""


@dataclass(frozen=True)
class Wishes:
    """What a diagnosis is asked for besides the names."""

    drive: str = "auto"
    """"auto", "commands" or "motors"."""
    compare_delta: bool = False
    """Fit a Delta Action Model on the same split and show it beside the names."""
    plan: bool = False
    """Write flights that tell apart what these could not."""
    fly: str | None = None
    """Fly the plan in simulation with this vehicle."""
    recording: bool = True
    """Write a recording for rerun."""
    seed: int = 0
    """Of all draws."""


def diagnose_files(
    paths: Sequence[Path], vehicle_name: str, wishes: Wishes, out: Path, console: Console
) -> dict[str, Any]:
    """Diagnose flights in files; write what was found and return what diagnosis.json holds.

    Args:
        paths: flight logs, or folders of them.
        vehicle_name: a vehicle file or a shipped name.
        wishes: what is asked for.
        out: folder for the files.
        console: told of the work as it goes.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    vehicle = load_vehicle(vehicle_name)
    truth = None if wishes.fly is None else load_vehicle(wishes.fly)
    logs, warnings = read_flights(flight_files(paths))
    for warning in warnings:
        console.note(f"warning: {warning}")
    result = diagnose(logs, vehicle, wishes.drive, console.note, wishes.seed)
    proof = gather(result, logs, vehicle)
    if wishes.compare_delta:
        contests = _contests(result, logs, vehicle, wishes.seed, console)
        proof = replace(proof, contests=contests)
    found: dict[str, Any] = {**answer(result, wishes.seed), **as_json(proof, wishes.seed)}
    found["warnings"] = [*warnings, *found["warnings"]]
    told = found["disagreement"]["after" if result.finding.named else "before"]
    if found["unexplained"]["where"] and told:
        found["unexplained"]["where"] += f"; most in {told}"
    out.mkdir(parents=True, exist_ok=True)
    if wishes.plan or truth is not None:
        found["plan"] = write_plan_of(found, out / "plan")
        if truth is not None:
            found["plan"] = fly_plan(
                found["plan"], result, vehicle, truth, out / "plan", wishes.seed
            )
        found["warnings"] += found["plan"].pop("warnings", [])
    found = {**plain(found), **stamp(SCHEMA, wishes.seed)}
    names = ", ".join(effect["name"] for effect in found["effects"]) or "nothing"
    comment = f"{vehicle.name} with what suite diagnose named: {names}"
    save_vehicle(result.vehicle, out / "vehicle.toml", comment)
    files = {"vehicle.toml", "diagnosis.json"}
    if wishes.recording:
        write_rollouts(out / "recording.rrd", result, logs, vehicle)
        files.add("recording.rrd")
    if found.get("plan", {}).get("flights"):
        files.add("plan/plan.json")
    toml = (out / "vehicle.toml").read_text(encoding="utf-8")
    report = page(result, found, proof, toml, files, wishes.seed)
    write_report(out / "report.html", report)
    write_json(out / "diagnosis.json", found)
    return found


def _contests(
    result: Diagnosis, logs: Sequence[FlightLog], vehicle: Vehicle, seed: int, console: Console
) -> Contests:
    config = BlackBoxConfig(seed=seed)
    with console.progress("fitting the Delta Action Model", 1.0) as show:
        return compare_black_box(result, logs, vehicle, config, show)
