"""Searches for the effects that explain flights: forward selection, then a test of each name.

A candidate is an effect of the catalogue, or several as one hypothesis (a composite). It is named
if it lowers the error on left-out stretches of the flights by more than the best of all candidates
does by chance, and if it passes further tests of the evidence. An alternative (`rivals` in the
code) is another candidate that explains the same flights about as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.gauss_newton import chi2_fall
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.evidence import Evaluation, Evidence
from suite.diagnose.search.evaluation import (
    NamedEffect,
    SearchResult,
    cross_validated_chi2,
    fit_with,
    fitted_by,
    with_inactive,
)
from suite.diagnose.thresholds import Thresholds


class SearchTask(NamedTuple):
    """Inputs of a search that all its steps share."""

    among: Sequence[Candidate]
    """The candidates."""
    say: Callable[[str], None]
    """Receives a line for people about each step."""
    seed: int
    """Seed of the permutation test."""


class _Trial(NamedTuple):
    """A fitted candidate."""

    cost: float
    """Chi-square plus the number of the candidate's parameters, which makes sizes comparable."""
    name: NamedEffect
    at: Estimate
    """Estimate with the candidate fitted."""


def search(
    begin: Evaluation,
    among: Sequence[Candidate],
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
) -> SearchResult:
    """Return the candidates of `among` that explain the residual of the evaluation `begin`."""
    limits, start = begin.evidence.limits, begin.at
    task = SearchTask(among, say, seed)
    current = with_inactive(begin, among)
    first = current.evidence.scores(current, [], among, seed)
    named: list[NamedEffect] = []
    # Forward selection: add the best candidate, then drop names that it has made unnecessary.
    for _ in range(2 * limits.most_names):  # a name that was dropped may be named again
        best = None
        if len(named) < limits.most_names:
            scores = first if current.at is start else None
            best = _best_candidate(task, current, named, among, scores)
        if best is None or (named and best[0].gain <= limits.least_name_share * first[0].gain):
            break
        name, at = best
        new_names = _one_name_per_effect(name)
        known = current.evidence.estimate_noise(at)
        named, at = _drop_unneeded(
            task, known.evidence, at, [*named, *new_names], len(new_names) == 1
        )
        current = with_inactive(known if at is best[1] else known.evidence.relinearise(at), among)
    named, at = _settle(task, current.evidence, current.at, named)
    last = _final_fit(current.evidence, at, named)
    found = SearchResult(tuple(named), start, last, last, first)
    # If even the best model leaves more than noise, decide again with the residual as noise.
    misfit = last.evidence.misfit_as_noise(last)
    if misfit is None:
        return found
    say("the remaining error is more than noise: effects are tested again, with it as noise")
    return settled(replace(found, judged=last._replace(evidence=misfit)), among, say, seed)


def settled(
    found: SearchResult, among: Sequence[Candidate], say: Callable[[str], None], seed: int
) -> SearchResult:
    """Return `found` with each name tested again, against all candidates of `among`.

    The evidence is that of `found.judged`. A name that was withdrawn may have hidden a better
    candidate, or alternatives, of the others.
    """
    evidence = found.judged.evidence
    named, at = _settle(SearchTask(among, say, seed), evidence, found.estimate, list(found.named))
    return found.with_fit(named, _final_fit(evidence, at, named))


def _one_name_per_effect(name: NamedEffect) -> list[NamedEffect]:
    """Return a name for each effect of a composite, or the given name of a single effect."""
    return [replace(name, candidate=single) for single in name.candidate.singles]


def _final_fit(evidence: Evidence, at: Estimate, named: Sequence[NamedEffect]) -> Evaluation:
    """Fit all names with many steps, as some effects saturate; without names keep the estimate."""
    indices = fitted_by(named)
    return evidence.fitted(at, indices, evidence.limits.last_rounds if indices else 0)


def _best_candidate(
    task: SearchTask,
    current: Evaluation,
    named: Sequence[NamedEffect],
    among: Sequence[Candidate],
    known: Sequence[CandidateScore] | None = None,
    tested: Candidate | None = None,
) -> tuple[NamedEffect, Estimate] | None:
    """Return the candidate of `among` that explains most in addition to `named`, and its fit.

    None where none passes all tests. `current` is the evaluation with the present names, and
    `known` the scores, if computed before. `tested` was taken out of `current`, to be tested
    against all that could replace it, significant or not.
    """
    evidence, limits, space = current.evidence, current.evidence.limits, current.evidence.space
    others = fitted_by(named)
    unnamed = [c for c in among if not set(c.indices) & set(others)]
    known = known or evidence.scores(current, others, unnamed, task.seed)
    scores = {score.candidate: score for score in known}
    # Choose the candidates that are worth a fit: those with good scores ...
    shortlist = list(scores)
    if tested is None:
        significant = [c for c, score in scores.items() if score.p_value <= limits.name_p_value]
        least = limits.near_share * max((scores[c].gain for c in significant), default=0.0)
        shortlist = [c for c in significant if scores[c].gain >= least]
    # ... that could be the best to first order, and of the single effects only the first few.
    equations, theta = current.block.equations, current.at.theta
    falls = {
        c: chi2_fall(equations, theta, space, [*others, *equations.columns_of(c)])
        for c in shortlist
    }
    shortlist = [c for c in shortlist if c == tested or could_be_best(falls, c, limits)]
    if tested is None:
        single = [c for c in shortlist if not c.parts][: limits.short_list]
        shortlist = [c for c in shortlist if c.parts or c in single]
    # Fit each of them, and keep those that pass the tests of the evidence.
    if shortlist and shortlist != [tested]:
        instead = f" in the place of {tested.label}" if tested else ""
        task.say(f"fitting {', '.join(c.label for c in shortlist if c != tested)}{instead}")
    errors_before = cross_validated_chi2(current, others)
    chi2_before, trials = float(equations.chi2.sum()), list[_Trial]()
    for candidate in shortlist:
        fitted = fit_with(current, others, candidate)
        gains = errors_before - cross_validated_chi2(fitted, [*others, *candidate.indices])
        chi2, score = float((fitted.block.residual**2).sum()), scores[candidate]
        if evidence.accepts(current.block, fitted, candidate, gains):
            by_flight = tuple(gains.tolist())
            name = NamedEffect(candidate, score.p_value, score.gain, gains=by_flight)
            trials.append(_Trial(chi2 + len(candidate.indices), name, fitted.at))
    costs = {trial.name.candidate: trial.cost for trial in trials}
    trials = [trial for trial in trials if needs_all_parts(costs, trial.name.candidate, limits)]
    if not trials:
        return None
    # Those about as good as the lowest cost are `close`. Of these, the significant one that the
    # evidence prefers is named, and the others are its alternatives.
    lowest = min(trial.cost for trial in trials)
    explained = chi2_before - chi2_fall(equations, theta, space, others) - lowest
    allowed = max(min(limits.rival_chi2, limits.rival_share * explained), 0.0)
    close = [trial for trial in trials if trial.cost - lowest <= allowed]
    significant = [trial for trial in close if trial.name.p_value <= limits.name_p_value]
    at_fit = next((trial for trial in close if trial.name.candidate == tested), None)
    if at_fit and not significant:
        # A large effect is not linear, and its score without it may be wrong: test it at its fit.
        p_value = _p_value_at_fit(task, current, others, unnamed, at_fit)
        if p_value <= limits.name_p_value:
            significant = [at_fit._replace(name=replace(at_fit.name, p_value=p_value))]
    if not significant:
        return None
    best = min(significant, key=lambda t: (*evidence.preference(t.at, t.name.candidate), t.cost))
    chosen = best.name.candidate
    names = dict.fromkeys(trial.name.candidate.name for trial in close)
    rivals = tuple(name for name in names if name != chosen.name)
    worse_by = {
        t.name.candidate.label: t.cost - best.cost for t in trials if t.name.candidate != chosen
    }
    return replace(best.name, rivals=rivals, worse_by=worse_by), best.at


def _p_value_at_fit(
    task: SearchTask,
    current: Evaluation,
    others: Sequence[int],
    unnamed: Sequence[Candidate],
    trial: _Trial,
) -> float:
    """Return the p-value of a fitted candidate among the `unnamed`, next to the `others`.

    The residual without it is extrapolated from the fit, where the slopes are those of the fit.
    """
    near = current.evidence.relinearise(trial.at)
    change, block = trial.at.theta - current.at.theta, near.block
    fitted = [k for k, index in enumerate(block.along) if change[index]]
    residual = block.residual + block.slope[..., fitted] @ change[[block.along[k] for k in fitted]]
    without = Evaluation(near.evidence, current.at, replace(block, residual=residual))
    scores = near.evidence.scores(without, others, unnamed, task.seed)
    return next((s.p_value for s in scores if s.candidate == trial.name.candidate), 1.0)


def _replace_or_drop(
    task: SearchTask,
    evidence: Evidence,
    at: Estimate,
    named: list[NamedEffect],
    place: int,
    among: Sequence[Candidate],
) -> tuple[list[NamedEffect], Estimate]:
    """Test the name at `place` of `named` as if it were added last, against the candidates `among`.

    The best candidate takes its place, which may be the same effect; if none passes, it is dropped.
    Returned are the new names and their fit.
    """
    tested, theta = named[place].candidate, at.theta.copy()
    theta[list(tested.indices)] = evidence.space.array("start")[list(tested.indices)]
    without = Estimate(theta, at.free)
    others = [*named[:place], *named[place + 1 :]]
    among = [c for c in among if tested not in c.parts]
    current = with_inactive(evidence.relinearise(without), among)
    best = _best_candidate(task, current, others, among, None, tested)
    if best is None:
        return others, without
    return [*named[:place], *_one_name_per_effect(best[0]), *named[place + 1 :]], best[1]


def _drop_unneeded(
    task: SearchTask, evidence: Evidence, at: Estimate, named: list[NamedEffect], last_tested: bool
) -> tuple[list[NamedEffect], Estimate]:
    """Return the names that are significant next to all others, and their fit.

    With `last_tested` the last name has just been tested, and is not tested again.
    """
    place = 0
    while place < len(named) - last_tested:
        itself = [named[place].candidate]
        remaining, refitted = _replace_or_drop(task, evidence, at, named, place, itself)
        if len(remaining) < len(named):
            named, at = remaining, refitted
        else:
            place += 1
    return named, at


def _settle(
    task: SearchTask, evidence: Evidence, at: Estimate, named: list[NamedEffect]
) -> tuple[list[NamedEffect], Estimate]:
    """Refit all names and test each against all candidates, until none changes; return both."""
    for _ in range(evidence.limits.settle_rounds):
        before = [name.candidate for name in named]
        if not before:
            break
        at = evidence.fitted(at, fitted_by(named)).at
        place = 0
        while place < len(named):
            count = len(named)
            named, at = _replace_or_drop(task, evidence, at, named, place, task.among)
            place += len(named) >= count  # if the name was dropped, the next one is here now
        if [name.candidate for name in named] == before:
            break
    return named, at


def could_be_best(
    falls: Mapping[Candidate, float], candidate: Candidate, limits: Thresholds
) -> bool:
    """Return whether `candidate` could be the best after a fit of the full model.

    `falls` are falls of chi-square to first order, which is inexact for large effects. A composite
    also has to explain clearly more than each of its parts.
    """
    fall, largest = falls.get(candidate, -np.inf), max(falls.values())
    by_part = max((falls.get(part, 0.0) for part in candidate.parts), default=-np.inf)
    slack = limits.first_order_chi2 + limits.first_order_share * abs(largest)
    return fall >= largest - slack and fall > by_part + limits.rival_chi2


def needs_all_parts(
    costs: Mapping[Candidate, float], candidate: Candidate, limits: Thresholds
) -> bool:
    """Return whether no single part of a composite explains about as much as the composite.

    `costs` holds chi-square plus the number of parameters, by fitted candidate.
    """
    limit = costs[candidate] + limits.rival_chi2
    return all(limit < costs.get(part, np.inf) for part in candidate.parts)
