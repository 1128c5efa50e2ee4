"""A view's flights at one estimate: what is left, how it is weighed, and each flight's own say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.view import SmoothedFlight, View
from suite.diagnose.estimate.gauss_newton import NormalEquations, along_numbers, gauss_newton_step
from suite.diagnose.estimate.intervals import half_widths95
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.evidence.force_torque import ForceModel
from suite.diagnose.evidence.moments import ViewData, compare, means_of, units_of
from suite.diagnose.evidence.weigh import Weights, blocks_of, equations_of, weighed, weights_of
from suite.diagnose.search.composites import acts_through, begin_of, lent_at
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

MANY = 1000
"""Degrees of freedom of what all moments tell."""


class ViewTask(NamedTuple):
    """What a view's search is given."""

    view: View
    model: ForceModel
    flights: Sequence[SmoothedFlight]
    limits: Thresholds = THRESHOLDS
    carried: np.ndarray | None = None
    """(M, 3) what the model is known to lack in these flights, taken off what is left."""
    means: bool = False
    """Only the mean of each flight counts, and nothing that changes within one."""


class ViewEquations(NamedTuple):
    """The normal equations of a view's blocks along all numbers, at one estimate."""

    theta: np.ndarray
    """(P,)"""
    data: ViewData
    weights: Weights
    block: NormalEquations
    """Of B blocks."""
    flight: np.ndarray
    """(B,) number of each block's flight."""


def left_of(task: ViewTask, theta: np.ndarray) -> ViewData:
    """Return what `task`'s flights leave at the numbers `theta` (P,)."""
    data = compare(task.view, task.model, theta, task.flights)
    if task.carried is not None:
        data = data._replace(residual=data.residual - task.carried)
    return in_means(data) if task.means else data


def in_means(data: ViewData) -> ViewData:
    """Return the mean of `data` over each flight."""
    flight, *others = (means_of(field, data.flight) for field in data)
    return ViewData(flight.astype(int), *others)


def look(task: ViewTask, theta: np.ndarray, weights: Weights) -> ViewEquations:
    """Return the equations of `task` at the numbers `theta` (P,)."""
    data = left_of(task, theta)
    block = _blocks(task, data)
    first = np.unique(block, return_index=True)[1]
    return ViewEquations(
        theta, data, weights, equations_of(data, weights, block), data.flight[first]
    )


def _blocks(task: ViewTask, data: ViewData) -> np.ndarray:
    """Return the number of each moment's block (M,)."""
    return np.arange(len(data.flight)) if task.means else blocks_of(data, task.limits)


def fitted(
    task: ViewTask, begin: ViewEquations, indices: Sequence[int], rounds: int | None = None
) -> ViewEquations:
    """Return the equations where the numbers at `indices` fit best (Gauss-Newton, halved).

    At most `rounds` steps are taken, those of the limits if not given.
    """
    best, at = begin, np.array(sorted(indices), dtype=int)
    low, high = (task.model.space.array(name)[at] for name in ("low", "high"))
    for _ in range((rounds or task.limits.view_rounds) if len(at) else 0):
        hessian = best.block.hessian.sum(axis=0)[np.ix_(at, at)]
        gradient = best.block.gradient.sum(axis=0)[at]
        change, promised = gauss_newton_step(
            hessian, gradient, best.theta, task.model.space, at.tolist()
        )
        if promised < task.limits.converged:
            break
        share, chi2 = 1.0, float(best.block.chi2.sum())
        while share > 0.1:
            theta = best.theta.copy()
            theta[at] = np.clip(theta[at] + share * change, low, high)
            trial = look(task, theta, best.weights)
            if float(trial.block.chi2.sum()) <= chi2:
                break
            share /= 2.0
        else:
            break
        best = trial
    return best


def with_lent(task: ViewTask, now: ViewEquations, among: Sequence[Candidate]) -> NormalEquations:
    """Return the equations of `now`, also along what acts through parts of composites alone."""
    acts = np.abs(now.data.slope).max(axis=(0, 1)) > 0.0
    lent = lent_at(task.model.space, now.theta, among, acts)
    if lent is None:
        return now.block
    there = left_of(task, lent.theta).slope[..., list(lent.numbers)]
    data = now.data._replace(slope=np.concatenate([now.data.slope, there], axis=-1))
    return equations_of(data, now.weights, _blocks(task, data))._replace(lent=lent.numbers)


def fitted_beside(
    task: ViewTask,
    now: ViewEquations,
    block: NormalEquations,
    beside: Sequence[int],
    candidate: Candidate,
) -> ViewEquations:
    """Return the equations with `candidate` fitted beside other numbers, near enough to compare it.

    `block` is `with_lent` at `now`.
    """
    at, space = [*beside, *candidate.indices], task.model.space
    lent = [number for number in block.lent if number in candidate.indices]
    if not candidate.parts or not lent:
        rounds = task.limits.bilinear_rounds if acts_through(candidate) else None
        return fitted(task, now, at, rounds)
    columns = sorted({*beside, *block.columns_of(candidate)})
    change, told = along_numbers(block, now.theta, space, columns)
    begin = begin_of(space, now.theta, candidate, lent, change, told)
    return fitted(task, look(task, begin, now.weights), at, task.limits.bilinear_rounds)


def chi2_by_flight(task: ViewTask, found: ViewEquations, indices: Sequence[int]) -> np.ndarray:
    """Return the squared error (F,) of each flight under what the others fit of `indices`.

    To first order about `found`, where all flights fit them. A lone flight's thirds stand for
    flights.
    """
    at, flight = np.array(sorted(indices), dtype=int), units_of(found.flight)
    hessian = found.block.hessian[:, at][:, :, at]
    gradient, chi2 = found.block.gradient[:, at], []
    for number in np.unique(flight):
        inside = flight == number
        moved = np.zeros(len(at))
        if len(at):
            known = hessian[~inside].sum(axis=0), gradient[~inside].sum(axis=0)
            moved, _ = gauss_newton_step(*known, found.theta, task.model.space, at.tolist())
        own, pull = hessian[inside].sum(axis=0), gradient[inside].sum(axis=0)
        whole = found.block.chi2[inside].sum() - 2.0 * pull @ moved + moved @ own @ moved
        chi2.append(float(whole))
    return np.array(chi2)


def share_taken(task: ViewTask, now: ViewEquations, then: ViewEquations) -> float:
    """Return the share of the squared error of `now` that `then` takes away.

    Weighed by the noise that `then` leaves: by that of `now` a slow effect is noise with a memory.
    """
    noise = weights_of(then.data, task.limits)
    left, had = (float((weighed(one.data, noise)[0] ** 2).sum()) for one in (then, now))
    return 1.0 - left / had


def half_widths(found: ViewEquations, indices: Sequence[int]) -> np.ndarray:
    """Return half-widths (K,) of 95 % intervals of the numbers at `indices`, in order.

    Blocks and flights are draws; the noise itself is known by all moments, which are many.
    """
    at = np.array(sorted(indices), dtype=int)
    block = found.block
    along = block._replace(hessian=block.hessian[:, at][:, :, at], gradient=block.gradient[:, at])
    return half_widths95(along, found.flight, noise_freedom=MANY)
