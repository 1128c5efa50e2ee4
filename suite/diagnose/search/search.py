"""The search for effects: forward selection, then each named effect against its alternatives.

A named effect must lower the error on left-out stretches by more than the best of all candidates
does by chance, and pass further tests of its source of evidence. A rival is another candidate that
explains the same flights; it is listed as an alternative. All sources use this search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.gauss_newton import chi2_fall, fit
from suite.diagnose.estimate.parameters import Candidate, indices_of
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.evidence import Evidence
from suite.diagnose.search.evaluation import (
    Evaluation,
    NamedEffect,
    SearchResult,
    chi2_of,
    evaluated_at,
    fit_with,
)
from suite.diagnose.thresholds import Thresholds

T = TypeVar("T")


class SearchTask(NamedTuple):
    """What a search is given."""

    among: Sequence[Candidate]
    say: Callable[[str], None]
    seed: int
    limits: Thresholds


def search(
    evidence: Evidence,
    start: Estimate,
    among: Sequence[Candidate],
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
    known: tuple[Evidence, Block] | None = None,
) -> SearchResult:
    """Return which of `among` explain what the model leaves of the evidence at `start`.

    `say` receives a line for people about each step; `known` is the evidence weighed at `start`, to
    save its calculation; `seed` is of the null's draws.
    """
    limits = evidence.limits
    task = SearchTask(among, say, seed, limits)
    here = evaluated_at(known or evidence.weighed(start), start, among)
    first = _scores(task, here, [], among)
    named: list[NamedEffect] = []
    for _ in range(2 * limits.most_names):  # a name that went may come again
        found = None
        if len(named) < limits.most_names:
            scores = first if here.at is start else None
            found = _next_name(task, here, named, among, scores)
        if found is None or (named and found[0].gain <= limits.least_name_share * first[0].gain):
            break
        one, at = found
        new = [replace(one, candidate=single) for single in one.candidate.singles]
        known = here.evidence.weighed(at)
        named, at = _without_idle_names(task, known[0], at, [*named, *new], len(new) == 1)
        here = evaluated_at(known if at is found[1] else known[0].again(at), at, among)
    named, at = _settled(task, here.evidence, here.at, named)
    last = judged = _last_fit(here.evidence, at, named)
    misfit = last.evidence.misfit(last.at, last.block)
    if misfit is not None:
        say("the model leaves more than noise: names are judged by what it leaves")
        named, at = _settled(task, misfit[0], last.at, named)
        judged = _last_fit(misfit[0], at, named)
        last = _seen_by(last.evidence, judged.at, named)
    explained = 0.0
    if named:
        _, nothing = fit(last.evidence, start, [], limits=limits)
        explained = float((nothing.residual**2).sum() - last.equations.chi2.sum())
    return SearchResult(tuple(named), start, last, judged, first, explained)


def _scores(
    task: SearchTask, here: Evaluation, others: Sequence[int], among: Sequence[Candidate]
) -> list[CandidateScore]:
    return here.evidence.scores(here.block, here.equations, here.at.theta, others, among, task.seed)


def _seen_by(evidence: Evidence, at: Estimate, named: Sequence[NamedEffect]) -> Evaluation:
    return Evaluation(
        evidence, at, evidence.linearise(at, indices_of([n.candidate for n in named]))
    )


def _last_fit(evidence: Evidence, at: Estimate, named: Sequence[NamedEffect]) -> Evaluation:
    """Fit all names to the end, as some effects saturate; where there is none nothing is moved."""
    indices, limits = indices_of([n.candidate for n in named]), evidence.limits
    rounds = limits.last_rounds if indices else 0
    return Evaluation(evidence, *fit(evidence, at, indices, rounds, None, limits))


def _next_name(
    task: SearchTask,
    here: Evaluation,
    named: Sequence[NamedEffect],
    among: Sequence[Candidate],
    known: Sequence[CandidateScore] | None = None,
    now: Candidate | None = None,
) -> tuple[NamedEffect, Estimate] | None:
    """Return the best name next to `named`, and the fit with it; None where there is none.

    `known` are the scores there, to save their calculation. With `now`, a name that `here` is taken
    without, all that may stand in its place is tried.
    """
    limits, evidence, space = task.limits, here.evidence, here.evidence.space
    others = indices_of([n.candidate for n in named])
    left = [c for c in among if not set(c.indices) & set(others)]
    scores = {s.candidate: s for s in known or _scores(task, here, others, left)}
    near = list(scores)
    if now is None:
        most = limits.near_share * max((s.gain for s in scores.values()), default=0.0)
        near = [
            c
            for c, score in scores.items()
            if score.p_value <= evidence.name_p_value and score.gain >= most
        ]
    columns, theta = here.equations.columns_of, here.at.theta
    fallen = {c: chi2_fall(here.equations, theta, space, [*others, *columns(c)]) for c in near}
    near = [c for c in near if c == now or could_be_best(fallen, c, limits)]
    if now is None:
        single = [c for c in near if not c.parts][: limits.short_list]
        near = [c for c in near if c.parts or c in single]
    before, tried = chi2_of(here, here.block, here.at, others), []
    total = float(here.equations.chi2.sum())
    for candidate in near:
        at, block = fit_with(here, others, candidate)
        gains = before - chi2_of(here, block, at, [*others, *candidate.indices])
        share = evidence.share(here.block, at, block, candidate, gains)
        chi2 = float((block.residual**2).sum())
        fall = total - chi2
        outcome = f"lowers the squared error by {fall:,.0f} times the noise variance"
        if share is None:
            outcome = "rejected: flights disagree, or a value is implausible or explains too little"
        task.say(f"fitted {candidate.label}: {outcome}")
        if share is not None:
            one = NamedEffect(
                candidate, scores[candidate].p_value, scores[candidate].gain,
                gains=tuple(gains.tolist()), share=share,
            )  # fmt: skip
            tried.append((chi2 + len(candidate.indices), candidate, (one, at)))
    tried = without_idle(tried, limits)
    if not tried:
        return None
    least = min(cost for cost, *_ in tried)
    explained = total - chi2_fall(here.equations, theta, space, others) - least
    slack = max(min(limits.rival_chi2, limits.rival_share * explained), 0.0)
    alike = [one for one in tried if one[0] - least <= slack]
    sure = [one for one in alike if one[2][0].p_value <= evidence.name_p_value]
    if not sure:
        return None
    cost, best, (one, at) = min(sure, key=lambda t: (*evidence.order(t[2][1], t[1]), t[0]))
    rivals = dict.fromkeys(c.name for _, c, _ in alike if c.name != best.name)
    worse_by = {c.label: other - cost for other, c, _ in tried if c != best}
    return replace(one, rivals=tuple(rivals), worse_by=worse_by), at


def _judged(
    task: SearchTask,
    evidence: Evidence,
    at: Estimate,
    named: list[NamedEffect],
    place: int,
    among: Sequence[Candidate] | None = None,
) -> tuple[list[NamedEffect], Estimate]:
    """Weigh the name at `place` when added last: a better rival takes its place, or it goes.

    It is weighed against `among`, all candidates if not given.
    """
    one, theta = named[place].candidate, at.theta.copy()
    theta[list(one.indices)] = evidence.space.array("start")[list(one.indices)]
    without = Estimate(theta, at.free)
    others = [*named[:place], *named[place + 1 :]]
    left = [c for c in (task.among if among is None else among) if one not in c.parts]
    here = evaluated_at(evidence.again(without), without, left)
    found = _next_name(task, here, others, left, None, one)
    if found is None:
        return others, without
    new = [replace(found[0], candidate=single) for single in found[0].candidate.singles]
    return [*named[:place], *new, *named[place + 1 :]], found[1]


def _without_idle_names(
    task: SearchTask, evidence: Evidence, at: Estimate, named: list[NamedEffect], newest: bool
) -> tuple[list[NamedEffect], Estimate]:
    """Return the names that are needed next to all others, each weighed against nothing.

    With `newest` the last one has just been weighed.
    """
    place = 0
    while place < len(named) - newest:
        kept, after = _judged(task, evidence, at, named, place, [named[place].candidate])
        if len(kept) < len(named):
            named, at = kept, after
        else:
            place += 1
    return named, at


def _settled(
    task: SearchTask, evidence: Evidence, at: Estimate, named: list[NamedEffect]
) -> tuple[list[NamedEffect], Estimate]:
    """Refit all names jointly and judge each against its rivals, until no name changes."""
    for _ in range(task.limits.settle_rounds):
        before = [n.candidate for n in named]
        if not before:
            break
        at, _ = fit(evidence, at, indices_of(before), limits=task.limits)
        place = 0
        while place < len(named):
            count = len(named)
            named, at = _judged(task, evidence, at, named, place)
            place += len(named) >= count
        if [n.candidate for n in named] == before:
            break
    return named, at


def could_be_best(
    fallen: Mapping[Candidate, float], candidate: Candidate, limits: Thresholds
) -> bool:
    """Return whether `candidate` could be the best: slopes alone do not decide on large effects.

    `fallen` holds the fall of chi-square to first order, by candidate. Several effects together
    have to explain more than each of them alone.
    """
    own, most = fallen.get(candidate, -np.inf), max(fallen.values())
    alone = max((fallen.get(part, 0.0) for part in candidate.parts), default=-np.inf)
    slack = limits.first_order_chi2 + limits.first_order_share * abs(most)
    return own >= most - slack and own > alone + limits.rival_chi2


def without_idle(
    tried: Sequence[tuple[float, Candidate, T]], limits: Thresholds
) -> list[tuple[float, Candidate, T]]:
    """Return what was `tried`, without composites of which one part alone explains as much.

    Each comes with its squared error, to which its numbers were added.
    """
    cost = {candidate: chi2 for chi2, candidate, _ in tried}
    return [
        (chi2, candidate, more)
        for chi2, candidate, more in tried
        if all(chi2 + limits.rival_chi2 < cost.get(part, np.inf) for part in candidate.parts)
    ]
