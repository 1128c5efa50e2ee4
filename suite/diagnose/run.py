"""From flight logs to diagnosis.json, vehicle.toml, report.html, a recording and a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from eval.logs.faults.check import CheckContext, check_before_diagnosis, lines_of, not_examined
from eval.logs.flight_log import read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.common.console import Console
from suite.common.report import write_report
from suite.delta.run import flight_files
from suite.diagnose.data.sampling import without_slow_rotors
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import refuse_own_motion
from suite.diagnose.identify.run import is_identified
from suite.diagnose.plan import fly_plan, write_plan_of
from suite.diagnose.report.charts import write_rollouts
from suite.diagnose.report.diagnosis_json import actuators_json, black_box_json, diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.sources.rollout_source import of_rollouts
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.actuators import actuator_mismatches
from suite.diagnose.verdict.black_box import BlackBoxConfig, compare_black_box
from tracks.common.files import plain, write_json
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of diagnosis.json."""


def diagnose_files(
    paths: Sequence[Path],
    vehicle_name: str,
    out: Path,
    console: Console,
    *,
    drive: str = "auto",
    integrator: str = "auto",
    compare_delta: bool = False,
    plan: bool = False,
    fly: str | None = None,
    recording: bool = True,
    seed: int = 0,
    reference: Sequence[Path] = (),
    relevance: tuple[float, float, float] = THRESHOLDS.relevance,
    accept: Sequence[str] = (),
) -> dict[str, Any]:
    """Diagnose flights in files; write what was found and return what diagnosis.json holds.

    Args:
        paths: flight logs, or folders of them.
        vehicle_name: a vehicle file or a shipped name.
        out: folder for the files.
        console: for progress and warnings.
        drive: what the model's input is: "auto", "commands" or "motors".
        integrator: how the bodies were moved: "auto", "continuous" or "euler".
        compare_delta: fit a Delta Action Model to the same flights and compare it.
        plan: write flights that separate what these could not.
        fly: fly the plan in simulation with this vehicle.
        recording: write a recording for rerun.
        seed: of all draws.
        reference: flights of the same vehicle before what changed: find what has changed since.
        relevance: least force [m/s^2], torque [rad/s^2] and drift after a second [m] of a finding.
        accept: faults of the interface that are known, and go on all the same.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    limits = replace(THRESHOLDS, relevance=relevance)
    vehicle = load_vehicle(vehicle_name)
    refuse_own_motion(vehicle)
    truth = None if fly is None else load_vehicle(fly)
    logs, warnings = read_flights(flight_files(paths), partial=True)
    before, more = read_flights(flight_files(reference), partial=True) if reference else ([], [])
    findings = check_before_diagnosis([*logs, *before], CheckContext(vehicle), accept)
    warnings = [*warnings, *more, *lines_of(findings)]
    logs, slow = without_slow_rotors(logs)
    before, slow_before = without_slow_rotors(before)
    warnings += [*slow, *slow_before]
    for warning in warnings:
        console.note(f"warning: {warning}")
    shown = len(warnings)
    result = diagnose(
        logs, vehicle, before, drive=drive, integrator=integrator, say=console.note, seed=seed,
        limits=limits,
    )  # fmt: skip
    found: dict[str, Any] = diagnosis_json(result)
    flown, files = result.main.source.rollouts, {"vehicle.toml", "diagnosis.json"}
    if flown is None:
        wanted = {
            "--compare-delta": compare_delta,
            "--plan": plan,
            "--fly": fly is not None,
            "--drive": drive != "auto",
            "--integrator": integrator != "auto",
        }
        unused = [flag for flag, given in wanted.items() if given]
        warnings += [f"{flag} needs rollouts, which these flights do not allow" for flag in unused]
    found["warnings"] = [*warnings, *found["warnings"]]
    if flown is not None:
        mismatches = actuator_mismatches(flown.logs, flown.vehicle, flown.limits)
        found["actuators"], found["black_box"] = actuators_json(mismatches), None
        if compare_delta:
            config = BlackBoxConfig(seed=seed)
            with console.progress("fitting the Delta Action Model", 1.0) as show:
                compared = compare_black_box(flown, result.main, config, show)
            found["black_box"] = black_box_json(compared, seed)
        if plan or truth is not None:
            folder = out / "plan"
            found["plan"] = write_plan_of(found, folder)
            if truth is not None:
                sigma = of_rollouts(result.main.search.last).noise.sigma
                found["plan"] = fly_plan(found["plan"], sigma, vehicle, truth, folder, seed)
            found["warnings"] += found["plan"].pop("warnings", [])
            files |= {"plan/plan.json"} if found["plan"].get("flights") else set()
        if recording:
            fitted = result.main.theta if result.main.names else None
            write_rollouts(out / "recording.rrd", flown, fitted)
            files.add("recording.rrd")
    found["findings"], found["not_examined"] = findings, not_examined(logs)
    found["identified"] = is_identified(vehicle_name)
    found = {**plain(found), **stamp(SCHEMA, seed)}
    toml = _vehicle_file(result.vehicle, vehicle, found, out)
    write_report(out / "report.html", page(result, found, toml, files))
    for warning in found["warnings"][shown:]:
        console.note(f"warning: {warning}")
    if found["verdict"] == "no_gap" and found["not_examined"]:
        console.note(f"not examined: {', '.join(found['not_examined'])}")
    write_json(out / "diagnosis.json", found)
    return found


def _vehicle_file(named: Vehicle, given: Vehicle, found: Mapping[str, Any], out: Path) -> str:
    """Write the vehicle with what was `named` into the folder `out`, and return the file's text."""
    names = ", ".join(effect["name"] for effect in found["effects"]) or "nothing"
    out.mkdir(parents=True, exist_ok=True)
    path = out / "vehicle.toml"
    save_vehicle(named, path, f"{given.name} with what suite diagnose named: {names}")
    return path.read_text(encoding="utf-8")
