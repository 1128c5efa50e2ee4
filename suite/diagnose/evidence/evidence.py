"""Base class of evidence, the interface between a source of residuals and the search.

Each source, such as rollouts or forces, is one subclass. It linearises its residuals in blocks and
estimates their noise; the other methods have defaults. A number is a parameter of the model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate, NormalEquations
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.estimate.permutation import CandidateScore, folds_of, score_candidates
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

NOTHING = 1e-9
"""Smallest squared error that a share is computed of, in units of the noise variance."""


class Evidence(ABC):
    """A source of whitened residuals, with information on the numbers of a space."""

    limits: Thresholds = THRESHOLDS
    """Thresholds of all steps of the diagnosis."""
    off: bool = False
    """Whether the model is wrong, so that its whole residual counts as noise."""

    @property
    @abstractmethod
    def space(self) -> ParameterSpace:
        """The numbers, with their starts and bounds."""

    @abstractmethod
    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return residuals and slopes at an estimate, along the numbers `indices` or along all."""

    @abstractmethod
    def weighed(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return this with its noise estimated from the residuals at `at`, and its block there.

        The block has slopes along all numbers.
        """

    def again(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return this with its noise unchanged, and its block at `at`."""
        return self, self.linearise(at)

    def misfit(self, at: Estimate, block: Block) -> tuple[Evidence, Block] | None:
        """Return this with the whole residual of the best model as its noise, and its block.

        None if that residual is measurement noise only. `at` and `block` are of the best model.
        """
        del at, block
        return None

    @property
    def draws(self) -> float:
        """`differ_p` of `intervals95`: 1 if each flight is one random draw, 0 if not."""
        return 1.0

    @property
    def name_p_value(self) -> float:
        """Probability that a step of the search names an effect falsely."""
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
        """Return the scores of `among` when fitted with the numbers `named`, best first.

        `equations` are those of `block`, at the numbers `theta` (P,); `seed` is of random draws.
        """
        fold = self.folds(block)
        return score_candidates(equations, theta, self.space, named, among, fold, seed, self.limits)

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold (B,) of each stretch; cross-validation leaves out one fold at a time."""
        return folds_of(block.flight, block.start_s, self.limits.folds)

    def parts(self, block: Block) -> np.ndarray:
        """Return the group (B,) of each stretch, by default its flight; `share` compares them."""
        return block.flight

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return the share of the squared error that a candidate explains; None if refused.

        Args:
            now: block without the candidate.
            at: estimate with the candidate.
            then: block with the candidate.
            candidate: the fitted one.
            gains: (G,) fall of the squared error of each group, fitted on the other groups.
        """
        del at, candidate, gains
        return 1.0 - float((then.residual**2).sum() / max((now.residual**2).sum(), NOTHING))

    def order(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return the sort key of candidates that fit about equally well; the smallest wins."""
        del at, candidate
        return ()


def flights_agree(gains: np.ndarray) -> bool:
    """Return whether all flights, or all but one, have positive `gains` (G,).

    Their sum without the largest must be positive, too. Fewer than three flights always agree.
    """
    if len(gains) < 3:
        return True
    return bool((gains > 0.0).sum() >= len(gains) - 1 and gains.sum() > gains.max())
