"""Changes since reference flights of the same vehicle, compared with how unchanged flights differ.

The vehicle file need not be right: the residual of the reference flights, its mean and its
dependence on velocity, is subtracted from the other flights. The reference flights also give the
spread of flights of an unchanged vehicle (`rotor_spread`); the error of their own mean is common to
all others. A change is named where it is large compared with that spread, with all candidates
tested together (`chance`).

Where no mean has changed, an effect that shows in motion, as a drag, is fitted to each flight
alone. The values before and after are compared by Welch's test (Welch 1947, doi
10.1093/biomet/34.1-2.28) with a Bonferroni correction over all candidates and their numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import ttest_ind

from suite.diagnose.data.view import SmoothedFlight
from suite.diagnose.estimate.block import Block, Estimate, NormalEquations
from suite.diagnose.estimate.gauss_newton import chi2_fall, fit
from suite.diagnose.estimate.parameters import Candidate, at_bound, usual_first
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.evidence import Evidence, flights_agree
from suite.diagnose.evidence.moments import (
    ViewData,
    Weights,
    block_of,
    centred,
    compare,
    means_of,
    weights_of,
    whitened,
)
from suite.diagnose.evidence.views import ViewBlock, ViewEvidence, view_candidates
from suite.diagnose.search.chance import RotorSpread, chance_of, rotor_gain
from suite.diagnose.search.evaluation import Evaluation, NamedEffect, SearchResult


def flown_in(task: ViewEvidence, theta: np.ndarray) -> np.ndarray:
    """Return what the lack of a model may go with within a flight (M, 9), less its flights' means.

    Velocity, speed times velocity, and what the model gives at the numbers `theta` (P,): where it
    is too lively, or late, the reference flights lack as much of it.
    """
    motion = []
    for flight in task.flights:
        vel_b = flight.rows.vel_b
        speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
        motion.append(flight.form.mean @ np.concatenate([vel_b, speed * vel_b], axis=1))
    data = compare(task.view, task.model, theta, task.flights, ())
    flown = np.concatenate([np.concatenate(motion), data.value], axis=1)
    return centred(flown, data.flight)


BALANCE = {"force": (("thrust_scale",),), "torque": (("com_offset",), ("torque_trim",))}
"""By view, the effects that are fitted to the reference flights, one group after another, so that
the search for changes starts from a vehicle that is in balance as the real one was."""


def in_balance(reference: ViewEvidence) -> np.ndarray:
    """Return the numbers (P,) with which the reference flights are in balance on average."""
    space = reference.model.space
    theta, weights = space.array("start"), None
    for names in BALANCE[reference.view.name]:
        at = [i for i, entry in enumerate(space.entries) if entry.effect in names]
        weights = weights or weights_of(reference.left(theta), reference.limits)
        weights = weights._replace(trim=np.zeros(3))  # it is the trims that are fitted
        evidence = replace(reference, weights=weights)
        theta = fit(evidence, evidence.at(theta), at, limits=reference.limits)[0].theta
    return theta


def changed_task(
    reference: ViewEvidence, theta: np.ndarray, flights: Sequence[SmoothedFlight]
) -> ViewEvidence:
    """Return the task of `flights` with what the reference flights lack carried along.

    `theta` (P,) is what they have in balance.
    """
    data, flown = reference.left(theta), flown_in(reference, theta)
    inside = centred(data.residual, data.flight)
    spread = np.maximum(flown.std(axis=0), reference.limits.carried_least)
    scaled = flown / spread
    ridge = reference.limits.carried_ridge * len(scaled) * np.eye(scaled.shape[1])
    slope = np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ inside)
    mean = means_of(data.residual, data.flight).mean(axis=0)
    task = replace(reference, flights=flights)
    return replace(task, carried=flown_in(task, theta) / spread @ slope + mean)


@dataclass(frozen=True)
class ChangeEvidence(ViewEvidence):
    """What has changed since reference flights: means of flights, beyond how those differ.

    Fits are weighed by `weights`, which allow for errors of the vehicle file's gains.
    """

    sure: Weights | None = None
    """Without that, by which the first name stands out: what remains next to it is no finding
    where a gain may be off."""
    spread: RotorSpread | None = None

    @property
    def repeatability(self) -> np.ndarray:
        """(3,) how flights' means differ, without that."""
        return np.full(3, np.inf) if self.sure is None else self.sure.trim

    @property
    def name_p_value(self) -> float:
        """Chance of a false name of a change."""
        return self.limits.change_p_value

    def weighed(self, at: Estimate) -> tuple[ChangeEvidence, ViewBlock]:
        """Return this with its noise as it is, see `Evidence`."""
        return self, self.linearise(at)

    def scores(
        self,
        block: Block,
        equations: NormalEquations,
        theta: np.ndarray,
        named: Sequence[int],
        among: Sequence[Candidate],
        seed: int,
    ) -> list[CandidateScore]:
        """Return the scores of all that come near the best, best first, see `Evidence`.

        Few means hold little: in their squared error nearly every candidate is close to the best.
        """
        assert isinstance(block, ViewBlock) and self.spread and self.sure and self.weights
        weights = self.weights if named else self.sure
        each, along = np.arange(len(block.data.flight)), block.along
        equations = block_of(block.data, weights, each, along).equations
        without = chi2_fall(equations, theta, self.space, named)
        groups = [candidate.indices for candidate in among]
        gains = [chi2_fall(equations, theta, self.space, [*named, *g]) - without for g in groups]
        rng = np.random.default_rng([seed, len(named)])
        slope = whitened(block.data, weights)[1]
        sizes = self.spread.sizes(self.view.name, self.limits.change_draws, rng)
        # Each view has its share of the chance.
        views = len(self.spread.along)
        p_values = [views * p for p in chance_of(gains, slope, groups, named, sizes, rng)]
        found = [
            CandidateScore(candidate, gain - 2.0 * len(candidate.indices), p_value, 0.0)
            for candidate, gain, p_value in zip(among, gains, p_values, strict=True)
        ]
        least = self.limits.near_share * max((score.gain for score in found), default=0.0)
        return sorted((one for one in found if one.gain >= least), key=lambda one: -one.gain)

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return what a candidate takes, see `Evidence`."""
        if at_bound(self.space, at.theta, candidate) or not flights_agree(gains):
            return None
        return Evidence.share(self, now, at, then, candidate, gains)

    def order(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return the plausible first, then the fewer numbers, then the more usual."""
        far, _, place = usual_first(self.space, at.theta, candidate)
        return far, len(candidate.indices), place


def changed(
    reference: ViewEvidence, flights: Sequence[SmoothedFlight], spread: RotorSpread
) -> tuple[ChangeEvidence, Estimate]:
    """Return the evidence of what has changed since `reference`, and where its search begins."""
    start = in_balance(reference)
    task, count = changed_task(reference, start, flights), len(reference.flights)
    gain, left = rotor_gain(task), task.left(start)
    weights = weights_of(left, task.limits)
    # What changes within a flight is the model's flaw as well as the vehicle's: means are judged.
    moments = np.unique(left.flight, return_counts=True)[1].mean()
    alone = weights.scatter * np.sqrt(weights.memory / moments)
    weights = weights._replace(scatter=alone, memory=np.ones(3))
    trim = spread.along[task.view.name] * gain
    if task.view.in_world:
        trim[:2] = np.inf  # an attitude's trim, which few flights do not identify
    base = np.where(np.isfinite(trim), trim, 0.0) / np.sqrt(count)
    weights = weights._replace(trim=trim, base=base)
    away = np.abs(means_of(left.residual, left.flight).mean(axis=0))
    wide = weights._replace(trim=np.hypot(trim, task.limits.gain_error * away))
    # Few means hold little: all that explains what stands out is an alternative.
    limits = replace(task.limits, rival_share=1.0)
    evidence = ChangeEvidence(
        task.view, task.model, flights, limits, task.carried, True, wide, weights, spread
    )
    return evidence, evidence.at(start)


SLIGHT = 0.1
"""Share of a change by which its numbers may lie beyond what is physical; noise does that."""


def within_flights(data: ViewData) -> ViewData:
    """Return `data` with residual and slope less their flights' means."""
    return data._replace(
        residual=centred(data.residual, data.flight), slope=centred(data.slope, data.flight)
    )


def own_changes(inside: ViewData, indices: Sequence[int], scatter: np.ndarray) -> np.ndarray:
    """Return by how much each of F flights alone wants the K numbers elsewhere, (F, K).

    Args:
        inside: from `within_flights`.
        indices: the numbers.
        scatter: (3,) noise by axis.
    """
    found = []
    for number in np.unique(inside.flight):
        rows = inside.flight == number
        slope = (inside.slope[rows][..., list(indices)] / scatter[:, None]).reshape(
            -1, len(indices)
        )
        left = (inside.residual[rows] / scatter).ravel()
        found.append(np.linalg.lstsq(slope, left, rcond=1e-6)[0])
    return np.array(found)


def search_motion_change(
    reference: ViewEvidence, task: ViewEvidence, among: Sequence[Candidate]
) -> SearchResult | None:
    """Return the one of `among` that has changed since `reference`, None where none stands out.

    Its numbers are totals. Both sets need two flights at least.
    """
    start, limits = in_balance(reference), task.limits
    sets = [within_flights(one.left(start, None)) for one in (reference, task)]
    if min(len(np.unique(one.flight)) for one in sets) < 2:
        return None
    weights, space = weights_of(sets[1], limits), task.space
    evidence = replace(task, weights=weights)
    left = view_candidates(among, evidence.linearise(evidence.at(start)))
    tests = sum(len(one.indices) for one in left)
    tried = []
    for candidate in left:
        at = list(candidate.indices)
        before, after = (own_changes(one, at, weights.scatter) for one in sets)
        _, chance = ttest_ind(before, after, equal_var=False)
        p_value = float(np.nan_to_num(np.asarray(chance), nan=1.0).min()) * tests
        if p_value > limits.change_p_value:
            continue
        since, wanted = before.mean(axis=0), after.mean(axis=0)
        gains, whole = _gains(sets[1], at, since, after, weights.scatter)
        share = float(gains.sum() / whole)
        theta = start.copy()
        theta[at] += wanted
        possible = np.clip(theta, space.array("low"), space.array("high"))
        beyond = np.linalg.norm((possible - theta)[at])
        if beyond > SLIGHT * np.linalg.norm(wanted - since) or at_bound(space, possible, candidate):
            continue  # that is no fit
        if flights_agree(gains) and share >= limits.least_view_share:
            each = tuple(gains.tolist())
            name = NamedEffect(candidate, p_value, sum(each), gains=each, share=share)
            tried.append((name, since, possible))
    if not tried:
        return None
    most = max(name.share for name, *_ in tried)
    alike = [one for one in tried if one[0].share >= (1.0 - limits.rival_share) * most]
    alike.sort(key=lambda one: usual_first(space, one[2], one[0].candidate))
    (name, since, theta), *others = alike
    begun = start.copy()
    begun[list(name.candidate.indices)] += since
    rivals = tuple(dict.fromkeys(other.candidate.name for other, *_ in others))
    at = evidence.at(theta)
    block = evidence.linearise(at, sorted(name.candidate.indices))
    last = Evaluation(evidence, at, block)
    named = (replace(name, rivals=rivals),)
    return SearchResult(named, evidence.at(begun), last, last, [], 0.0)


def _gains(
    inside: ViewData, at: list[int], since: np.ndarray, after: np.ndarray, scatter: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return by how much each flight's squared error falls, and the sum of it before.

    From the reference's numbers `since` (K,) to those that the other flights want; `after` (F, K).
    """
    gains, whole = [], 0.0
    for k, number in enumerate(np.unique(inside.flight)):
        rows = inside.flight == number
        slope, others = inside.slope[rows][..., at], np.delete(after, k, axis=0).mean(axis=0)
        errors = [
            float((((inside.residual[rows] - slope @ change) / scatter) ** 2).sum())
            for change in (since, others)
        ]
        gains.append(errors[0] - errors[1])
        whole += errors[0]
    return np.array(gains), max(whole, 1e-12)
