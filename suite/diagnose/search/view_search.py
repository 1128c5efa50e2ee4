"""The search of one view: what its flights agree on, beyond how they differ among themselves.

A name must beat chance (signs of whole stretches shuffled, as in `fit.permutation`), lower the
error of flights that its fit did not see in all flights but one, be more than a trifle of what
the view has to explain, and hold for slow and fast changes alike (`specification`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.parameters import JOIN, Candidate, effects_in, indices_of
from suite.diagnose.estimate.permutation import folds_of, score_candidates
from suite.diagnose.evidence.view_equations import (
    ViewEquations,
    ViewTask,
    chi2_by_flight,
    fitted,
    fitted_beside,
    left_of,
    look,
    share_taken,
    with_lent,
)
from suite.diagnose.evidence.weigh import weights_of
from suite.diagnose.search.composites import acts_through, carried
from suite.diagnose.search.plausible import at_bound, usual_first
from suite.diagnose.search.rivals import flights_agree, without_idle
from suite.diagnose.search.specification import holds_at_any_speed


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
    """Return those of `among` that the view can see: what moves it, and is no fault of a sensor.

    Of several effects that are one hypothesis each has to move it, if through another.
    """
    seen, through = np.einsum("bkk->k", first.block.hessian) > 0.0, carried(among)

    def moves(one: Candidate) -> bool:
        effect = EFFECTS[one.name]
        return (
            (bool(seen[list(one.indices)].any()) or one in through)
            and effect.measure is None
            and effect.late is None
            and "command" not in effect.needs
        )

    return [one for one in among if all(moves(part) for part in one.singles)]


def search_view(task: ViewTask, among: Sequence[Candidate], seed: int = 0) -> ViewSearch:
    """Return which of `among` explain what `task` leaves, one after another."""
    start = task.model.space.array("start")
    first = now = look(task, start, weights_of(left_of(task, start), task.limits))
    among = view_candidates(among, first)
    named: list[ViewName] = []
    for _ in range(2 * task.limits.most_names):  # a name that went may come again
        if len(named) >= task.limits.most_names:
            break
        found = _next_name(task, now, named, among, seed)
        if found is None:
            break
        name, now = found
        # What is left is the noise: with a name less of it is.
        now = look(task, now.theta, weights_of(now.data, task.limits))
        now = fitted(task, now, indices_of([n.candidate for n in [*named, name]]))
        named += _parts(task, name, named, now, among, seed)
        weighed = named[-1] if not name.candidate.parts else None
        named, now = _without_idle(task, named, now, weighed, seed)
    return ViewSearch(task, _not_named_themselves(named), first, now)


def _not_named_themselves(named: Sequence[ViewName]) -> tuple[ViewName, ...]:
    """Return the names without rivals that turned out to be there as well."""
    there = {one.candidate.name for one in named}
    return tuple(replace(n, rivals=tuple(r for r in n.rivals if r not in there)) for n in named)


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
    block = with_lent(task, now, left)
    scores = score_candidates(
        block, now.theta, task.model.space, beside, left, _folds(now), seed, task.limits
    )
    near = [
        s
        for s in scores
        if s.p_value <= task.limits.name_p_value
        and s.gain >= task.limits.near_share * scores[0].gain
    ]
    single = [s for s in near if not s.candidate.parts][: task.limits.short_list]
    before, tried = chi2_by_flight(task, now, beside), []
    for score in [s for s in near if s.candidate.parts or s in single]:
        at = [*beside, *score.candidate.indices]
        then = fitted_beside(task, now, block, beside, score.candidate)
        gains = before - chi2_by_flight(task, then, at)
        if at_bound(task.model.space, then.theta, score.candidate):
            continue  # that is no fit
        share = share_taken(task, now, then)
        if (
            flights_agree(gains)
            and share >= task.limits.least_view_share
            and holds_at_any_speed(task, then, score.candidate.indices)
        ):
            cost = float(then.block.chi2.sum()) + 2.0 * len(score.candidate.indices)
            name = ViewName(score.candidate, score.p_value, tuple(gains.tolist()), share)
            tried.append((cost, score.candidate, (name, then)))
    if not tried:
        return None
    tried = without_idle(tried, task.limits)
    least = min(cost for cost, *_ in tried)
    explained = float(now.block.chi2.sum()) - least
    slack = max(min(task.limits.rival_chi2, task.limits.rival_share * explained), 0.0)
    space = task.model.space
    alike = [more for cost, _, more in tried if cost - least <= slack]
    alike.sort(key=lambda one: usual_first(space, one[1].theta, one[0].candidate))
    for name, then in alike:
        last = fitted(task, then, [*beside, *name.candidate.indices])
        if not at_bound(space, last.theta, name.candidate):
            rivals = dict.fromkeys(other.candidate.name for other, _ in alike)
            rivals.pop(name.candidate.name, None)
            return replace(name, rivals=tuple(rivals)), last
    return None


def _parts(
    task: ViewTask,
    name: ViewName,
    named: Sequence[ViewName],
    now: ViewEquations,
    among: Sequence[Candidate],
    seed: int,
) -> list[ViewName]:
    """Return the effects of a new `name`, with what could stand for each beside the others.

    `now` are the equations with all names, `named` those before. A wind on several headings is not
    the same in all flights, and looks like their trims until it is named: so its rivals are those
    that are left beside it.
    """
    if not acts_through(name.candidate):
        return [replace(name, candidate=single) for single in name.candidate.singles]
    found = []
    for part in name.candidate.singles:
        others = [replace(name, candidate=c) for c in name.candidate.singles if c is not part]
        without, beside = _less(task, now, part), [*named, *others]
        best = _next_name(task, without, beside, among, seed)
        rivals = dict.fromkeys(_instead_of(part, name))
        if best is not None:
            rivals = dict.fromkeys((best[0].candidate.name, *best[0].rivals))
        rivals.pop(part.name, None)
        found.append(replace(name, candidate=part, rivals=tuple(rivals)))
    return found


def _instead_of(part: Candidate, name: ViewName) -> list[str]:
    """Return what the rivals of `name`, several effects, have in the place of one of them."""
    own, found = set(name.candidate.effects), []
    for rival in name.rivals:
        others = [effect for effect in effects_in(rival) if effect not in own]
        if part.name not in effects_in(rival):
            found.append(JOIN.join(others))
    return found


def _without_idle(
    task: ViewTask,
    named: list[ViewName],
    now: ViewEquations,
    weighed: ViewName | None,
    seed: int,
) -> tuple[list[ViewName], ViewEquations]:
    """Return the names that are still needed beside all others, but for one `weighed` just now."""
    for one in list(named):
        if one is weighed and not at_bound(task.model.space, now.theta, one.candidate):
            continue
        others = [n for n in named if n is not one]
        without = _less(task, now, one.candidate)
        found = _next_name(task, without, others, [one.candidate], seed)
        if found is None or at_bound(task.model.space, now.theta, one.candidate):
            named, now = others, fitted(task, without, indices_of([n.candidate for n in others]))
        else:
            named = [replace(found[0], rivals=n.rivals) if n is one else n for n in named]
    # What has lost what it acts through is no name any more.
    acts = np.abs(now.data.slope).max(axis=(0, 1)) > 0.0
    return [n for n in named if acts[list(n.candidate.indices)].any()], now


def _less(task: ViewTask, now: ViewEquations, candidate: Candidate) -> ViewEquations:
    """Return the equations where `candidate` is as in the vehicle file and all else as in `now`.

    Other names are not fitted anew: a drag that hovering flights do not ask for without a wind
    would be gone, and with it what the wind acts through.
    """
    at, theta = list(candidate.indices), now.theta.copy()
    theta[at] = task.model.space.array("start")[at]
    return look(task, theta, now.weights)


def _folds(now: ViewEquations) -> np.ndarray:
    """Return what is left out together (B,): flights, or parts of too few of them."""
    if len(np.unique(now.flight)) >= 3:
        return now.flight
    return folds_of(now.flight, np.arange(len(now.flight), dtype=float))
