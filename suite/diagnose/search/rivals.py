"""Every name against its rivals: what else explains the same windows, and do the flights agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from suite.diagnose.estimate.gauss_newton import NormalEquations, gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace, indices_of
from suite.diagnose.evidence.rollout_fit import Estimate
from suite.diagnose.search.look import Look, SearchTask, look_at
from suite.diagnose.thresholds import Thresholds

T = TypeVar("T")


@dataclass(frozen=True)
class NamedEffect:
    """One effect that was named."""

    candidate: Candidate
    p_value: float
    gain: float
    """Fall of chi-square on windows left out when it is added last."""
    rivals: tuple[str, ...] = ()
    """Names that explain the same."""
    worse_by: Mapping[str, float] = field(default_factory=dict)
    """By label of what was fitted in its place: rise of chi-square, with one for each number."""


def settle(
    task: SearchTask, look: Look, named: list[NamedEffect], estimate: Estimate
) -> tuple[list[NamedEffect], Estimate]:
    """Refit all names jointly and judge each against its rivals, until no name changes.

    `look` was taken with all of them.
    """
    begin = task.model.space.array("start")
    for _ in range(task.limits.settle_rounds):
        before = [n.candidate for n in named]
        if not before:
            break
        estimate, _ = task.fit(look, estimate, indices_of(before))
        place = 0
        while place < len(named):
            named, estimate = _judge(task, look, named, place, estimate)
            place += 1
        needed = [n for n in named if n.p_value <= task.limits.name_p_value]
        # A name that was taken on the way may be needed no more beside better ones.
        theta = estimate.theta.copy()
        for one in named:
            if one not in needed:
                theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        named, estimate = needed, Estimate(theta, estimate.offset)
        if [n.candidate for n in named] == before:
            break
    return named, estimate


def _judge(
    task: SearchTask, joint: Look, named: list[NamedEffect], place: int, estimate: Estimate
) -> tuple[list[NamedEffect], Estimate]:
    """Weigh the name at `place` when added last; a better rival takes its place.

    `joint` was taken with all names.
    """
    model, limits, one = task.model, task.limits, named[place]
    others = [n.candidate for k, n in enumerate(named) if k != place]
    theta, own = estimate.theta.copy(), list(one.candidate.indices)
    theta[own] = model.space.array("start")[own]
    without = Estimate(theta, estimate.offset)
    look = look_at(task, without, noise=joint.noise)
    at = indices_of(others)
    scores = {s.candidate: s for s in task.score(look.equations, theta, at)}
    if one.candidate in scores:
        score = scores[one.candidate]
        one = replace(one, p_value=score.p_value, gain=score.gain)
        if joint.off:
            flight = np.asarray(look.windows.flight)
            gains = gains_by_flight(look.equations, theta, model.space, at, own, flight)
            if not flights_agree(gains):
                one = replace(one, p_value=1.0)
    else:
        one = replace(one, p_value=1.0)  # beside the others it does nothing
    left = [c for c in task.among if not set(c.indices) & set(at) and one.candidate not in c.parts]
    columns = look.equations.columns_of
    fallen = {c: chi2_fall(look.equations, theta, model.space, [*at, *columns(c)]) for c in left}
    tried = []
    for candidate in left:
        if candidate == one.candidate or could_be_best(fallen, candidate, limits):
            after, equations = task.fit_beside(look, without, at, candidate)
            tried.append((float(equations.chi2.sum()) + len(candidate.indices), candidate, after))
            task.say(f"{one.candidate.label} or {candidate.label}: {tried[-1][0]:.1f}")
    tried = without_idle(tried, limits)
    least, best, after = min(tried, key=lambda t: t[0])
    if best.parts:
        better = [NamedEffect(part, scores[best].p_value, scores[best].gain) for part in best.parts]
        return [*named[:place], *better, *named[place + 1 :]], after
    if best != one.candidate:
        one = replace(one, candidate=best, p_value=scores[best].p_value)
    total = float(look.equations.chi2.sum())
    explained = total - chi2_fall(look.equations, theta, model.space, at) - least
    alike = min(limits.rival_chi2, limits.rival_share * explained)
    names = dict.fromkeys(c.name for chi2, c, _ in tried if chi2 - least <= alike)
    rivals = tuple(name for name in names if name != best.name)
    worse_by = {c.label: chi2 - least for chi2, c, _ in tried if c != best}
    one = replace(one, rivals=rivals, worse_by=worse_by)
    return [*named[:place], one, *named[place + 1 :]], after


def gains_by_flight(
    equations: NormalEquations,
    theta: np.ndarray,
    space: ParameterSpace,
    beside: Sequence[int],
    own: Sequence[int],
    flight: np.ndarray,
) -> np.ndarray:
    """Return the fall of chi-square (G,) on each flight that the others' fit of `own` brings.

    The numbers at `beside` are fitted anyhow; `equations` are along all numbers at `theta` (P,),
    `flight` (W,) is the number of each window's flight.
    """

    def fall(columns: Sequence[int], inside: np.ndarray) -> float:
        at = np.array(sorted(columns), dtype=int)
        if not len(at):
            return 0.0
        hessian, gradient = equations.hessian[:, at][:, :, at], equations.gradient[:, at]
        known = hessian[~inside].sum(0), gradient[~inside].sum(0)
        moved, _ = gauss_newton_step(*known, theta, space, at.tolist())
        return float(2 * gradient[inside].sum(0) @ moved - moved @ hessian[inside].sum(0) @ moved)

    flights = [flight == number for number in np.unique(flight)]
    return np.array([fall([*beside, *own], one) - fall(beside, one) for one in flights])


def flights_agree(gains: np.ndarray) -> bool:
    """Return whether all flights but one gain (G,), and together without the one that gains most.

    Two flights or one cannot tell.
    """
    if len(gains) < 3:
        return True
    return bool((gains > 0.0).sum() >= len(gains) - 1 and gains.sum() > gains.max())


def could_be_best(
    fallen: Mapping[Candidate, float], candidate: Candidate, limits: Thresholds
) -> bool:
    """Return whether `candidate` could be the best: slopes alone say too little of large effects.

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


def chi2_fall(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, columns: Sequence[int]
) -> float:
    """Return the fall of chi-square to first order where the numbers at `columns` are fitted."""
    columns = sorted(set(columns))
    hessian = equations.hessian[:, columns][:, :, columns].sum(0)
    if not columns or np.trace(hessian) < 1e-12:
        return 0.0
    gradient, numbers = equations.gradient[:, columns].sum(0), equations.numbers_of(columns)
    return gauss_newton_step(hessian, gradient, theta, space, numbers)[1]
