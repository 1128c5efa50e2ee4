"""Reads flight logs, diagnoses them, and writes the results: JSON, vehicle file, report, plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from eval.logs.faults.check import CheckContext
from eval.logs.faults.checked import read_checked
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.common.console import Console
from suite.common.provenance import refuse_foreign, refuse_other_run, write_run_record
from suite.common.report import html
from suite.common.stages import changed_options
from suite.diagnose.config import Config
from suite.diagnose.data.sampling import without_slow_rotors
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import refuse_own_motion
from suite.diagnose.identify.run import is_identified
from suite.diagnose.plan import remove_plan, trajectories_for, write_plan
from suite.diagnose.report.charts import write_rollouts
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.sources.rollout_source import rollouts_of
from suite.diagnose.sources.stretches import LACKING
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.actuators import actuator_mismatches
from tracks.common.files import check_no_input, plain, write_json, write_text
from tracks.common.provenance import first_changes, stamp

MARK = "with the effects that suite diagnose named"
"""Mark in the first line of a vehicle file that this command wrote."""
SCHEMA = 1
"""Version of diagnosis.json."""


def diagnose_files(config: Config, console: Console) -> dict[str, Any]:
    """Diagnose flights in files, write the results, and return the content of diagnosis.json.

    Raises:
        ValueError: if flights or vehicle file cannot be used.
    """
    out = config.out
    refuse_other_run(out, config)
    check_no_input(out / "vehicle.toml", [config.vehicle])
    refuse_foreign(out / "vehicle.toml", MARK)
    vehicle = load_vehicle(config.vehicle)
    refuse_own_motion(vehicle)
    # Read the files, and check the logs for faults of interfaces.
    flights = read_checked(
        config.flights, CheckContext(vehicle), config.accept, config.reference, partial=True
    )
    # A diagnosis is quick to repeat, and often repeated with one option more: no refusal.
    if changes := changed_options(out, config):
        console.note(
            f"{out} holds a diagnosis with other options ({first_changes(changes)}), which will be "
            "overwritten; give another --out to keep it"
        )
    logs, slow = without_slow_rotors(flights.logs)
    before, slow_before = without_slow_rotors(flights.earlier)
    warnings = [*flights.warnings, *slow, *slow_before]
    for warning in warnings:
        console.note(f"warning: {warning}")
    shown_count = len(warnings)
    diagnosis = diagnose(
        logs,
        vehicle,
        before,
        drive=config.drive,
        integrator=config.integrator,
        say=console.note,
        seed=config.seed,
        limits=replace(THRESHOLDS, relevance=config.relevance),
    )
    result: dict[str, Any] = diagnosis_json(diagnosis)
    # Some options need rollouts. `flown` has them, and is None if only force and torque were used.
    flown, files = rollouts_of(diagnosis.main), {"vehicle.toml", "diagnosis.json"}
    rollouts = flown.simulated(diagnosis.main.search) if flown else None
    if flown is None:
        wanted = {"--drive": config.drive != "auto", "--integrator": config.integrator != "auto"}
        unused = [flag for flag, is_given in wanted.items() if is_given]
        warnings += [f"{flag} needs rollouts, which these flights do not allow" for flag in unused]
    result["warnings"] = [*warnings, *result["warnings"]]
    if flown and rollouts:
        if LACKING not in result["warnings"]:  # rotor speeds follow all commands
            mismatches = actuator_mismatches(flown.logs, flown.vehicle, flown.limits)
            result["actuators"] = [mismatch._asdict() for mismatch in mismatches]
        if not config.no_recording:
            write_rollouts(out / "recording.rrd", flown, rollouts)
            files.add("recording.rrd")
    if config.plan:
        result["plan"] = write_plan(out / "plan", *trajectories_for(result))
        files |= {"plan/plan.json"} if result["plan"]["flights"] else set()
    result["findings"] = flights.findings
    result["identified"] = is_identified(config.vehicle)
    result = {**plain(result), **stamp(SCHEMA, config.seed)}
    names = ", ".join(effect["name"] for effect in result["effects"]) or "none"
    out.mkdir(parents=True, exist_ok=True)
    header = f"{vehicle.name} {MARK}: {names}"
    save_vehicle(diagnosis.vehicle, out / "vehicle.toml", header)
    toml = (out / "vehicle.toml").read_text(encoding="utf-8")
    report = page(diagnosis, result, toml, files, rollouts)
    write_text(out / "report.html", html(report, config.seed))
    for warning in result["warnings"][shown_count:]:
        console.note(f"warning: {warning}")
    # Remove what only an earlier diagnosis in this folder has written.
    if "recording.rrd" not in files:
        (out / "recording.rrd").unlink(missing_ok=True)
    if not config.plan:
        remove_plan(out / "plan")
    write_json(out / "diagnosis.json", result)
    write_run_record(out, config, config.seed)
    return result
