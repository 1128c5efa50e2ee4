"""What has changed since other flights of a vehicle, beyond how those differ among themselves.

The vehicle file need not be right: what the reference flights leave of it, on average and with the
velocity, is carried along. How much flights of an unchanged vehicle differ is taken from them too
(`rotor_spread`); the reference flights' mean is off by it as well, for all others alike. A change
is named where it is large beside that, for all candidates together (`chance`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.change.chance import RotorSpread, chance_of, rotor_gain
from suite.diagnose.data.view import SmoothedFlight
from suite.diagnose.estimate.gauss_newton import gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, indices_of
from suite.diagnose.evidence.moments import centred, compare, means_of
from suite.diagnose.evidence.view_equations import (
    ViewEquations,
    ViewTask,
    chi2_by_flight,
    fitted,
    left_of,
    look,
)
from suite.diagnose.evidence.weigh import Weights, weighed, weights_of
from suite.diagnose.search.plausible import at_bound, implausible
from suite.diagnose.search.rivals import flights_agree
from suite.diagnose.search.view_search import ViewName, ViewSearch, view_candidates


def flown_in(task: ViewTask, theta: np.ndarray) -> np.ndarray:
    """Return what the lack of a model may go with within a flight (M, 9), less its flights' means.

    Velocity, speed times velocity, and what the model says at the numbers `theta` (P,): where it is
    too lively, or late, the reference flights lack as much of it.
    """
    motion = []
    for flight in task.flights:
        vel_b = flight.rows.vel_b
        speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
        motion.append(flight.form.mean @ np.concatenate([vel_b, speed * vel_b], axis=1))
    data = compare(task.view, task.model, theta, task.flights)
    flown = np.concatenate([np.concatenate(motion), data.value], axis=1)
    return centred(flown, data.flight)


BALANCE = {"force": (("thrust_scale",),), "torque": (("com_offset",), ("torque_trim",))}
"""By view, the effects that are fitted to the reference flights, one group after another, so that
changes are looked for about a vehicle that is in balance as the real one was."""


def in_balance(reference: ViewTask) -> np.ndarray:
    """Return the numbers (P,) with which the reference flights are in balance on average."""
    space = reference.model.space
    theta, weights = space.array("start"), None
    for names in BALANCE[reference.view.name]:
        at = [i for i, entry in enumerate(space.entries) if entry.effect in names]
        weights = weights or weights_of(left_of(reference, theta), reference.limits)
        weights = weights._replace(trim=np.zeros(3))  # it is the trims that are fitted
        theta = fitted(reference, look(reference, theta, weights), at).theta
    return theta


def changed_task(
    reference: ViewTask, theta: np.ndarray, flights: Sequence[SmoothedFlight]
) -> ViewTask:
    """Return the task of `flights` with what the reference flights lack carried along.

    `theta` (P,) is what they have in balance.
    """
    data, flown = left_of(reference, theta), flown_in(reference, theta)
    inside = centred(data.residual, data.flight)
    spread = np.maximum(flown.std(axis=0), reference.limits.carried_least)
    scaled = flown / spread
    ridge = reference.limits.carried_ridge * len(scaled) * np.eye(scaled.shape[1])
    slope = np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ inside)
    mean = means_of(data.residual, data.flight).mean(axis=0)
    task = reference._replace(flights=flights)
    return task._replace(carried=flown_in(task, theta) / spread @ slope + mean)


def search_change(
    reference: ViewTask,
    flights: Sequence[SmoothedFlight],
    spread: RotorSpread,
    among: Sequence[Candidate],
    seed: int = 0,
) -> ViewSearch:
    """Return which of `among` explain what has changed since the flights of `reference`.

    `seed` is of the draws of what chance does.
    """
    start = in_balance(reference)
    task, count = changed_task(reference, start, flights), len(reference.flights)
    gain, left = rotor_gain(task), left_of(task, start)
    weights = weights_of(left, task.limits)
    # What changes within a flight is the model's flaw as well as the vehicle's: means are judged.
    moments = np.unique(left.flight, return_counts=True)[1].mean()
    alone = weights.scatter * np.sqrt(weights.memory / moments)
    weights = weights._replace(scatter=alone, memory=np.ones(3))
    task = task._replace(means=True)
    trim = spread.along[task.view.name] * gain
    if task.view.in_world:
        trim[:2] = np.inf  # an attitude's trim, of which few flights tell too little
    base = np.where(np.isfinite(trim), trim, 0.0) / np.sqrt(count)
    weights = weights._replace(trim=trim, base=base)
    first = now = look(task, start, weights)
    among = view_candidates(among, first)
    doubted = weights._replace(trim=np.hypot(trim, task.limits.gain_doubt * _mean_change(first)))
    named, rng = list[ViewName](), np.random.default_rng(seed)
    while len(named) < task.limits.most_names:
        found = _next_change(task, now, doubted, named, among, spread, rng)
        if found is None:
            break
        name, now = found  # what is left is no finding where a gain may be off: doubted from here
        named.append(name)
    return ViewSearch(task, tuple(named), first, now)


def _mean_change(found: ViewEquations) -> np.ndarray:
    """Return the size (3,) of what is left on average over the flights."""
    return np.abs(means_of(found.data.residual, found.data.flight).mean(axis=0))


def _next_change(
    task: ViewTask,
    now: ViewEquations,
    doubted: Weights,
    named: Sequence[ViewName],
    among: Sequence[Candidate],
    spread: RotorSpread,
    rng: np.random.Generator,
) -> tuple[ViewName, ViewEquations] | None:
    """Return the change that stands out most beside `named`, and the equations with it.

    Which one it is, is judged by weights that doubt the vehicle file's gains.
    """
    beside, space = indices_of([n.candidate for n in named]), task.model.space
    left = [c for c in among if not set(c.indices) & set(beside)]
    hessian, gradient = now.block.hessian.sum(axis=0), now.block.gradient.sum(axis=0)

    def fall(columns: Sequence[int]) -> float:
        at = np.array(sorted(columns), dtype=int)
        if not len(at):
            return 0.0
        return gauss_newton_step(
            hessian[np.ix_(at, at)], gradient[at], now.theta, space, at.tolist()
        )[1]

    without = fall(beside)
    gains = [fall([*beside, *candidate.indices]) - without for candidate in left]
    slope = weighed(now.data, now.weights)[1]
    groups = [candidate.indices for candidate in left]
    sizes = spread.sizes(task.view.name, task.limits.change_draws, rng)
    # Each view has its share of the chance.
    views = len(spread.along)
    p_values = [views * p for p in chance_of(gains, slope, groups, beside, sizes, rng)]
    tried = [
        (gain - 2.0 * len(candidate.indices), candidate, p_value)
        for gain, candidate, p_value in zip(gains, left, p_values, strict=True)
        if p_value <= task.limits.change_p_value
    ]
    if not tried:
        return None
    most = max(gain for gain, *_ in tried)
    near = [one for one in tried if one[0] >= task.limits.near_share * most]
    begin, fits = look(task, now.theta, doubted), []
    each = chi2_by_flight(task, begin, beside)
    for _, candidate, p_value in sorted(near, key=lambda one: -one[0])[: task.limits.short_list]:
        at = [*beside, *candidate.indices]
        then = fitted(task, begin, at)
        sound = not at_bound(space, then.theta, candidate)
        if sound and flights_agree(each - chi2_by_flight(task, then, at)):
            cost = float(then.block.chi2.sum()) + 2.0 * len(candidate.indices)
            fits.append((cost, candidate, p_value, then))
    if not fits:
        return None
    before, least = float(begin.block.chi2.sum()), min(one[0] for one in fits)
    alike = [one for one in fits if one[0] - least <= task.limits.rival_chi2]
    # Of what explains as much: the plausible, then the fewer numbers, then the more usual.
    _, best, p_value, then = min(
        alike,
        key=lambda one: (
            bool(implausible(space, one[3].theta, one[1])),
            len(one[1].indices),
            list(EFFECTS).index(one[1].name),
            one[0],
        ),
    )
    rivals = dict.fromkeys(candidate.name for _, candidate, *_ in alike)
    rivals.pop(best.name, None)
    share = 1.0 - float(then.block.chi2.sum()) / max(before, 1e-9)
    return ViewName(best, p_value, (), share, tuple(rivals)), then
