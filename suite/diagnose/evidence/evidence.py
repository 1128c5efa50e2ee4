"""What a source of information is, for the search: one class a source.

It makes blocks, and knows its noise. All else has a default.
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
"""Squared error in units of the noise below which there is nothing to explain."""


class Evidence(ABC):
    """A source of information on the numbers of a space."""

    limits: Thresholds = THRESHOLDS
    """Of every step."""
    off: bool = False
    """Whether all that the model leaves is taken for noise."""

    @property
    @abstractmethod
    def space(self) -> ParameterSpace:
        """The numbers."""

    @abstractmethod
    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return what it gives at an estimate, along the numbers at `indices` or along all."""

    @abstractmethod
    def weighed(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return this with the noise that the model leaves at an estimate, and its block there.

        The block is along all numbers.
        """

    def again(self, at: Estimate) -> tuple[Evidence, Block]:
        """Return the same with the noise that it has."""
        return self, self.linearise(at)

    def misfit(self, at: Estimate, block: Block) -> tuple[Evidence, Block] | None:
        """Return the same with what the best model leaves as its noise; None where that is noise.

        `block` is that of the best model.
        """
        del at, block
        return None

    def compared(self) -> Evidence:
        """Return the evidence by which fits of several candidates are compared."""
        return self

    @property
    def draws(self) -> float:
        """Chance below which flights are the draws of an interval, as `intervals95` takes it."""
        return 1.0

    @property
    def name_p_value(self) -> float:
        """Chance of a false name at each step of the search."""
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
        """Return the scores of `among` next to the numbers `named` at `theta` (P,), best first."""
        fold = self.folds(block)
        return score_candidates(equations, theta, self.space, named, among, fold, seed, self.limits)

    def folds(self, block: Block) -> np.ndarray:
        """Return what is left out together (B,)."""
        return folds_of(block.flight, block.start_s, self.limits.folds)

    def parts(self, block: Block) -> np.ndarray:
        """Return the number (B,) of what may agree or not, as of each stretch's flight."""
        return block.flight

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return the share of the squared error that a fitted candidate takes; None if refused.

        Args:
            now: without it.
            at: with it.
            then: with it.
            candidate: what was fitted.
            gains: (G,) fall of the squared error of each part by the others' fit.
        """
        del at, candidate, gains
        return 1.0 - float((then.residual**2).sum() / max((now.residual**2).sum(), NOTHING))

    def order(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return by what those that fit alike are ordered, before how well they fit."""
        del at, candidate
        return ()


def flights_agree(gains: np.ndarray) -> bool:
    """Return whether all flights but one gain (G,), and together without the one that gains most.

    Two flights or one do not show it.
    """
    if len(gains) < 3:
        return True
    return bool((gains > 0.0).sum() >= len(gains) - 1 and gains.sum() > gains.max())
