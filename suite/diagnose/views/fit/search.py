"""The search of one view: what its flights agree on, beyond how they differ among themselves.

A name must beat chance (signs of whole stretches shuffled, as in `fit.permutation`), lower the
error of flights that its fit did not see in all flights but one, and be more than a trifle of what
the view has to explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.fit.parameters import Candidate, indices_of
from suite.diagnose.fit.permutation import folds_of, score_candidates
from suite.diagnose.fit.rivals import flights_agree
from suite.diagnose.views.fit.equations import (
    ViewEquations,
    ViewTask,
    chi2_by_flight,
    fitted,
    left_of,
    look,
)
from suite.diagnose.views.fit.plausible import at_bound, usual_first
from suite.diagnose.views.fit.weigh import weights_of


@dataclass(frozen=True)
class ViewName:
    """An effect that one view names."""

    candidate: Candidate
    p_value: float
    gains: tuple[float, ...]
    """Fall of the squared error of each flight that the others' fit brings."""
    share: float
    """Of the squared error that the view had to explain [1]."""
    rivals: tuple[str, ...] = ()
    """Names that explain the same."""


@dataclass(frozen=True)
class ViewSearch:
    """What one view's search found."""

    task: ViewTask
    named: tuple[ViewName, ...]
    first: ViewEquations
    """At the vehicle file's numbers."""
    last: ViewEquations
    """With what was named."""

    @property
    def indices(self) -> list[int]:
        """Places in the vector of the named numbers."""
        return indices_of([one.candidate for one in self.named])


def view_candidates(among: Sequence[Candidate], first: ViewEquations) -> list[Candidate]:
    """Return those of `among` that the view can see: what moves it, and is no fault of a sensor."""
    seen = np.einsum("bkk->k", first.block.hessian) > 0.0
    return [
        one
        for one in among
        if seen[list(one.indices)].any()
        and EFFECTS[one.name].measure is None
        and EFFECTS[one.name].late is None
        and "command" not in EFFECTS[one.name].needs
    ]


def search_view(task: ViewTask, among: Sequence[Candidate], seed: int = 0) -> ViewSearch:
    """Return which of `among` explain what `task` leaves, one after another."""
    start = task.model.space.array("start")
    first = now = look(task, start, weights_of(left_of(task, start), task.limits))
    among = view_candidates(among, first)
    named: list[ViewName] = []
    while len(named) < task.limits.most_names:
        found = _next_name(task, now, named, among, seed)
        if found is None:
            break
        name, now = found
        named.append(name)
        # What is left is the noise: with a name less of it is.
        now = look(task, now.theta, weights_of(now.data, task.limits))
        now = fitted(task, now, indices_of([n.candidate for n in named]))
        named, now = _without_idle(task, named, now, among, seed)
    return ViewSearch(task, tuple(named), first, now)


def _next_name(
    task: ViewTask,
    now: ViewEquations,
    named: Sequence[ViewName],
    among: Sequence[Candidate],
    seed: int,
) -> tuple[ViewName, ViewEquations] | None:
    """Return the best name beside `named`, and the equations with it; None where there is none."""
    beside = indices_of([n.candidate for n in named])
    left = [c for c in among if not set(c.indices) & set(beside)]
    scores = score_candidates(
        now.block, now.theta, task.model.space, beside, left, _folds(now), seed, task.limits
    )
    near = [
        s
        for s in scores
        if s.p_value <= task.limits.name_p_value
        and s.gain >= task.limits.near_share * scores[0].gain
    ]
    before, tried = chi2_by_flight(task, now, beside), []
    for score in near[: task.limits.short_list]:
        at = [*beside, *score.candidate.indices]
        then = fitted(task, now, at, rounds=1)
        gains = before - chi2_by_flight(task, then, at)
        share = float(gains.sum() / before.sum())
        if at_bound(task.model.space, then.theta, score.candidate):
            continue  # that is no fit
        if flights_agree(gains) and share >= task.limits.least_view_share:
            cost = float(then.block.chi2.sum()) + 2.0 * len(score.candidate.indices)
            tried.append((cost, score, gains, share, then))
    if not tried:
        return None
    least = min(cost for cost, *_ in tried)
    explained = float(now.block.chi2.sum()) - least
    slack = max(min(task.limits.rival_chi2, task.limits.rival_share * explained), 0.0)
    alike = [one for one in tried if one[0] - least <= slack]
    space = task.model.space
    alike.sort(key=lambda one: usual_first(space, one[4].theta, one[1].candidate))
    for _, best, gains, share, then in alike:
        last = fitted(task, then, [*beside, *best.candidate.indices])
        if not at_bound(space, last.theta, best.candidate):
            rivals = dict.fromkeys(score.candidate.name for _, score, *_ in alike)
            rivals.pop(best.candidate.name, None)
            gains = tuple(gains.tolist())
            return ViewName(best.candidate, best.p_value, gains, share, tuple(rivals)), last
    return None


def _without_idle(
    task: ViewTask,
    named: list[ViewName],
    now: ViewEquations,
    among: Sequence[Candidate],
    seed: int,
) -> tuple[list[ViewName], ViewEquations]:
    """Return the names that are still needed beside all others, weighed anew with their rivals."""
    start = task.model.space.array("start")
    for one in list(named):
        if one is named[-1] and not at_bound(task.model.space, now.theta, one.candidate):
            continue  # it was weighed just now
        others = [n for n in named if n is not one]
        theta = now.theta.copy()
        theta[list(one.candidate.indices)] = start[list(one.candidate.indices)]
        without = fitted(
            task, look(task, theta, now.weights), indices_of([n.candidate for n in others])
        )
        found = _next_name(task, without, others, [one.candidate], seed)
        if found is None or at_bound(task.model.space, now.theta, one.candidate):
            named, now = others, without
        else:
            named = [replace(found[0], rivals=n.rivals) if n is one else n for n in named]
    return named, now


def _folds(now: ViewEquations) -> np.ndarray:
    """Return what is left out together (B,): flights, or parts of too few of them."""
    if len(np.unique(now.flight)) >= 3:
        return now.flight
    return folds_of(now.flight, np.arange(len(now.flight), dtype=float))
