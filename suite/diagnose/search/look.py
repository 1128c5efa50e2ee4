"""What the search sees at one estimate: slopes along all numbers, and how to weigh them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.colour import Noise, left_as_noise, measured_noise
from suite.diagnose.data.whitening import Linearisation, Whitening, make_whitening
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.estimate.gauss_newton import NormalEquations, along_numbers, gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.estimate.permutation import CandidateScore, score_candidates
from suite.diagnose.evidence.rollout_fit import Estimate, fit, normal_equations_of
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.search.composites import begin_of, lent_at
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class SearchTask(NamedTuple):
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
        self,
        look: Look,
        start: Estimate,
        indices: list[int],
        known: Linearisation | None = None,
        rounds: int = 3,
    ) -> tuple[Estimate, NormalEquations]:
        """Fit the numbers at `indices` to what can be trusted, in at most `rounds` steps."""
        weighed = look.windows, look.whitening
        return fit(self.model, *weighed, start, indices, rounds, known, self.limits)

    def fit_beside(
        self, look: Look, start: Estimate, beside: Sequence[int], candidate: Candidate
    ) -> tuple[Estimate, NormalEquations]:
        """Fit `candidate` and the numbers at `beside`; `look` was taken at `start`."""
        at, space = sorted({*beside, *candidate.indices}), self.model.space
        lent = [number for number in look.equations.lent if number in candidate.indices]
        if not candidate.parts or not lent:
            return self.fit(look, start, at, look.linear)
        columns = sorted({*beside, *look.equations.columns_of(candidate)})
        change, told = along_numbers(look.equations, start.theta, space, columns)
        begin = begin_of(space, start.theta, candidate, lent, change, told)
        return self.fit(look, Estimate(begin, start.offset), at, rounds=self.limits.bilinear_rounds)


class Look(NamedTuple):
    """The slopes along everything at one estimate, and how to weigh them."""

    linear: Linearisation
    windows: FlightWindows
    """As long as these slopes can be trusted."""
    whitening: Whitening
    equations: NormalEquations
    noise: Noise
    off: bool = False
    """Whether all that the model leaves is taken for noise."""


def look_at(
    task: SearchTask,
    estimate: Estimate,
    known: Linearisation | None = None,
    noise: Noise | None = None,
) -> Look:
    """Return the slopes of all windows at `estimate`, which `known` saves, as `noise` does its own.

    Noise is measured best where the model fits best.
    """
    model, limits = task.model, task.limits
    linear = known
    if linear is None:
        linear = model.linearise(estimate.theta, estimate.offset, task.windows, None)
    view = trusted(task.windows, linear.residual, limits)
    noise = noise or measured_noise(linear.residual, linear.start_slope, view, limits)
    whitening = make_whitening(linear, noise, view, limits)
    equations = _equations(task, estimate, linear, whitening)
    return Look(linear, view, whitening, equations, noise)


def _equations(
    task: SearchTask, estimate: Estimate, linear: Linearisation, whitening: Whitening
) -> NormalEquations:
    """Return the normal equations along all numbers, and along those that are lent."""
    model, size = task.model, task.model.size
    acts = np.abs(linear.slope[..., :size]).max(axis=(0, 1, 2)) > 0.0
    lent = lent_at(model.space, estimate.theta, task.among, acts)
    if lent is None:
        return normal_equations_of(whitening, linear, size)
    numbers = list(lent.numbers)
    there = model.linearise(lent.theta, estimate.offset, task.windows, numbers).slope
    slope = np.concatenate([linear.slope[..., :size], there], axis=-1)
    equations = normal_equations_of(whitening, linear._replace(slope=slope), size + len(numbers))
    return equations._replace(lent=lent.numbers)


def least_left(
    model: RolloutModel, windows: FlightWindows, linear: Linearisation, limits: Thresholds
) -> float:
    """Return the squared error a value, 1 of noise, that all numbers of the catalogue leave.

    To first order about `linear`, the slopes of `windows` along all numbers.
    """
    view = trusted(windows, linear.residual, limits)
    noise = measured_noise(linear.residual, linear.start_slope, view, limits)
    equations = normal_equations_of(make_whitening(linear, noise, view, limits), linear, model.size)
    hessian, gradient = equations.hessian.sum(axis=0), equations.gradient.sum(axis=0)
    at = np.flatnonzero(np.diag(hessian) > 1e-9)
    start, square = model.space.array("start"), hessian[np.ix_(at, at)]
    _, fall = gauss_newton_step(square, gradient[at], start, model.space, at.tolist())
    return (float(equations.chi2.sum()) - fall) / max(int(np.asarray(view.seen).sum()), 1)


def is_off(look: Look, equations: NormalEquations, limits: Thresholds) -> bool:
    """Return whether a fit, with these `equations`, leaves more than noise in `look`'s windows."""
    expected = look.whitening.slow_freedom.sum()
    return bool(equations.slow_energy.sum() > limits.structure_rotor_input * expected)


def look_at_misfit(task: SearchTask, look: Look, estimate: Estimate) -> Look:
    """Return the slopes at `estimate`, the best fit, weighed by what that leaves."""
    linear = task.model.linearise(estimate.theta, estimate.offset, task.windows, None)
    noise = left_as_noise(linear.residual, linear.start_slope, look.windows, task.limits)
    whitening = make_whitening(linear, noise, look.windows, task.limits)
    equations = _equations(task, estimate, linear, whitening)
    return Look(linear, look.windows, whitening, equations, noise, off=True)


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
