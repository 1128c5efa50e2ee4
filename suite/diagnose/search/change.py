"""Finds what has changed in a vehicle since reference flights, earlier flights of the same vehicle.

The vehicle file need not be right: the residual of the reference flights (its mean, and its
dependence on velocity) is subtracted from that of the later flights. The reference flights also
show how much flights of an unchanged vehicle differ (`rotor_spread`). A change is named if it is
large compared with that spread.

Some effects, such as a drag, only act in motion, and hardly change the mean of a flight. So where
no mean has changed, each candidate is fitted to each flight alone. The fitted values of the
reference flights and of the later ones are compared by Welch's test (Welch 1947, doi
10.1093/biomet/34.1-2.28), with a Bonferroni correction over all candidates, their parameters, and
both views.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import ttest_ind

from suite.diagnose.data.view import SmoothedFlight
from suite.diagnose.estimate.block import Block, Estimate, NormalEquations, without_nuisance
from suite.diagnose.estimate.gauss_newton import chi2_fall
from suite.diagnose.estimate.parameters import Candidate, at_bound, usual_first
from suite.diagnose.estimate.permutation import CandidateScore, corrected_p_values
from suite.diagnose.evidence.evidence import Evaluation, flights_agree
from suite.diagnose.evidence.view_means import (
    ViewData,
    Weights,
    block_of,
    centred,
    means_of,
    weights_of,
    whitened,
)
from suite.diagnose.evidence.views import ViewBlock, ViewEvidence, view_candidates
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.thresholds import Thresholds

BALANCE = {"force": (("thrust_scale",),), "torque": (("com_offset",), ("torque_trim",))}
"""Effects that are fitted to the reference flights, by view and one group after another. So the
search for changes starts from a vehicle whose mean forces and torques are those of the real one."""
BOUND_SHARE = 0.1
"""Parameters may exceed their physical bounds by this share of a change, because of noise."""


def _motion_inputs(task: ViewEvidence, theta: np.ndarray) -> np.ndarray:
    """Return the inputs (M, 9) of a regression of a model's error on the motion, without means.

    They are the velocity, the speed times the velocity, and the model's accelerations at `theta`
    (P,), which stand for an error of its gain or delay.
    """
    motion = []
    for flight in task.flights:
        vel_b = flight.rows.vel_b
        speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
        motion.append(flight.form.mean @ np.concatenate([vel_b, speed * vel_b], axis=1))
    data = task.residuals(theta)
    inputs = np.concatenate([np.concatenate(motion), data.value], axis=1)
    return centred(inputs, data.flight)


def fit_balance(reference: ViewEvidence) -> np.ndarray:
    """Return parameters (P,) with which the model has the mean accelerations of `reference`."""
    space = reference.model.space
    theta = space.array("start")
    weights = weights_of(reference.residuals(theta), reference.limits)
    # Here the trims are fitted, and not noise.
    evidence = replace(reference, weights=weights._replace(trim=np.zeros(3)))
    for names in BALANCE[reference.view.name]:
        indices = [i for i, entry in enumerate(space.entries) if entry.effect in names]
        theta = evidence.fitted(Estimate(theta), indices).at.theta
    return theta


def less_reference_residual(
    reference: ViewEvidence, theta: np.ndarray, flights: Sequence[SmoothedFlight]
) -> ViewEvidence:
    """Return the evidence of `flights` less the residual of `reference` at `theta` (P,).

    That is its mean and a ridge regression on the motion.
    """
    data, inputs = reference.residuals(theta), _motion_inputs(reference, theta)
    deviation = centred(data.residual, data.flight)
    spread = np.maximum(inputs.std(axis=0), reference.limits.carried_least)
    scaled = inputs / spread
    ridge = reference.limits.carried_ridge * len(scaled) * np.eye(scaled.shape[1])
    slope_of_error = np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ deviation)
    mean = means_of(data.residual, data.flight).mean(axis=0)
    later = replace(reference, flights=flights)
    return replace(later, carried=_motion_inputs(later, theta) / spread @ slope_of_error + mean)


@dataclass(frozen=True)
class RotorSpread:
    """Spread from flight to flight of one unchanged vehicle, relative to a rotor's thrust."""

    share: float
    """Standard deviation between flights, relative to a rotor's thrust, pooled over all axes."""
    freedom: int
    """Degrees of freedom of this pooled estimate."""
    along: Mapping[str, np.ndarray]
    """(3,) standard deviation along each axis, by view (force or torque): a weighted mean of the
    estimate of the axis alone and the pooled estimate."""
    freedom_along: Mapping[str, np.ndarray]
    """(3,) degrees of freedom of the estimate of each axis alone, by view."""

    @property
    def words(self) -> str:
        """Description of how much flights of an unchanged vehicle differ, for people."""
        return (
            "Within the reference flights and within the new ones, flights differ as if each "
            f"rotor's thrust varied by {100 * self.share:.1f} % from flight to flight "
            f"({self.freedom} degrees of freedom). The differences along each axis count as well. "
            "A change is named if it exceeds these differences significantly."
        )

    def variance_ratios(
        self, view: str, limits: Thresholds, rng: np.random.Generator
    ) -> np.ndarray:
        """Return draws (D, 3) of the estimated variance over the true one, by axis of `view`.

        Where the estimate is too small by chance, any change seems too large.
        """
        freedom = np.concatenate(list(self.freedom_along.values()))
        square = rng.chisquare(np.maximum(freedom, 1e-9), (limits.change_draws, len(freedom)))
        pooled = square.sum(axis=1, keepdims=True) / max(self.freedom, 1)
        axes = 3 * list(self.freedom_along).index(view) + np.arange(3)
        return _moderated(pooled, square[:, axes], freedom[axes], limits)


def _moderated(
    pooled: np.ndarray | float, square: np.ndarray, freedom: np.ndarray, limits: Thresholds
) -> np.ndarray:
    """Return a weighted mean of the pooled variance and of each axis's own (Smyth 2004)."""
    return (limits.spread_freedom * pooled + square) / (limits.spread_freedom + freedom)


def rotor_gain(task: ViewEvidence) -> np.ndarray:
    """Return the accelerations (3,) by a relative change of a rotor's thrust, in the view's unit.

    It is the root of the sum of the four rotors' squares.
    """
    space = task.model.space
    weak_motor = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    slope = task.residuals(space.array("start"), weak_motor).slope.mean(axis=0)
    return np.sqrt((slope**2).sum(axis=1))


def deviations(flights: ViewEvidence, theta: np.ndarray) -> np.ndarray:
    """Return the mean residual (F, 3) of each of F flights, less that of all flights."""
    data = flights.residuals(theta)
    means = means_of(data.residual, data.flight)
    return means - means.mean(axis=0)


def rotor_spread(sets: Sequence[ViewEvidence]) -> RotorSpread:
    """Return the spread of flights within each of `sets` (the reference and later flights)."""
    square: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))
    freedom: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for task in sets:
        change, gain = deviations(task, task.start.theta), rotor_gain(task)
        axes = gain > task.limits.least_rotor_gain * gain.max()
        if task.view.in_world:
            axes &= np.arange(3) == 2  # rotors only push along body z
        square[task.view.name] += ((change / np.where(axes, gain, np.inf)) ** 2).sum(axis=0)
        freedom[task.view.name] += axes * (len(change) - 1)
    count = int(sum(by_axis.sum() for by_axis in freedom.values()))
    share = float(np.sqrt(sum(by_axis.sum() for by_axis in square.values()) / max(count, 1)))
    limits = sets[0].limits
    along = {
        name: np.sqrt(_moderated(share**2, square[name], freedom[name], limits)) for name in square
    }
    return RotorSpread(share, count, along, dict(freedom))


@dataclass(frozen=True, kw_only=True)
class ChangeEvidence(ViewEvidence):
    """Evidence of a change since reference flights: means of flights, and their usual spread.

    A gain is the acceleration that a change gives; it is wrong if the vehicle file has wrong
    inertia, arms or rotor torque. The noise `weights` of the fits contain this error.
    """

    exact_weights: Weights
    """Noise without errors of the gains, for the test of the first name. Further names must be
    significant with these errors, since the first change times a wrong gain leaves a residual."""
    spread: RotorSpread
    """Spread of flights of the unchanged vehicle."""

    @property
    def repeatability(self) -> np.ndarray:
        """(3,) standard deviation of flights' means, without errors of the gains."""
        return self.exact_weights.trim

    def estimate_noise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence with its noise unchanged, since it is known; see `Evidence`."""
        return self.relinearise(at)

    def scores(
        self, current: Evaluation, named: Sequence[int], among: Sequence[Candidate], seed: int
    ) -> list[CandidateScore]:
        """Return the scores of all candidates close to the best, as most are with few means."""
        block, theta = current.block, current.at.theta
        assert isinstance(block, ViewBlock) and self.weights
        weights = self.weights if named else self.exact_weights
        equations = block_of(block.data, weights, block.along, self.limits).equations
        without = chi2_fall(equations, theta, self.space, named)
        groups = [candidate.indices for candidate in among]
        gains = [chi2_fall(equations, theta, self.space, [*named, *g]) - without for g in groups]
        rng = np.random.default_rng([seed, len(named)])
        slope = whitened(block.data, weights)[1]
        ratios = self.spread.variance_ratios(self.view.name, self.limits, rng)
        views = len(self.spread.along)  # Bonferroni's correction for the views
        by_view = corrected_p_values(gains, slope, groups, named, ratios, rng)
        p_values = [min(views * p, 1.0) for p in by_view]
        scores = [
            CandidateScore(candidate, gain - 2.0 * len(candidate.indices), p_value, 0.0)
            for candidate, gain, p_value in zip(among, gains, p_values, strict=True)
        ]
        least = self.limits.near_share * max((score.gain for score in scores), default=0.0)
        return sorted((s for s in scores if s.gain >= least), key=lambda s: -s.gain)

    def accepts(
        self, before: Block, after: Evaluation, candidate: Candidate, gains: np.ndarray
    ) -> bool:
        """Return whether a candidate may be named; see `Evidence`."""
        return not at_bound(self.space, after.at.theta, candidate) and flights_agree(gains)

    def preference(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return a sort key: plausible candidates, then few parameters, then the catalogue."""
        far, _, place = usual_first(self.space, at.theta, candidate)
        return far, len(candidate.indices), place


def change_evidence(
    reference: ViewEvidence, flights: Sequence[SmoothedFlight], spread: RotorSpread
) -> Evaluation:
    """Return the evidence of changes in `flights` since `reference`, at the start of its search."""
    start = fit_balance(reference)
    task, count = less_reference_residual(reference, start, flights), len(reference.flights)
    gain, data = rotor_gain(task), task.residuals(start)
    weights = weights_of(data, task.limits)
    # Residuals also vary within a flight, by errors of the model. So only the flights' means are
    # compared, with the noise that such a mean has.
    means = np.unique(data.flight, return_counts=True)[1].mean()
    noise_of_mean = weights.scatter * np.sqrt(weights.memory / means)
    weights = weights._replace(scatter=noise_of_mean, memory=np.ones(3))
    trim = spread.along[task.view.name] * gain
    if task.view.in_world:
        trim[:2] = np.inf  # forces across the thrust: a tilted attitude would look the same
    base = np.where(np.isfinite(trim), trim, 0.0) / np.sqrt(count)
    weights = weights._replace(trim=trim, base=base)
    mean_change = np.abs(means_of(data.residual, data.flight).mean(axis=0))
    with_gain_error = weights._replace(trim=np.hypot(trim, task.limits.gain_error * mean_change))
    # The means contain little information: every candidate that explains them is an alternative,
    # even one that explains much less than the best (a share of 1 switches that limit off).
    limits = replace(task.limits, rival_share=1.0, name_p_value=task.limits.change_p_value)
    evidence = ChangeEvidence(
        task.view, task.model, flights, task.carried, True, with_gain_error,
        exact_weights=weights, spread=spread, limits=limits,
    )  # fmt: skip
    return evidence.relinearise(Estimate(start))


def within_flights(data: ViewData) -> ViewData:
    """Return `data` with each flight's mean subtracted from its residuals and slopes."""
    return data._replace(
        residual=centred(data.residual, data.flight), slope=centred(data.slope, data.flight)
    )


def equations_by_flight(inside: ViewData, scatter: np.ndarray) -> NormalEquations:
    """Return the normal equations of each flight alone, with the noise `scatter` (3,) by axis."""
    numbers, place = np.unique(inside.flight, return_inverse=True)
    residual, slope = inside.residual / scatter, inside.slope / scatter[:, None]
    along, start_s = range(slope.shape[2]), np.zeros(len(numbers))
    return without_nuisance(residual, slope, along, place.ravel(), numbers, start_s).equations


def fit_each_flight(equations: NormalEquations) -> np.ndarray:
    """Return the change (F, K) of the K parameters of `equations` that fits each flight alone."""
    inverse = np.linalg.pinv(equations.hessian, 1e-12, hermitian=True)
    return (inverse @ equations.gradient[..., None])[..., 0]


def search_motion_change(
    reference: ViewEvidence, task: ViewEvidence, among: Sequence[Candidate], views: int
) -> SearchResult | None:
    """Return the candidate that has changed since `reference`; None where none is significant.

    Its parameters are totals. Each set needs two flights; `views` is the number that is searched.
    """
    start, limits, space = fit_balance(reference), task.limits, task.space
    sets = [within_flights(one.residuals(start, None)) for one in (reference, task)]
    weights = weights_of(sets[1], limits)
    evidence = replace(task, weights=weights)
    acting = view_candidates(among, evidence.linearise(Estimate(start)))
    tests = views * sum(len(one.indices) for one in acting)
    equations = [equations_by_flight(one, weights.scatter) for one in sets]
    # Names, the shares of the error that they explain, and the parameters (P,) of the later flights
    # and of the reference flights.
    changes = list[tuple[NamedEffect, float, np.ndarray, np.ndarray]]()
    for candidate in acting:
        indices = list(candidate.indices)
        earlier, later = (one.along_numbers(indices) for one in equations)
        before, after = fit_each_flight(earlier), fit_each_flight(later)
        _, p_values = ttest_ind(before, after, equal_var=False)
        p_value = float(np.nan_to_num(np.asarray(p_values), nan=1.0).min()) * tests
        if p_value > limits.change_p_value:
            continue
        mean_before, mean_after = before.mean(axis=0), after.mean(axis=0)
        # The fall of each later flight's error by the mean of the fits to all other later flights.
        by_others = (after.sum(axis=0) - after) / (len(after) - 1)
        unchanged = later.chi2_at(mean_before)
        gains = unchanged - later.chi2_at(by_others)
        share = float(gains.sum() / max(unchanged.sum(), 1e-12))
        theta, theta_before = start.copy(), start.copy()
        theta[indices] += mean_after
        theta_before[indices] += mean_before
        # Reject values that are physically impossible by more than noise.
        possible = np.clip(theta, space.array("low"), space.array("high"))
        beyond = np.linalg.norm((possible - theta)[indices])
        allowed = BOUND_SHARE * np.linalg.norm(mean_after - mean_before)
        if beyond > allowed or at_bound(space, possible, candidate):
            continue
        if flights_agree(gains) and share >= limits.least_view_share:
            by_flight = tuple(gains.tolist())
            name = NamedEffect(candidate, p_value, sum(by_flight), gains=by_flight)
            changes.append((name, share, possible, theta_before))
    if not changes:
        return None
    # Of the candidates that explain about as much as the best, the most usual one is named.
    least = (1.0 - limits.rival_share) * max(share for _, share, *_ in changes)
    close = [one for one in changes if one[1] >= least]
    close.sort(key=lambda one: usual_first(space, one[2], one[0].candidate))
    name, _, theta, theta_before = close[0]
    rivals = tuple(dict.fromkeys(other.candidate.name for other, *_ in close[1:]))
    last = evidence.fitted(Estimate(theta), sorted(name.candidate.indices), 0)
    named = (replace(name, rivals=rivals),)
    return SearchResult(named, Estimate(theta_before), last, last, [])
