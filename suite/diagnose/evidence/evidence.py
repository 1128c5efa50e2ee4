"""Base class of evidence: the interface between residuals of flights and the search for effects.

Evidence is the differences between simulation and flights, divided by their noise. Each kind of it
is one subclass: the errors of rollouts (simulated stretches of 1 s), or those of force or torque. A
subclass linearises its residuals along the model's parameters and estimates their noise; the other
methods have defaults. A block is the result of a linearisation (`estimate/block.py`), and a stretch
is a piece of a flight whose residuals may be correlated.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate, NormalEquations
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.estimate.permutation import CandidateScore, folds_of, score_candidates
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

LEAST_ERROR = 1e-9
"""Lower limit of a squared error in a denominator, in units of the noise variance."""


class Evidence(ABC):
    """Whitened residuals (in units of independent noise), and how the parameters change them."""

    limits: Thresholds = THRESHOLDS
    """Thresholds of all steps of the diagnosis."""
    misfit_is_noise: bool = False
    """Whether even the best model is wrong, so that its whole residual counts as noise."""

    @property
    @abstractmethod
    def space(self) -> ParameterSpace:
        """The parameters, with their values in the vehicle file and their bounds."""

    @abstractmethod
    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return the block at the estimate `at`, with slopes along `indices` or all parameters."""

    @abstractmethod
    def estimate_noise(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return this evidence with noise estimated from its residuals at `at`, and its block.

        The block has slopes along all parameters.
        """

    def relinearise(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return this evidence, noise unchanged, and its block at `at` along all parameters."""
        return self, self.linearise(at)

    def misfit_as_noise(self, at: Estimate, block: Block) -> tuple[Evidence, Block] | None:
        """Return this evidence with the best model's whole residual as its noise, and its block.

        None if that residual is measurement noise only. `at` and `block` are those of the best
        model.
        """
        del at, block
        return None

    @property
    def flights_differ_p(self) -> float:
        """Argument `differ_p` of `intervals95`: 1 if each flight is one random draw, else 0."""
        return 1.0

    @property
    def name_p_value(self) -> float:
        """Probability that a step of the search names an effect although there is none."""
        return self.limits.name_p_value

    def scores(
        self,
        block: Block,
        equations: NormalEquations,
        theta: np.ndarray,
        named: Sequence[int],
        among: Sequence[Candidate],
        seed: int,
    ) -> list[CandidateScore]:
        """Return the scores of candidates, each fitted with the `named` parameters, best first.

        `block` was computed at `theta` (P,), with slopes along all parameters.
        """
        fold = self.folds(block)
        return score_candidates(equations, theta, self.space, named, among, fold, seed, self.limits)

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold (B,) of each stretch; cross-validation leaves out one fold at a time."""
        return folds_of(block.flight, block.start_s, self.limits.folds)

    def groups(self, block: Block) -> np.ndarray:
        """Return the group (B,) of each stretch: its flight, or its third of a single flight.

        `explained_share` tests whether the groups agree.
        """
        return validation_groups(block.flight)

    def explained_share(
        self, before: Block, at: Estimate, after: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return the share of the squared error that a candidate explains; None if rejected.

        The blocks are those without (`before`) and with the candidate (`after`, at the estimate
        `at`). `gains` (G,) are the falls of the squared error of each group, fitted to the other
        groups.
        """
        del at, candidate, gains
        return 1.0 - float((after.residual**2).sum() / max((before.residual**2).sum(), LEAST_ERROR))

    def preference(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return the sort key of candidates that fit about equally well; the smallest wins."""
        del at, candidate
        return ()


def validation_groups(flight: np.ndarray) -> np.ndarray:
    """Return the cross-validation group (M,) of each row: its flight, or its third of a single one.

    `flight` (M,) is the number of each row's flight.
    """
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)


def flights_agree(gains: np.ndarray) -> bool:
    """Return whether all flights, or all but one, have positive `gains` (G,).

    The sum without the largest gain must be positive, too. Fewer than three flights always agree.
    """
    if len(gains) < 3:
        return True
    return bool((gains > 0.0).sum() >= len(gains) - 1 and gains.sum() > gains.max())
