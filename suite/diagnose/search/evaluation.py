"""Fits candidate effects from one estimate of the parameters; defines the result of a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.composites import acts_through, begin_of, inactive_at
from suite.diagnose.estimate.gauss_newton import TINY, gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, indices_of
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.evidence import Evaluation, validation_groups


@dataclass(frozen=True)
class NamedEffect:
    """One effect that the search has named."""

    candidate: Candidate
    p_value: float
    gain: float
    """Fall of chi-square on left-out stretches when this effect is added last."""
    rivals: tuple[str, ...] = ()
    """Names of the alternatives: effects that explain the flights about as well."""
    worse_by: dict[str, float] = field(default_factory=dict)
    """Rise of chi-square plus number of parameters with another candidate instead, by its label."""
    gains: tuple[float, ...] = ()
    """Fall of each flight's squared error, with the parameters fitted to the other flights."""


def fitted_by(named: Sequence[NamedEffect]) -> list[int]:
    """Return the places of the named effects' parameters in the vector of all."""
    return indices_of([name.candidate for name in named])


def with_inactive(current: Evaluation, among: Sequence[Candidate]) -> Evaluation:
    """Return the evaluation `current` with further columns for inactive parameters, and secants.

    Without a drag, a wind's column of slopes is zero. A second column is then computed with a drag
    of usual size (see `inactive_at`).
    """
    evidence, at, _ = current
    block = with_secants(current, among)
    inactive = inactive_at(evidence.space, at.theta, among, block.acts())
    if inactive is not None:
        indices, raised = inactive
        active = evidence.linearise(Estimate(raised, at.free), indices)
        columns = [active.along.index(index) for index in indices]
        block = replace(
            block,
            slope=np.concatenate([block.slope, active.slope[..., columns]], axis=-1),
            free_slope=np.concatenate([block.free_slope, active.free_slope[..., columns]], axis=-1),
            along=(*block.along, *indices),
        )
    return Evaluation(evidence, at, block)


def with_secants(current: Evaluation, among: Sequence[Candidate]) -> Block:
    """Return the block with secants in place of tangents where these lead to a worse minimum.

    A delay longer than the time between two rows is such a case. If the best of the values `tried`
    lowers chi-square more than a linear fit along the tangent, the column becomes the secant to
    this value, to which a fit's first step then leads.
    """
    evidence, at, block = current
    entries, start = evidence.space.entries, evidence.space.array("start")
    for index in indices_of(among):
        if not entries[index].tried or at.theta[index] != start[index]:
            continue  # linear, or fitted already
        column = block.along.index(index)
        tangent = block.slope[..., column]
        fall = float((tangent * block.residual).sum()) ** 2 / max(float((tangent**2).sum()), TINY)
        least = float((block.residual**2).sum()) - fall
        for value in entries[index].tried:
            if value == start[index]:
                continue
            theta = at.theta.copy()
            theta[index] = value
            far = evidence.linearise(Estimate(theta, at.free), ())
            chi2, change = float((far.residual**2).sum()), value - start[index]
            if chi2 < least:  # never where the model diverges
                least, slope, free_slope = chi2, block.slope.copy(), block.free_slope.copy()
                slope[..., column] = (block.residual - far.residual) / change
                free_slope[..., column] = (block.free - far.free) / change
                block = replace(block, slope=slope, free_slope=free_slope)
    return block


def fit_with(start: Evaluation, others: Sequence[int], candidate: Candidate) -> Evaluation:
    """Fit `candidate` together with the parameters at `others`, from the estimate of `start`."""
    evidence, limits, estimate = start.evidence, start.evidence.limits, start.at
    indices = sorted({*others, *candidate.indices})
    numbers = start.block.equations.along  # those of inactive parameters have two columns
    inactive = [n for k, n in enumerate(numbers) if n in numbers[:k] and n in candidate.indices]
    if not candidate.parts or not inactive:
        rounds = limits.bilinear_rounds if acts_through(candidate) else None
        return evidence.fitted(estimate, indices, rounds, start.block)
    # A composite with an inactive part: begin where a linear fit with the second columns leads.
    change, information = linear_change(start, others, candidate)
    theta = begin_of(evidence.space, estimate.theta, candidate, inactive, change, information)
    return evidence.fitted(Estimate(theta, estimate.free), indices, limits.bilinear_rounds)


def linear_change(
    start: Evaluation, others: Sequence[int], candidate: Candidate
) -> tuple[np.ndarray, np.ndarray]:
    """Return the change (P,) of all parameters by one linear fit, and the information (P,) on each.

    Fitted are the parameters of `candidate` and those at `others`.
    """
    equations, theta = start.block.equations, start.at.theta
    fitted = equations.take(sorted({*others, *equations.columns_of(candidate)}))
    step, _ = gauss_newton_step(fitted, theta, start.evidence.space)
    change, information = np.zeros_like(theta), np.zeros_like(theta)
    indices = list(fitted.along)
    change[indices], information[indices] = step, np.diag(fitted.sums()[0])
    return change, information


def cross_validated_chi2(current: Evaluation, indices: Sequence[int]) -> np.ndarray:
    """Return the squared error (G,) of each group of stretches by a linear fit to the others."""
    equations = current.block.equations.along_numbers(sorted(indices))
    theta, space, errors = current.at.theta, current.evidence.space, []
    group = validation_groups(current.block.flight)
    for number in np.unique(group):
        inside = group == number
        change, _ = gauss_newton_step(equations, theta, space, ~inside)
        errors.append(equations.chi2_at(change)[inside].sum())
    return np.array(errors, dtype=float)


@dataclass(frozen=True)
class SearchResult:
    """Named effects of a search, and the fit with them."""

    named: tuple[NamedEffect, ...]
    start: Estimate
    """Estimate from which the search began."""
    last: Evaluation
    """Evaluation at the fit of all named effects, weighted by the noise estimated at this fit."""
    judged: Evaluation
    """Evaluation that decided names, alternatives and intervals. It is `last`, unless the best
    model leaves more than noise: then the whole residual counts as noise."""
    first: list[CandidateScore]
    """Scores of all candidates before any effect was named, best first."""

    @property
    def estimate(self) -> Estimate:
        """The estimate with all named effects."""
        return self.last.at

    @property
    def candidates(self) -> list[Candidate]:
        """The named candidates."""
        return [one.candidate for one in self.named]

    @property
    def indices(self) -> list[int]:
        """Places of the named effects' parameters in the vector of all."""
        return fitted_by(self.named)

    def half_widths(self) -> np.ndarray:
        """Return the half-widths (K,) of the 95 % intervals of the named effects' parameters."""
        return self.judged.intervals(self.indices).half_width

    def refitted(self, named: Sequence[NamedEffect]) -> SearchResult:
        """Return this result with only the effects `named`, fitted again."""
        indices = fitted_by(named)
        theta = self.start.theta.copy()
        theta[indices] = self.estimate.theta[indices]
        begin = Estimate(theta, self.estimate.free) if named else self.start
        return self.with_fit(named, self.judged.evidence.fitted(begin, indices))

    def with_fit(self, named: Sequence[NamedEffect], judged: Evaluation) -> SearchResult:
        """Return this result with the effects `named`, of which `judged` is the fit."""
        last = judged
        if self.judged is not self.last:  # no step: evaluated only
            last = self.last.evidence.fitted(judged.at, fitted_by(named), 0)
        return replace(self, named=tuple(named), last=last, judged=judged)
