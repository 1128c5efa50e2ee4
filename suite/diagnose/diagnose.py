"""Diagnoses a vehicle file: finds the physical effects that explain how flights differ from it.

Each source of evidence (whole flights in rollouts of 1 s, forces, torques) goes through the same
steps (`sources/examine.py`). One verdict follows from all their findings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.parameters import implausible
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.examine import examine, one_cause, without_names
from suite.diagnose.sources.rollout_source import pose_delays, rollouts_of
from suite.diagnose.sources.rollouts import by_rollouts
from suite.diagnose.sources.source import DiagnosisInput, Finding, SourceSet
from suite.diagnose.sources.views import by_views
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import TestedEffect, integrator_of

SOURCES: dict[str, Callable[[DiagnosisInput], SourceSet | None]] = {
    "rollouts": by_rollouts,
    "views": by_views,
}
"""Functions that make the sources of evidence, by name; the first that makes any counts."""


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
    """Find the effects that explain how `logs` differ from `vehicle`, or from `references`.

    Args:
        logs: flights; a fifth of them, at least one, is held out (of a single flight, the last
            30 %).
        vehicle: the vehicle that the simulation used.
        references: flights of the same vehicle before a change, to find that change.
        by: the source of evidence, one of `SOURCES`, or "auto" for all that the logs allow.
        drive: what drives the model: "commands", "motors" (measured rotor speeds), or "auto".
        integrator: integration of the flights' bodies: "continuous" for real ones, "euler" for
            MuJoCo's steps, or "auto" for the one that the logs state.
        say: receives a line of progress for people.
        seed: seed of all random draws.
        limits: thresholds of every step.

    Raises:
        ValueError: if no flight can be used, or not with the chosen source or drive.
    """
    start_s = time.monotonic()
    if by not in ("auto", *SOURCES):
        raise ValueError(f"by = {by!r}; allowed: {', '.join(('auto', *SOURCES))}")
    chosen = by != "auto"
    given = DiagnosisInput(logs, vehicle, references, drive, integrator, say, limits, chosen)
    names = [name for name in SOURCES if by in ("auto", name)]
    result = _diagnose(given, names, seed)
    main = result.main
    # A delay of half a step between pose and rates is how MuJoCo integrates, not a fault. If that
    # explains the named effects, repeat the diagnosis with its integrator.
    is_continuous = integrator == "auto" and integrator_of(logs, "auto") == "continuous"
    longest_s = limits.integrator_share * (1.0 / vehicle.controller.frequency)
    delays_s = pose_delays(main.search).values() if rollouts_of(main) else ()
    if is_continuous and any(abs(delay_s) <= longest_s for delay_s in delays_s):
        say("pose and rates differ by half a step: repeating with MuJoCo's Euler steps")
        euler = _diagnose(replace(given, integrator="euler", chosen=True), names[:1], seed)
        if not pose_delays(euler.main.search):
            words = (
                "MuJoCo's Euler steps explain half a step between pose and rates, so the model "
                "uses them; --integrator continuous prevents this"
            )
            result = replace(euler, warnings=[*euler.warnings, words])
    return replace(result, seconds=time.monotonic() - start_s)


def _diagnose(given: DiagnosisInput, by: Sequence[str], seed: int) -> Diagnosis:
    """Return the diagnosis with the first sources of those named in `by`."""
    warnings = list[str]()
    for flights in filter(None, (SOURCES[name](given) for name in by)):
        warnings += flights.warnings
        if flights.sources:
            break
    # Search and test with each source; `findings` holds those of the sources before it.
    findings = list[Finding]()
    for source in flights.sources:
        finding, notes = examine(source, findings, given.say, seed)
        findings.append(finding)
        warnings += notes
    unique, notes = one_cause(findings)
    warnings += notes
    tested, limits = tested_in(unique, flights, given.vehicle), unique[0].source.limits
    names = [named for finding in unique for named in finding.names]
    verdict = verdict_on(unique, bool(tested or names), limits)
    # Effects that leave most of the gap are not the cause: remove them, and decide again.
    if verdict.label == "unknown" and names:
        wrong = [one for one in deciding(unique) if one.remaining.share > limits.unexplained_share]
        labels = ", ".join(named.candidate.label for one in wrong for named in one.names)
        warnings.append(f"nearest in the catalogue, but most of the gap remains: {labels}")
        unique = tuple(without_names(one, seed) if one in wrong else one for one in unique)
        tested = tested_in(unique, flights, given.vehicle)
        if not any(one.names for one in unique):
            verdict = verdict_on(unique, bool(tested), limits)
    if verdict.label == "unknown" and (tested or any(one.names for one in unique)):
        verdict = verdict._replace(label="partly")
    warnings += [
        f"implausible: {words}, over three times the usual size"
        for finding in unique
        for named in finding.names
        for words in implausible(finding.source.space, finding.theta, named.candidate, limits)
    ]
    return Diagnosis(
        verdict=verdict,
        findings=unique,
        tested=tested,
        flights=flights,
        vehicle=with_names(given.vehicle, unique, tested),
        warnings=warnings,
        seconds=0.0,
        seed=seed,
    )


class Verdict(NamedTuple):
    """A verdict and its reasons."""

    label: str
    """One of no_gap, named, partly and unknown."""
    share_left: float = 0.0
    """Share of the gap on held-out flights that remains with the named effects."""
    where: str | None = None
    """For people: quantity that the remaining error depends on."""


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis."""

    verdict: Verdict
    findings: tuple[Finding, ...]
    """One finding for each source, in the order of the sources."""
    tested: tuple[TestedEffect, ...]
    """The effects that separate tests named."""
    flights: SourceSet
    """The sources of evidence from these flights."""
    vehicle: Vehicle
    """The vehicle that the simulation used, with the named effects."""
    warnings: list[str]
    seconds: float
    """Duration of the diagnosis [s]."""
    seed: int
    """Seed of all random draws."""

    @property
    def main(self) -> Finding:
        """The finding whose gap is reported, see `main_of`."""
        return main_of(self.findings)

    @property
    def named(self) -> list[tuple[Finding, NamedEffect]]:
        """Every named effect, with its finding."""
        return [(finding, named) for finding in self.findings for named in finding.names]


def main_of(findings: Sequence[Finding]) -> Finding:
    """Return a finding with names, or any if none has; of these, one that is more than noise.

    Of several, it is the one that a black box explains best.
    """

    def rank(one: Finding) -> tuple[bool, bool, float]:
        return bool(one.names), one.remaining.structured, one.remaining.explainable

    return max(findings, key=rank)


def tested_in(
    findings: Sequence[Finding], flights: SourceSet, vehicle: Vehicle
) -> tuple[TestedEffect, ...]:
    """Return the effects that separate tests found, and that the file of `vehicle` lacks.

    They are random wind and rotor lag. No simulation reproduces the course of a random wind, so
    that of the file is found in every flight.
    """
    found = (*filter(None, (one.remaining.wind for one in findings)), *flights.tested)
    return tuple(effect for effect in found if not effect.is_in(vehicle))


def verdict_on(findings: Sequence[Finding], named: bool, limits: Thresholds) -> Verdict:
    """Return the verdict by the `deciding` findings; `named` is whether an effect was named.

    An oscillating force (swing) always counts as unexplained, since no parameter reproduces it.
    """
    swings = [one.remaining.swing for one in findings if one.remaining.swing]
    worst = max((one.remaining for one in deciding(findings)), key=lambda one: one.share)
    if not swings and not worst.structured:
        return Verdict("named" if named else "no_gap", worst.share)
    words = [swing.words for swing in swings]
    words += [worst.where] if worst.structured and worst.where else []
    partly = named and worst.share <= limits.unexplained_share
    return Verdict("partly" if partly else "unknown", worst.share, "; ".join(words))


def deciding(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings whose remaining error decides the verdict, or else the main finding.

    They are those with more than noise among the findings with named effects, or among all if none
    names an effect.
    """
    judged = [one for one in findings if one.names] or findings
    return [one for one in judged if one.remaining.structured] or [main_of(findings)]


def with_names(
    nominal: Vehicle, findings: Sequence[Finding], tested: Sequence[TestedEffect]
) -> Vehicle:
    """Return the nominal vehicle with the named effects; these replace effects that it has."""
    space = findings[0].source.space
    theta, names = np.array(space.array("start")), list[str]()
    for finding in findings:
        for named in finding.names:
            indices = list(named.candidate.indices)
            theta[indices] = finding.theta[indices]
            names.append(named.candidate.name)
    fitted, effects = space.effects(theta), dict(nominal.effects)
    for name in names:
        values = (np.asarray(value, dtype=float) for value in fitted[name])
        plain = (tuple(v.tolist()) if v.ndim else float(v) for v in values)
        effects[name] = type(fitted[name])(*plain)
    effects |= {one.name: one.values for one in tested}
    ordered = {name: effects[name] for name in EFFECTS if name in effects}
    return replace(nominal, effects=MappingProxyType(ordered))
