"""Reads flight logs, diagnoses them, and writes the results: JSON, vehicle file, report, plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from eval.logs.faults.check import CheckContext, check_before_diagnosis, lines_of, not_examined
from eval.logs.flight_log import read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
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
    """Diagnose flights in files, and write the results.

    Args:
        paths: flight logs, or folders of them.
        vehicle_name: path of a vehicle file, or name of a shipped one.
        out: folder for the files.
        console: for progress and warnings.
        drive: what drives the model: "auto", "commands" or "motors" (measured rotor speeds).
        integrator: integration of the bodies: "auto", "continuous" or "euler" (MuJoCo's steps).
        compare_delta: fit a Delta Action Model (a network that corrects the dynamics) to the same
            flights and compare it.
        plan: write flights that separate effects which these flights do not.
        fly: vehicle with which the plan is flown in simulation, if any.
        recording: write a recording for rerun.
        seed: seed of all random draws.
        reference: flights of the same vehicle before a change, to find that change.
        relevance: least force [m/s^2], torque [rad/s^2] and drift after a second [m] of an effect
            that is named.
        accept: names of interface faults (wrong units, signs, clocks) that do not stop the command.

    Returns:
        The content of diagnosis.json.

    Raises:
        ValueError: if flights or vehicle file cannot be used.
    """
    # Read the files, and check the logs for faults of interfaces.
    limits = replace(THRESHOLDS, relevance=relevance)
    vehicle = load_vehicle(vehicle_name)
    refuse_own_motion(vehicle)
    truth = None if fly is None else load_vehicle(fly)
    logs, warnings = read_flights(flight_files(paths), partial=True)
    # `before` are the reference flights, before a change.
    before, notes = read_flights(flight_files(reference), partial=True) if reference else ([], [])
    findings = check_before_diagnosis([*logs, *before], CheckContext(vehicle), accept)
    warnings = [*warnings, *notes, *lines_of(findings)]
    logs, slow = without_slow_rotors(logs)
    before, slow_before = without_slow_rotors(before)
    warnings += [*slow, *slow_before]
    for warning in warnings:
        console.note(f"warning: {warning}")
    shown_count = len(warnings)
    diagnosis = diagnose(
        logs, vehicle, before, drive=drive, integrator=integrator, say=console.note, seed=seed,
        limits=limits,
    )  # fmt: skip
    result: dict[str, Any] = diagnosis_json(diagnosis)
    # Some options need rollouts. `flown` has them, and is None if only force and torque were used.
    flown, files = diagnosis.main.source.rollouts, {"vehicle.toml", "diagnosis.json"}
    if flown is None:
        wanted = {
            "--compare-delta": compare_delta,
            "--plan": plan,
            "--fly": fly is not None,
            "--drive": drive != "auto",
            "--integrator": integrator != "auto",
        }
        unused = [flag for flag, is_given in wanted.items() if is_given]
        warnings += [f"{flag} needs rollouts, which these flights do not allow" for flag in unused]
    result["warnings"] = [*warnings, *result["warnings"]]
    if flown is not None:
        mismatches = actuator_mismatches(flown.logs, flown.vehicle, flown.limits)
        result["actuators"], result["black_box"] = actuators_json(mismatches), None
        if compare_delta:
            config = BlackBoxConfig(seed=seed)
            with console.progress("fitting the Delta Action Model", 1.0) as show:
                compared = compare_black_box(flown, diagnosis.main, config, show)
            result["black_box"] = black_box_json(compared, seed)
        if plan or truth is not None:
            folder = out / "plan"
            result["plan"] = write_plan_of(result, folder)
            if truth is not None:
                sigma = of_rollouts(diagnosis.main.search.last).noise.sigma
                result["plan"] = fly_plan(result["plan"], sigma, vehicle, truth, folder, seed)
            result["warnings"] += result["plan"].pop("warnings", [])
            files |= {"plan/plan.json"} if result["plan"].get("flights") else set()
        if recording:
            fitted = diagnosis.main.theta if diagnosis.main.names else None
            write_rollouts(out / "recording.rrd", flown, fitted)
            files.add("recording.rrd")
    # Write the results.
    result["findings"], result["not_examined"] = findings, not_examined(logs)
    result["identified"] = is_identified(vehicle_name)
    result = {**plain(result), **stamp(SCHEMA, seed)}
    names = ", ".join(effect["name"] for effect in result["effects"]) or "none"
    out.mkdir(parents=True, exist_ok=True)
    header = f"{vehicle.name} with the effects that suite diagnose named: {names}"
    save_vehicle(diagnosis.vehicle, out / "vehicle.toml", header)
    toml = (out / "vehicle.toml").read_text(encoding="utf-8")
    write_report(out / "report.html", page(diagnosis, result, toml, files))
    for warning in result["warnings"][shown_count:]:
        console.note(f"warning: {warning}")
    if result["verdict"] == "no_gap" and result["not_examined"]:
        console.note(f"not examined: {', '.join(result['not_examined'])}")
    write_json(out / "diagnosis.json", result)
    return result
