"""From flights and a vehicle to a diagnosis: every source through the same steps, one verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.parameters import ParameterSpace, implausible, with_fitted
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.examine import examine, one_cause, without_names
from suite.diagnose.sources.rollout_source import late_by
from suite.diagnose.sources.rollouts import by_rollouts
from suite.diagnose.sources.source import Finding, Given, Source, Sources, TestedEffect
from suite.diagnose.sources.views import by_views
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import integrator_of

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


class Verdict(NamedTuple):
    """A verdict and its reasons."""

    label: str
    """no_gap, named, partly or unknown."""
    share_left: float = 0.0
    """What is left of the gap on held-out flights [1]."""
    where: str | None = None
    """What the remaining error goes with, in words."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and what it was found from."""

    verdict: Verdict
    findings: tuple[Finding, ...]
    """By source, in their order."""
    flights: Sources
    nominal: Vehicle
    """The vehicle that the simulation used."""
    vehicle: Vehicle
    """With the named effects in place of what the nominal one has of them."""
    references: tuple[str, ...]
    """Names of the flights before a change, where one was searched for."""
    warnings: list[str]
    seconds: float
    seed: int
    """Of all draws."""

    @property
    def label(self) -> str:
        """no_gap, named, partly or unknown."""
        return self.verdict.label

    @property
    def main(self) -> Finding:
        """The finding that shows most."""
        return main_of(self.findings)

    @property
    def named(self) -> list[tuple[Finding, NamedEffect]]:
        """Every name that stands, with what found it."""
        return [(finding, name) for finding in self.findings for name in finding.names]

    @property
    def tested(self) -> tuple[TestedEffect, ...]:
        """The effects that were named by tests of their own."""
        return tested_in(self.findings, self.flights)

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's parameters."""
        return self.main.source.space

    @property
    def limits(self) -> Thresholds:
        """By what it was judged."""
        return self.main.source.limits


def main_of(findings: Sequence[Finding]) -> Finding:
    """Return the finding that shows most: one with names, else where most can be explained."""
    return max(findings, key=lambda one: (bool(one.names), one.remaining.explainable))


def tested_in(findings: Sequence[Finding], flights: Sources) -> tuple[TestedEffect, ...]:
    """Return the effects that were named by tests of their own."""
    winds = [one.remaining.wind for one in findings]
    return (*(wind for wind in winds if wind is not None), *flights.tested)


def verdict_on(findings: Sequence[Finding], named: bool, limits: Thresholds) -> Verdict:
    """Return the verdict: on the sources that name something, or on all where none does.

    `named` is whether an effect was named, in the search or by a test of its own. An oscillating
    force always remains: no fitted parameter reproduces it.
    """
    judged = [one for one in findings if one.names] or findings
    swings = [one.remaining.swing for one in findings if one.remaining.swing]
    share = main_of(findings).remaining.share
    if not swings and not any(one.remaining.structured for one in judged):
        return Verdict("named" if named else "no_gap", share)
    worst = max(findings, key=lambda one: one.remaining.share).remaining.where
    where = "; ".join([*(swing.words for swing in swings), *([worst] if worst else [])])
    partly = named and share <= limits.unexplained_share
    return Verdict("partly" if partly else "unknown", share, where)


def with_names(
    nominal: Vehicle, findings: Sequence[Finding], tested: Sequence[TestedEffect]
) -> Vehicle:
    """Return the vehicle with what was named in place of what it has of it."""
    space = findings[0].source.space
    theta, names = np.array(space.array("start")), list[str]()
    for one in findings:
        for name in one.names:
            at = list(name.candidate.indices)
            theta[at] = one.theta[at]
            names.append(name.candidate.name)
    return with_fitted(nominal, space, theta, names, {one.name: one.values for one in tested})
