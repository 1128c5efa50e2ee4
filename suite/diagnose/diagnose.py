"""From flights and a vehicle to a diagnosis: every source of evidence through the same steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.parameters import implausible
from suite.diagnose.sources.examine import examine, one_cause, without_names
from suite.diagnose.sources.rollout_source import late_by
from suite.diagnose.sources.rollouts import by_rollouts
from suite.diagnose.sources.source import Finding, Given, Source, Sources
from suite.diagnose.sources.views import by_views
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import integrator_of
from suite.diagnose.verdict.diagnosis import Diagnosis, tested_in, verdict_on, with_names

SOURCES: dict[str, Callable[[Given, Sequence[Source]], Sources | None]] = {
    "rollouts": by_rollouts,
    "views": by_views,
}
"""What makes evidence of flights, by name. Each is given the sources of those before it, and
returns None where it has nothing to add to them."""


def diagnose(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    references: Sequence[FlightLog] = (),
    *,
    by: str = "auto",
    drive: str = "auto",
    integrator: str = "auto",
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
) -> Diagnosis:
    """Find what explains how `logs` differ from `vehicle`, or from `references` of it.

    Args:
        logs: flights; a fifth of them, at least one, is held out (of a lone flight, the last
            30 %).
        vehicle: the one that the simulation used.
        references: flights of the same vehicle before what changed.
        by: the source of evidence, one of `SOURCES`, or "auto": all that the logs allow.
        drive: what the model's input is: "commands", "motors", or "auto".
        integrator: how the flights' bodies were moved: "continuous", as every real one, "euler",
            as MuJoCo's steps of the rate loop's period do it, or "auto": what the logs have.
        say: receives a line for people about each step.
        seed: of the null's draws.
        limits: of every step.

    Raises:
        ValueError: where no flight can be used, or not in the way that was chosen.
    """
    began = time.monotonic()
    if by not in ("auto", *SOURCES):
        raise ValueError(f"by = {by!r}; allowed: {', '.join(('auto', *SOURCES))}")
    chosen = by != "auto"
    given = Given(logs, vehicle, references, drive, integrator, say, limits, chosen)
    makers = [make for name, make in SOURCES.items() if by in ("auto", name)]
    found = _diagnosed(given, makers, seed)
    flown = found.main.source.rollouts
    if integrator == "auto" and flown and integrator_of(logs, "auto") == "continuous":
        if found.main.source.stepped(found.main.search):
            say("pose and rates are apart by half a step: once more, as MuJoCo's Euler steps")
            again = replace(given, integrator="euler", chosen=True)
            stepped = _diagnosed(again, makers[:1], seed)
            if not late_by(stepped.main.search):
                words = "flown as if by MuJoCo's Euler steps, which explain half a step between "
                words += "pose and rates; --integrator continuous does without"
                found = replace(stepped, warnings=[*stepped.warnings, words])
    return replace(found, seconds=time.monotonic() - began)


def _diagnosed(
    given: Given, makers: Sequence[Callable[[Given, Sequence[Source]], Sources | None]], seed: int
) -> Diagnosis:
    """Return the diagnosis by the sources that `makers` make."""
    flights = Sources((), (), "")
    for make in makers:
        more = make(given, flights.sources)
        flights = flights if more is None else flights.joined(more)
    findings, warnings = list[Finding](), list(flights.warnings)
    for source in flights.sources:
        finding, notes = examine(source, findings, given.say, seed)
        findings.append(finding)
        warnings += notes
    found, notes = one_cause(findings)
    warnings += notes
    tested, limits = tested_in(found, flights), found[0].source.limits
    verdict = verdict_on(found, bool(tested or any(one.names for one in found)), limits)
    names = [name for one in found for name in one.names]
    if verdict.label == "unknown" and names:
        labels = ", ".join(name.candidate.label for name in names)
        warnings.append(f"nearest in the catalogue, but it leaves most of the gap: {labels}")
        found = tuple(without_names(one, seed) if one.names else one for one in found)
        tested = tested_in(found, flights)
        verdict = verdict_on(found, bool(tested), limits)
    for one in found:
        for name in one.names:
            far = implausible(one.source.space, one.theta, name.candidate, limits)
            warnings += [f"implausible: {words}, beyond three times what is usual" for words in far]
    return Diagnosis(
        verdict=verdict,
        findings=found,
        flights=flights,
        nominal=given.vehicle,
        vehicle=with_names(given.vehicle, found, tested),
        references=tuple(log.name for log in given.references),
        warnings=warnings,
        seconds=0.0,
        seed=seed,
    )
