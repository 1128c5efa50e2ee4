"""What a search sees of its evidence at one estimate, and how candidates are fitted there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate, NormalEquations
from suite.diagnose.estimate.composites import acts_through, begin_of, inactive_at
from suite.diagnose.estimate.gauss_newton import chi2_by_part, fit, gauss_newton_step, intervals95
from suite.diagnose.estimate.parameters import Candidate, indices_of
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.evidence import Evidence


@dataclass(frozen=True)
class NamedEffect:
    """One effect that was named."""

    candidate: Candidate
    p_value: float
    gain: float
    """Fall of chi-square on stretches left out when it is added last."""
    rivals: tuple[str, ...] = ()
    """Names that explain the same."""
    worse_by: dict[str, float] = field(default_factory=dict)
    """By label of what was fitted in its place: rise of chi-square, with one for each number."""
    gains: tuple[float, ...] = ()
    """Fall of the squared error of each flight that the others' fit brings."""
    share: float = 0.0
    """Of the squared error that was to be explained [1]."""


class Evaluation(NamedTuple):
    """What the evidence gives at one estimate."""

    evidence: Evidence
    at: Estimate
    block: Block

    @property
    def equations(self) -> NormalEquations:
        """The block's sums."""
        return self.block.equations


def evaluated_at(
    found: tuple[Evidence, Block], at: Estimate, among: Sequence[Candidate] = ()
) -> Evaluation:
    """Return what evidence gives at an estimate, with columns of what acts through composites."""
    evidence, block = found
    inactive = inactive_at(evidence.space, at.theta, among, block.acts())
    if inactive is not None:
        numbers = inactive.numbers
        there = evidence.linearise(Estimate(inactive.theta, at.free), numbers)
        columns = [there.along.index(number) for number in numbers]
        block = replace(
            block,
            slope=np.concatenate([block.slope, there.slope[..., columns]], axis=-1),
            free_slope=np.concatenate([block.free_slope, there.free_slope[..., columns]], axis=-1),
            along=(*block.along, *numbers),
        )
    return Evaluation(evidence, at, block)


def fit_with(
    here: Evaluation, others: Sequence[int], candidate: Candidate
) -> tuple[Estimate, Block]:
    """Fit `candidate` and the numbers at `others`, from where `here` was taken."""
    evidence, equations, limits = here.evidence, here.equations, here.evidence.limits
    at, space, theta = sorted({*others, *candidate.indices}), evidence.space, here.at.theta
    inactive = [number for number in equations.repeated() if number in candidate.indices]
    if not candidate.parts or not inactive:
        rounds = limits.bilinear_rounds if acts_through(candidate) else None
        return fit(evidence, here.at, at, rounds, here.block, limits)
    change, informed = wanted_change(here, others, candidate)
    begin = begin_of(space, theta, candidate, inactive, change, informed)
    return fit(evidence, Estimate(begin, here.at.free), at, limits.bilinear_rounds, None, limits)


def wanted_change(
    here: Evaluation, others: Sequence[int], candidate: Candidate
) -> tuple[np.ndarray, np.ndarray]:
    """Return the change (P,) of all numbers by the slopes, and the information on each (P,).

    Those of `candidate` and at `others` are changed.
    """
    equations = here.equations
    some = equations.take(sorted({*others, *equations.columns_of(candidate)}))
    moved, _ = gauss_newton_step(some, here.at.theta, here.evidence.space)
    change, informed = np.zeros_like(here.at.theta), np.zeros_like(here.at.theta)
    numbers = list(some.numbers)
    change[numbers], informed[numbers] = moved, np.diag(some.sums()[0])
    return change, informed


def chi2_of(here: Evaluation, block: Block, at: Estimate, indices: Sequence[int]) -> np.ndarray:
    """Return the squared error (G,) of each part of the flights under the others' fit."""
    equations = block.equations.along_numbers(sorted(indices))
    return chi2_by_part(equations, at.theta, here.evidence.space, here.evidence.parts(block))


@dataclass(frozen=True)
class SearchResult:
    """What a search found."""

    named: tuple[NamedEffect, ...]
    start: Estimate
    """Where it began."""
    last: Evaluation
    """At the fit of all names, weighed by the noise that was measured with them."""
    judged: Evaluation
    """The same, by which names, rivals and intervals were judged: where the model leaves more than
    noise, the noise is what it leaves."""
    first: list[CandidateScore]
    """Scores of all candidates before anything was named, best first."""
    explained: float
    """Fall of chi-square that the named effects bring."""

    @property
    def estimate(self) -> Estimate:
        """Where the numbers stand with all names."""
        return self.last.at

    @property
    def candidates(self) -> list[Candidate]:
        """What was named, without the reasons."""
        return [one.candidate for one in self.named]

    @property
    def indices(self) -> list[int]:
        """Places in the vector of the named numbers."""
        return indices_of(self.candidates)

    @property
    def moved(self) -> np.ndarray:
        """(K,) how far the named numbers are from where they began."""
        return (self.estimate.theta - self.start.theta)[self.indices]

    def half_widths(self) -> np.ndarray:
        """Return half-widths (K,) of the 95 % intervals of the named numbers."""
        equations = self.judged.equations.along_numbers(self.indices)
        return intervals95(equations, self.judged.evidence.draws).half_width

    def refitted(self, named: Sequence[NamedEffect]) -> SearchResult:
        """Return this with those of its names alone that are in `named`."""
        indices = indices_of([one.candidate for one in named])
        theta = self.start.theta.copy()
        theta[indices] = self.estimate.theta[indices]
        begin = Estimate(theta, self.estimate.free) if named else self.start
        at, judged = self.judged, self.judged.evidence
        best, block = fit(judged, begin, indices, limits=judged.limits)
        last = at = Evaluation(judged, best, block)
        if self.judged is not self.last:
            block = self.last.evidence.linearise(best, indices)
            last = Evaluation(self.last.evidence, best, block)
        nothing = self.explained + float(self.last.equations.chi2.sum())
        explained = nothing - float(last.equations.chi2.sum()) if named else 0.0
        return replace(self, named=tuple(named), last=last, judged=at, explained=explained)

    def fitted_anew(self, begin: Estimate, indices: Sequence[int]) -> Estimate:
        """Return the estimate where the numbers at `indices` alone are fitted from `begin`."""
        judged = self.judged.evidence
        return fit(judged, begin, indices, limits=judged.limits)[0]
