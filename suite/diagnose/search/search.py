"""The search: one effect after another, each against the null, then every name against its rivals.

What is named must lower the error on windows left out by more than the best of all candidates does
on data with shuffled signs. A rival that explains the same windows as well is an alternative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.whitening import Linearisation, Whitening
from suite.diagnose.data.windows import FlightWindows
from suite.diagnose.estimate.gauss_newton import NormalEquations
from suite.diagnose.estimate.parameters import Candidate, indices_of
from suite.diagnose.estimate.permutation import CandidateScore, folds_of
from suite.diagnose.evidence.rollout_fit import Estimate, fit, start_estimate
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.search.look import Look, SearchTask, is_off, look_at, look_at_misfit
from suite.diagnose.search.rivals import NamedEffect, chi2_fall, could_be_best, settle, without_idle
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


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
    task = SearchTask(model, windows, among, fold, say, seed, limits)
    estimate = start_estimate(model, windows)
    named: list[NamedEffect] = []
    first: list[CandidateScore] = []
    while True:
        look = look_at(task, estimate, None if named else known)
        chosen = [n.candidate for n in named]
        scores = task.score(look.equations, estimate.theta, indices_of(chosen))
        first = first or scores
        best = scores[0] if scores else None
        if best is None or len(named) >= limits.most_names or best.p_value > limits.name_p_value:
            break
        if best.gain <= limits.least_name_share * first[0].gain:
            break
        item, estimate = _best_of_short_list(task, look, estimate, chosen, scores)
        singles = item.candidate.singles
        named += [NamedEffect(single, item.p_value, item.gain) for single in singles]
    named, estimate = settle(task, look, named, estimate)
    estimate, last = _last_fit(task, look, named, estimate)
    judge, judged = look, last
    if is_off(look, last, limits):
        say("the model leaves more than noise: names are judged by what it leaves")
        judge = look_at_misfit(task, look, estimate)
        named, estimate = settle(task, judge, named, estimate)
        estimate, judged = _last_fit(task, judge, named, estimate)
        indices = indices_of([n.candidate for n in named])
        estimate, last = fit(model, look.windows, look.whitening, estimate, indices, 0)
    nothing = last
    if named:
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


def _last_fit(
    task: SearchTask, look: Look, named: Sequence[NamedEffect], estimate: Estimate
) -> tuple[Estimate, NormalEquations]:
    """Fit all names to the end; where there is none nothing is moved."""
    indices = indices_of([n.candidate for n in named])
    rounds = task.limits.last_rounds if indices else 0
    weighed = look.windows, look.whitening
    return fit(task.model, *weighed, estimate, indices, rounds, limits=task.limits)


def _best_of_short_list(
    task: SearchTask,
    look: Look,
    estimate: Estimate,
    chosen: list[Candidate],
    scores: list[CandidateScore],
) -> tuple[CandidateScore, Estimate]:
    """Return which of the best `scores` fits best through the whole model beside `chosen`."""
    limits, space, tried = task.limits, task.model.space, []
    indices, chi2 = indices_of(chosen), float(look.equations.chi2.sum())
    columns = look.equations.columns_of
    fallen = {
        s.candidate: chi2_fall(
            look.equations, estimate.theta, space, [*indices, *columns(s.candidate)]
        )
        for s in scores
        if s.gain >= limits.near_share * scores[0].gain
    }
    near = [s for s in scores if could_be_best(fallen, s.candidate, limits)]
    single = [s for s in near if not s.candidate.parts][: limits.short_list]
    for item in [s for s in near if s.candidate.parts or s in single]:
        after, equations = task.fit_beside(look, estimate, indices, item.candidate)
        cost = float(equations.chi2.sum()) + 2 * len(item.candidate.indices)
        tried.append((cost, item.candidate, (item, after)))
        task.say(f"{item.candidate.label}: {chi2 - equations.chi2.sum():.0f}")
    _, _, (item, after) = min(without_idle(tried, limits), key=lambda t: t[0])
    return item, after
