"""The result of a diagnosis: what each source found, and the one verdict on all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.parameters import ParameterSpace, with_fitted
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.source import Finding, Sources, TestedEffect
from suite.diagnose.thresholds import Thresholds


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
