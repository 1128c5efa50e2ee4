"""The search: one effect after another, each against the null, then every name against its rivals.

What is named must lower the error on windows left out by more than the best of all candidates does
on data with shuffled signs. A rival that explains the same windows as well is an alternative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.colour import Noise, left_as_noise, measured_noise
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.fit.model import Linearisation, RolloutModel
from suite.diagnose.fit.normal_equations import (
    Estimate,
    NormalEquations,
    fit,
    gauss_newton_step,
    normal_equations_of,
    start_estimate,
)
from suite.diagnose.fit.parameters import Candidate, ParameterSpace, indices_of
from suite.diagnose.fit.permutation import CandidateScore, folds_of, score_candidates
from suite.diagnose.fit.whitening import Whitening, make_whitening
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


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


@dataclass(frozen=True)
class SearchResult:
    """What a search found."""

    named: tuple[NamedEffect, ...]
    windows: FlightWindows
    """What was fitted, as long as the model could be trusted."""
    estimate: Estimate
    equations: NormalEquations
    """Along the named numbers, at the end of the search."""
    noise: Noise
    """Measured beside what was found."""
    whitening: Whitening
    judging: Whitening
    """By which names, rivals and intervals were judged: where the model leaves more than noise, the
    noise is what it leaves."""
    judged: NormalEquations
    """As `equations`, by `judging`."""
    first: list[CandidateScore]
    """Scores of all candidates before anything was named, best first."""
    explained: float
    """Fall of chi-square that the named effects bring."""

    @property
    def off(self) -> bool:
        """Whether the model leaves more than noise, by which then everything is judged."""
        return self.judging is not self.whitening

    @property
    def sigma(self) -> np.ndarray:
        """(19,) measurement noise of each channel in its unit; NaN where nothing was measured."""
        return self.noise.sigma

    @property
    def candidates(self) -> list[Candidate]:
        """What was named, without the reasons."""
        return [one.candidate for one in self.named]

    @property
    def indices(self) -> list[int]:
        """Places in the vector of the named numbers."""
        return indices_of(self.candidates)


class _Task(NamedTuple):
    """What a search is given."""

    model: RolloutModel
    windows: FlightWindows
    """At full length."""
    among: Sequence[Candidate]
    fold: np.ndarray
    """(W,) windows of one number are left out together."""
    say: Callable[[str], None]
    seed: int
    limits: Thresholds

    def score(
        self, equations: NormalEquations, theta: np.ndarray, named: Sequence[int]
    ) -> list[CandidateScore]:
        """Return the scores of what is not among the numbers `named`, best first."""
        left = [c for c in self.among if not set(c.indices) & set(named)]
        return score_candidates(
            equations, theta, self.model.space, named, left, self.fold, self.seed, self.limits
        )

    def fit(
        self, look: _Look, start: Estimate, indices: list[int], known: Linearisation | None = None
    ) -> tuple[Estimate, NormalEquations]:
        """Fit the numbers at `indices` to what can be trusted."""
        windows, whitening = look.windows, look.whitening
        return fit(self.model, windows, whitening, start, indices, known=known, limits=self.limits)


class _Look(NamedTuple):
    """The slopes along everything at one estimate, and how to weigh them."""

    linear: Linearisation
    windows: FlightWindows
    """As long as these slopes can be trusted."""
    whitening: Whitening
    equations: NormalEquations
    noise: Noise


def search(
    model: RolloutModel,
    windows: FlightWindows,
    among: Sequence[Candidate],
    say: Callable[[str], None],
    known: Linearisation | None = None,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
) -> SearchResult:
    """Return which of `among` explain the gap between `model` and `windows`.

    `say` is told of each step in a line for people; `known` are the slopes along everything at the
    vehicle file's numbers, to save their calculation; `seed` is of the null's draws.
    """
    fold = folds_of(np.asarray(windows.flight), np.asarray(windows.start_s), limits.folds)
    task = _Task(model, windows, among, fold, say, seed, limits)
    estimate = start_estimate(model, windows)
    named: list[NamedEffect] = []
    first: list[CandidateScore] = []
    while True:
        look = _look(task, estimate, None if named else known)
        chosen = [n.candidate for n in named]
        scores = task.score(look.equations, estimate.theta, indices_of(chosen))
        first = first or scores
        best = scores[0] if scores else None
        if best is None or len(named) >= limits.most_names or best.p_value > limits.name_p_value:
            break
        if best.gain <= limits.least_name_share * first[0].gain:
            break
        item, estimate = _best_of_short_list(task, look, estimate, chosen, scores)
        named.append(NamedEffect(item.candidate, item.p_value, item.gain))
    named, estimate = _settle(task, look, named, estimate)
    judge = look
    if _off(task, look, named, estimate):
        say("the model leaves more than noise: names are judged by what it leaves")
        judge = _judge(task, look, named, estimate)
        named, estimate = _settle(task, judge, named, estimate)
    indices = indices_of([n.candidate for n in named])
    rounds = limits.last_rounds if indices else 0
    weighed = look.windows, judge.whitening
    estimate, judged = fit(model, *weighed, estimate, indices, rounds, limits=limits)
    last = judged
    if judge is not look:
        estimate, last = fit(model, look.windows, look.whitening, estimate, indices, 0)
    nothing = last
    if indices:
        _, nothing = task.fit(look, start_estimate(model, look.windows), [])
    explained = float(nothing.chi2.sum() - last.chi2.sum())
    return SearchResult(
        tuple(named), look.windows, estimate, last, look.noise, look.whitening, judge.whitening,
        judged, first, explained,
    )  # fmt: skip


def refitted(
    model: RolloutModel,
    found: SearchResult,
    named: tuple[NamedEffect, ...],
    limits: Thresholds = THRESHOLDS,
) -> SearchResult:
    """Return `found` with those of its names alone that are in `named`, at least one."""
    indices = indices_of([one.candidate for one in named])
    theta = model.space.array("start")
    theta[indices] = found.estimate.theta[indices]
    start, windows = Estimate(theta, found.estimate.offset), found.windows
    best, judged = fit(model, windows, found.judging, start, indices, limits=limits)
    _, last = fit(model, windows, found.whitening, best, indices, 0)
    nothing = found.explained + float(found.equations.chi2.sum())
    return replace(
        found, named=named, estimate=best, equations=last, judged=judged,
        explained=nothing - float(last.chi2.sum()),
    )  # fmt: skip


def trusted(
    windows: FlightWindows, residual: np.ndarray, limits: Thresholds = THRESHOLDS
) -> FlightWindows:
    """Return `windows`, each up to where the model has not left the flight by too much.

    Beyond, slopes taken where the model is say nothing of where the flight was: it may have turned
    over, or sunk below the ground. What is named brings the model back, and the next look is
    longer. `residual` is (W, N, 19).
    """
    error = np.abs(residual)
    height = np.maximum(np.asarray(windows.row_pos_w)[..., 2], 0.0)
    lost = (error[..., SLICES["position"]].max(axis=-1) > limits.trusted_m) | (
        error[..., SLICES["attitude"]].max(axis=-1) > limits.trusted_rad
    )
    lost |= (error[..., 2] > limits.trusted_height_share * height) & (height > 0.0)
    row_s = np.asarray(windows.row_s)
    until_s = np.full(len(row_s), limits.trusted_horizons_s[-1])
    for horizon in reversed(limits.trusted_horizons_s):
        there = ~(lost & (row_s <= horizon)).any(axis=1)
        until_s = np.where(there, horizon, until_s)
    seen = np.asarray(windows.seen) & (row_s <= until_s[:, None] + 1e-9)[..., None]
    return windows._replace(seen=seen)


def _look(
    task: _Task,
    estimate: Estimate,
    known: Linearisation | None = None,
    noise: Noise | None = None,
) -> _Look:
    """Return the slopes of all windows at `estimate`, which `known` saves, as `noise` does its own.

    Noise is measured best where the model fits best.
    """
    model, limits = task.model, task.limits
    linear = known
    if linear is None:
        linear = model.linearise(estimate.theta, estimate.offset, task.windows, None)
    noise = noise or measured_noise(linear.residual, linear.start_slope, task.windows, limits)
    view = trusted(task.windows, linear.residual, limits)
    whitening = make_whitening(linear, noise, view, limits)
    equations = normal_equations_of(whitening, linear, model.size)
    return _Look(linear, view, whitening, equations, noise)


def _off(task: _Task, look: _Look, named: Sequence[NamedEffect], estimate: Estimate) -> bool:
    """Return whether what is `named` leaves more than noise in the windows of `look`."""
    indices = indices_of([n.candidate for n in named])
    _, equations = task.fit(look, estimate, indices)
    expected = look.whitening.slow_freedom.sum()
    return bool(equations.slow_energy.sum() > task.limits.structure_rotor_input * expected)


def _judge(task: _Task, look: _Look, named: Sequence[NamedEffect], estimate: Estimate) -> _Look:
    """Return the slopes at the best fit of what is `named`, weighed by what that leaves."""
    estimate, _ = task.fit(look, estimate, indices_of([n.candidate for n in named]))
    linear = task.model.linearise(estimate.theta, estimate.offset, task.windows, None)
    noise = left_as_noise(linear.residual, linear.start_slope, look.windows, task.limits)
    whitening = make_whitening(linear, noise, look.windows, task.limits)
    equations = normal_equations_of(whitening, linear, task.model.size)
    return _Look(linear, look.windows, whitening, equations, noise)


def _best_of_short_list(
    task: _Task,
    look: _Look,
    estimate: Estimate,
    chosen: list[Candidate],
    scores: list[CandidateScore],
) -> tuple[CandidateScore, Estimate]:
    """Return which of the best `scores` fits best through the whole model beside `chosen`."""
    limits, space, tried = task.limits, task.model.space, []
    indices, chi2 = indices_of(chosen), float(look.equations.chi2.sum())
    fallen = {
        s.candidate: _fallen(
            look.equations, estimate.theta, space, [*indices, *s.candidate.indices]
        )
        for s in scores
        if s.gain >= limits.near_share * scores[0].gain
    }
    near = [s for s in scores if _near(fallen, s.candidate, limits)]
    for item in near[: limits.short_list]:
        at = indices_of([*chosen, item.candidate])
        after, equations = task.fit(look, estimate, at, look.linear)
        tried.append((float(equations.chi2.sum()) + 2 * len(at), item, after))
        task.say(f"{item.candidate.label}: {chi2 - equations.chi2.sum():.0f}")
    _, item, after = min(tried, key=lambda t: t[0])
    return item, after


def _settle(
    task: _Task, look: _Look, named: list[NamedEffect], estimate: Estimate
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
        for place in range(len(named)):
            named, estimate = _judge_rivals(task, named, place, estimate, look.noise)
        needed = [n for n in named if n.p_value <= task.limits.name_p_value]
        if [n.candidate for n in needed] == before:
            break
        # A name that was taken on the way may be needed no more beside better ones.
        theta = estimate.theta.copy()
        for one in named:
            if one not in needed:
                theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        named, estimate = needed, Estimate(theta, estimate.offset)
    return named, estimate


def _judge_rivals(
    task: _Task, named: list[NamedEffect], place: int, estimate: Estimate, noise: Noise
) -> tuple[list[NamedEffect], Estimate]:
    """Weigh the name at `place` when added last; a better rival takes its place."""
    model, limits, one = task.model, task.limits, named[place]
    others = [n.candidate for k, n in enumerate(named) if k != place]
    theta, own = estimate.theta.copy(), list(one.candidate.indices)
    theta[own] = model.space.array("start")[own]
    without = Estimate(theta, estimate.offset)
    look = _look(task, without, noise=noise)
    at = indices_of(others)
    scores = {s.candidate: s for s in task.score(look.equations, theta, at)}
    if one.candidate in scores:
        score = scores[one.candidate]
        one = replace(one, p_value=score.p_value, gain=score.gain)
    left = [c for c in task.among if not set(c.indices) & set(at)]
    fallen = {c: _fallen(look.equations, theta, model.space, [*at, *c.indices]) for c in left}
    tried = []
    for candidate in left:
        if candidate == one.candidate or _near(fallen, candidate, limits):
            chosen = indices_of([*others, candidate])
            after, equations = task.fit(look, without, chosen, look.linear)
            tried.append((float(equations.chi2.sum()) + len(candidate.indices), candidate, after))
            task.say(f"{one.candidate.label} or {candidate.label}: {tried[-1][0]:.1f}")
    least, best, after = min(tried, key=lambda t: t[0])
    if best != one.candidate:
        one = replace(one, candidate=best, p_value=scores[best].p_value)
    total = float(look.equations.chi2.sum())
    explained = total - _fallen(look.equations, theta, model.space, at) - least
    alike = min(limits.rival_chi2, limits.rival_share * explained)
    names = dict.fromkeys(c.name for chi2, c, _ in tried if chi2 - least <= alike)
    rivals = tuple(name for name in names if name != best.name)
    worse_by = {c.label: chi2 - least for chi2, c, _ in tried if c != best}
    one = replace(one, rivals=rivals, worse_by=worse_by)
    return [*named[:place], one, *named[place + 1 :]], after


def _near(fallen: Mapping[Candidate, float], candidate: Candidate, limits: Thresholds) -> bool:
    """Return whether `candidate` could be the best: slopes alone say too little of large effects.

    `fallen` holds the fall of chi-square to first order, by candidate.
    """
    most = max(fallen.values())
    slack = limits.first_order_chi2 + limits.first_order_share * abs(most)
    return fallen.get(candidate, -np.inf) >= most - slack


def _fallen(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, columns: Sequence[int]
) -> float:
    """Return the fall of chi-square to first order where the numbers at `columns` are fitted."""
    columns = sorted(set(columns))
    hessian = equations.hessian[:, columns][:, :, columns].sum(0)
    if not columns or np.trace(hessian) < 1e-12:
        return 0.0
    gradient = equations.gradient[:, columns].sum(0)
    return gauss_newton_step(hessian, gradient, theta, space, columns)[1]
