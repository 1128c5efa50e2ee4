"""Check a policy's contract and flight logs, and name probable faults (`suite check`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from eval.judging.policy_checks.faults import notes_of, notes_of_file, unused_inputs
from eval.judging.policy_checks.in_flight import Watched, action_report
from eval.logs.columns import FlightLogError
from eval.logs.faults.check import (
    CheckContext,
    check_files,
    check_log,
    not_identifiable,
    with_fixes,
)
from eval.logs.faults.finding import Finding, finding_lines
from eval.logs.faults.vehicle import check_same_vehicle
from eval.logs.flight_log import flight_files, read_flights, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from policies.contract import contract_of, summary
from policies.policy import Policy, load_policy
from policies.spec import Note
from suite.common.console import Console, counted
from suite.judging.flying import fly_trials
from suite.judging.requests import SimulatedFlights
from suite.judging.trials import read_trial_set
from tracks.common.files import check_no_input

TIME_LIMIT_S = 5.0
"""Time limit of the short flights that show a policy's actions [s]."""
LEAST_FLIGHTS = 3
"""Smallest number of short flights in which too few gates are a fault."""
USUAL = "race"
"""The policy with whose gates those of another one are compared."""
UNCLEAR = {"action_limited"}
"""Faults next to which too few gates may have another cause."""


def check_policy(
    name: str, trust: bool, trials: int, console: Console
) -> tuple[Policy, dict[str, Any]]:
    """Return the policy, and the command's answer: its contract and the findings about it.

    The policy shows its actions in short flights, `trials` of them, perhaps none.

    Raises:
        ValueError: if the policy is refused.
    """
    policy = load_policy(name, trust)
    findings = policy_findings(policy, trials, console)
    for finding in findings:
        console.say(f"{finding.status}: {finding.evidence}; {finding.fix}")
    memory = getattr(policy, "hidden_shape", None)
    contract = contract_of(policy.spec, () if memory == (0,) else memory).to_json()
    records = [finding._asdict() for finding in findings]
    return policy, {"policy": policy.name, "contract": contract, "findings": records}


def check_flight_files(
    flights: Sequence[Path], vehicle: str, policy: Policy | None, out: Path | None, console: Console
) -> dict[str, Any]:
    """Return the command's answer about flights and a vehicle file: the findings about them.

    The rate and camera of a `policy` are compared with those of the flights. `out` is a folder for
    the corrected flights; None writes nothing. `vehicle` may be "" for none.

    Raises:
        ValueError: for invalid files.
    """
    # Check the files, then each flight; write the corrected flights.
    spec = None if policy is None else policy.spec
    context = CheckContext(
        load_vehicle(vehicle) if vehicle else None,
        None if spec is None else spec.rate_hz,
        None if spec is None else spec.camera,
    )
    all_findings: list[tuple[Finding, str | None]] = [(f, None) for f in check_files(context)]
    files = flight_files(flights) if flights else []
    if out is not None:
        _check_outputs(files, out)
    logs, warnings = read_flights(files, partial=True, limits=False) if files else ([], [])
    for warning in warnings:
        console.note(f"warning: {warning}")
    all_findings += check_same_vehicle(logs)
    written = []
    for log in logs:
        findings, readings = check_log(log, context, out is not None)
        all_findings += [(finding, log.name) for finding in findings]
        if out is not None:
            path = out / Path(log.name).name
            records = [finding._asdict() for finding in findings]
            fixed = with_fixes(log, readings)
            fixed = replace(fixed, about={**fixed.about, "findings": records})
            try:
                written.append(str(write_flight(path, fixed)))
            except FlightLogError as error:
                console.note(f"warning: not written: {error}")
    # Print the findings about the files (flight None), then those about each flight.
    for name in (None, *(log.name for log in logs)):
        problems = [
            finding for finding, flight in all_findings if flight == name and finding.status != "ok"
        ]
        for text in finding_lines(problems):
            console.say((f"{name}: " if len(logs) > 1 and name else "") + text)
    unseen = not_identifiable([finding for finding, _ in all_findings])
    for manoeuvre in dict.fromkeys(one["manoeuvre"] for one in unseen):
        faults = [one["fault"] for one in unseen if one["manoeuvre"] == manoeuvre]
        console.say(f"to check {', '.join(faults)}: {manoeuvre}")
    if written:
        console.say(f"written: {', '.join(written)}")
    return {
        "flights": [log.name for log in logs],
        "vehicle": vehicle or None,
        "findings": [{**finding._asdict(), "flight": flight} for finding, flight in all_findings],
        "not_identifiable": unseen,
        "written": written,
    }


def _check_outputs(files: Sequence[Path], out: Path) -> None:
    """Refuse flights whose correction in `out` would overwrite a flight or another correction."""
    names: dict[str, Path] = {}
    for file in files:
        check_no_input(out / file.name, files)
        if file.name in names:
            raise ValueError(
                f"{names[file.name]} and {file}: both would be written to {out / file.name}; "
                "rename one of them, or correct them one at a time with another --out each"
            )
        names[file.name] = file


def policy_findings(policy: Policy, trials: int, console: Console) -> list[Finding]:
    """Return the findings about a policy's interface.

    The policy shows its actions in short flights, `trials` of them, perhaps none.
    """
    console.say(f"{policy.name}: {summary(contract_of(policy.spec))}")
    of_file = notes_of_file(policy) or ()
    findings = [
        _finding("contract" if note in of_file else note.fault.split("_")[0], note)
        for note in notes_of(policy)
    ]
    known = {finding.fault for finding in findings}
    warnings, hints = _warnings_in_flight(policy, trials, console, known)
    findings += [_finding("action", warning) for warning in warnings]
    findings += [_finding("memory", hint, "note") for hint in hints]
    return findings + [_finding("input", note, "note") for note in unused_inputs(policy)]


def _warnings_in_flight(
    policy: Policy, trials: int, console: Console, known: set[str]
) -> tuple[list[Note], list[Note]]:
    """Return probable faults of the actions in a few short flights, and hints.

    The faults `known` are left out. Few gates, or few flights without contact, are a fault if
    there is no other one.
    """
    if not trials:
        return [], []
    request = SimulatedFlights("random", "0", trials, 500_000, "racer5", TIME_LIMIT_S)
    watched = Watched(policy)
    tracks = read_trial_set(request)
    results = fly_trials(watched, request, tracks)
    actions = action_report(results, policy.spec.action, known)
    if not actions["decisions"]:
        return [], []
    share, count = actions["limited"], actions["decisions"]
    console.say(f"{share:.1%} of {count} actions were limited in {counted(trials, 'flight')}")
    warnings = [*actions["warnings"], *watched.doubts()]
    if missing := sum(row.late_actions for row in results):
        text = f"in {missing} of {counted(trials, 'flight')} it gave no action"
        fix = "correct the error in the warning, and export it again"
        warnings.append(Note("action_missing", text, fix))
    gates = sum(row.gates_passed for row in results)
    ended = Counter("in flight" if row.ended_by == "timeout" else row.ended_by for row in results)
    endings = ", ".join(f"{number} {ending}" for ending, number in ended.items())
    flown = f"{counted(trials, 'flight')} of {TIME_LIMIT_S:g} s at level 0"
    text = f"in {flown} it passed {counted(gates, 'gate')}"
    console.say(f"{text}; at the end: {endings}")
    others = known | {warning.fault for warning in warnings} - UNCLEAR
    unharmed = ended["in flight"] + ended["finished"]
    if trials >= LEAST_FLIGHTS and not others and (gates < trials or 2 * unharmed <= trials):
        usual = sum(row.gates_passed for row in fly_trials(load_policy(USUAL), request, tracks))
        text = f"{text} ({endings}); {USUAL} passes {usual}"
        fix = (
            "compare units, axes, signs and order of its state, image and action with the "
            "contract above; after a very short training this is no fault"
        )
        warnings.append(Note("few_gates" if gates else "no_gate", text, fix))
    return warnings, watched.hints()


def _finding(signal: str, note: Note, status: str = "doubt") -> Finding:
    """Return a note about a policy as a finding."""
    return Finding(status, signal, note.evidence, note.fault, fix=note.fix)
