"""Base class of evidence: the interface between residuals of flights and the search for effects.

Evidence is the differences between simulation and flights, divided by their noise. Each kind of it
is one subclass: the errors of rollouts (simulated stretches of 1 s), those of force or torque, or
those that `suite identify` fits. A subclass linearises its residuals (see `estimate/block.py`) and
estimates their noise; the other methods have defaults.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.gauss_newton import Intervals, gauss_newton_step, intervals95
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.estimate.permutation import CandidateScore, permutation_test
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

LEAST_STEP = 0.1
"""Steps of a fit are halved down to this share."""


@dataclass(frozen=True, kw_only=True)
class Evidence(ABC):
    """Whitened residuals (in units of independent noise), and how the parameters change them."""

    limits: Thresholds = THRESHOLDS
    """Thresholds of all steps of the diagnosis."""
    misfit_is_noise: bool = True
    """Whether the whole residual of the best model counts as noise. A model's error is the same all
    along a flight, so each flight is then one random draw."""

    @property
    @abstractmethod
    def space(self) -> ParameterSpace:
        """The parameters, with their values in the vehicle file and their bounds."""

    @abstractmethod
    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return the block at the estimate `at`, with slopes along `indices` or all parameters."""

    @abstractmethod
    def estimate_noise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence at `at` along all parameters, with noise estimated there."""

    def relinearise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence at `at` along all parameters, with its noise unchanged."""
        return Evaluation(self, at, self.linearise(at))

    def misfit_as_noise(self, best: Evaluation) -> Evidence | None:
        """Return this evidence with the residual of the `best` model as its noise.

        None if that residual is measurement noise only.
        """
        return None

    def fitted(
        self,
        start: Estimate,
        indices: Sequence[int],
        rounds: int | None = None,
        known: Block | None = None,
    ) -> Evaluation:
        """Fit the parameters at `indices` and the nuisance parameters; return the best evaluation.

        At most `rounds` Gauss-Newton steps (default: those of the limits) are taken from `start`.
        `known` is the block at `start`, if it was computed before.
        """
        limits, space, places = self.limits, self.space, np.array(indices, dtype=int)
        low, high = space.array("low")[places], space.array("high")[places]
        best, block = start, known or self.linearise(start, indices)
        for steps_done in range(limits.fit_rounds if rounds is None else rounds):
            equations = block.equations.along_numbers(indices)
            change, expected_fall = gauss_newton_step(equations, best.theta, space)
            # The nuisance parameters are corrected at least once.
            if expected_fall < limits.converged and (steps_done or not block.free.shape[1]):
                break
            columns = [block.along.index(index) for index in indices]
            free_change = block.free - block.free_slope[..., columns] @ change
            # Halve the step until chi-square falls; give up below the smallest step.
            share, chi2_before = 1.0, float(equations.chi2.sum())
            while share > LEAST_STEP:
                theta = best.theta.copy()
                theta[places] = np.clip(theta[places] + share * change, low, high)
                free = best.free + share * free_change if free_change.size else best.free
                trial = Estimate(theta, free)
                trial_block = self.linearise(trial, indices)
                chi2 = float((trial_block.residual**2).sum())
                if np.isfinite(chi2) and chi2 <= chi2_before + 1e-6:
                    break
                share /= 2.0
            else:
                break
            best, block = trial, trial_block
        return Evaluation(self, best, block)

    def scores(
        self, current: Evaluation, named: Sequence[int], among: Sequence[Candidate], seed: int
    ) -> list[CandidateScore]:
        """Return the scores of candidates, each fitted with the `named` parameters, best first.

        `current` is along all parameters. A candidate without any effect on the flights has none.
        """
        equations = current.block.equations
        along = list(equations.along)
        scale, theta = self.space.array("step")[along], current.at.theta
        low, high = ((self.space.array(end) - theta)[along] / scale for end in ("low", "high"))
        hessian, gradient = equations.hessian * np.outer(scale, scale), equations.gradient * scale
        information, columns = np.einsum("wjj->j", hessian), equations.columns_of
        acting = [c for c in among if information[list(columns(c))].sum() > 1e-9]
        groups = [tuple(sorted({*named, *columns(c)})) for c in acting]
        fold = self.folds(current.block)
        room = (low, high)
        return permutation_test(
            acting, hessian, gradient, groups, tuple(named), fold, seed, room, self.limits
        )

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold (B,) of each stretch; cross-validation leaves out one fold at a time.

        They are 0, 1, 2 and so on along every flight. A fold is no flight, as a single one may
        identify a parameter, as a chirp (a command of rising frequency) does a rate loop's gain.
        """
        order = np.lexsort((block.start_s, block.flight))
        fold = np.empty(len(order), int)
        fold[order] = np.arange(len(order)) % self.limits.folds
        return fold

    def accepts(
        self, before: Block, after: Evaluation, candidate: Candidate, gains: np.ndarray
    ) -> bool:
        """Return whether a fitted candidate may be named, as far as this evidence shows.

        `before` is the block without the candidate. `gains` (G,) are the falls of the squared error
        of each group of stretches (see `validation_groups`), fitted to the other groups.
        """
        return True

    def preference(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return the sort key of candidates that fit about equally well; the smallest wins."""
        return ()


class Evaluation(NamedTuple):
    """Evidence and one estimate of the parameters, with the block at that estimate."""

    evidence: Evidence
    at: Estimate
    block: Block

    def intervals(self, indices: Sequence[int]) -> Intervals:
        """Return the uncertainty of the K parameters at `indices`."""
        equations = self.block.equations.along_numbers(indices)
        return intervals95(equations, float(self.evidence.misfit_is_noise))


def validation_groups(flight: np.ndarray) -> np.ndarray:
    """Return the cross-validation group (M,) of each row: its flight, or third of a single one."""
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)


def flights_agree(gains: np.ndarray) -> bool:
    """Return whether all flights, or all but one, have positive `gains` (G,).

    So must have their sum without the largest gain. Fewer than three flights always agree.
    """
    if len(gains) < 3:
        return True
    return bool((gains > 0.0).sum() >= len(gains) - 1 and gains.sum() > gains.max())
