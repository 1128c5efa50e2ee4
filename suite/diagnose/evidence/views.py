"""Force and torque as evidence on the model's parameters.

A view is one part of the dynamics, force or torque. Measured mean accelerations are compared with
those of the model. The noise of the residuals is estimated from the residuals themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.view import SmoothedFlight, View
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.composites import carried
from suite.diagnose.estimate.parameters import (
    Candidate,
    ParameterSpace,
    at_bound,
    usual_first,
)
from suite.diagnose.estimate.permutation import folds_of
from suite.diagnose.evidence.evidence import Evidence, flights_agree
from suite.diagnose.evidence.moments import (
    ForceModel,
    ViewData,
    Weights,
    block_of,
    compare,
    error_share_removed,
    fast_share,
    means_of,
    stretch_numbers,
    validation_groups,
    weights_of,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class ViewBlock(Block):
    """A block (linearised residuals), with the mean accelerations from which it is computed."""

    data: ViewData


@dataclass(frozen=True)
class ViewEvidence(Evidence):
    """Flights in one view as evidence; `estimate_noise` adds the noise."""

    view: View
    model: ForceModel
    flights: Sequence[SmoothedFlight]
    limits: Thresholds = THRESHOLDS
    carried: np.ndarray | None = None
    """(M, 3) residual that follows from reference flights (is carried over from them); it is
    subtracted."""
    means: bool = False
    """Whether only the mean of each flight is compared."""
    weights: Weights | None = None
    """Noise of the residuals; None before it is estimated."""

    @property
    def space(self) -> ParameterSpace:
        """The parameters of all effects in the catalogue."""
        return self.model.space

    @property
    def repeatability(self) -> np.ndarray:
        """(3,) standard deviation of the flights' means; infinite with too few flights."""
        return np.full(3, np.inf) if self.weights is None else self.weights.trim

    @property
    def start(self) -> Estimate:
        """The vehicle file's parameters."""
        return Estimate(self.space.array("start"))

    def residuals(self, theta: np.ndarray, indices: Sequence[int] | None = ()) -> ViewData:
        """Return the residuals at the parameters `theta` (P,), with slopes along `indices`.

        With None as indices the slopes are along all parameters.
        """
        data = compare(self.view, self.model, theta, self.flights, indices)
        if self.carried is not None:
            data = data._replace(residual=data.residual - self.carried)
        if not self.means:
            return data
        flight, *others = (means_of(field, data.flight) for field in data)
        return ViewData(flight.astype(int), *others)

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> ViewBlock:
        """Return the block at `at`, with slopes along `indices`; see `Evidence`."""
        return self._block(self.residuals(at.theta, indices), indices)

    def estimate_noise(self, at: Estimate) -> tuple[ViewEvidence, ViewBlock]:
        """Return this evidence with its noise estimated at `at`; see `Evidence`."""
        data = self.residuals(at.theta, None)
        evidence = replace(self, weights=weights_of(data, self.limits))
        return evidence, evidence._block(data)

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold of each stretch: its flight, or parts of all flights if they are few."""
        if len(np.unique(block.flight)) >= 3:
            return block.flight
        return folds_of(block.flight, np.arange(len(block.flight), dtype=float))

    def groups(self, block: Block) -> np.ndarray:
        """Return the group of each stretch: its flight, or its third of a single flight."""
        return validation_groups(block.flight)

    def explained_share(
        self, before: Block, at: Estimate, after: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return the share of the error that a candidate explains; see `Evidence`.

        None if a value is at a physical bound, if flights disagree, if fast changes contradict the
        candidate, or if the share is too small.
        """
        assert isinstance(before, ViewBlock) and isinstance(after, ViewBlock)
        if at_bound(self.space, at.theta, candidate) or not flights_agree(gains):
            return None
        share = error_share_removed(before.data, after.data, self.limits)
        change = at.theta - self.space.array("start")
        consistent = fast_changes_agree(after, candidate.indices, change, self.limits)
        return share if share >= self.limits.least_view_share and consistent else None

    def preference(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return a sort key: plausible values first, then single effects, then the catalogue."""
        return usual_first(self.space, at.theta, candidate)

    def _block(self, data: ViewData, indices: Sequence[int] | None = None) -> ViewBlock:
        """Return the block of `data`, whose slopes are along `indices` or all parameters."""
        assert self.weights is not None
        rows = np.arange(len(data.flight))
        stretch = rows if self.means else stretch_numbers(data, self.limits)
        along = range(len(self.space.entries)) if indices is None else indices
        return ViewBlock(**vars(block_of(data, self.weights, stretch, along)), data=data)


def fast_changes_agree(
    block: ViewBlock, indices: Sequence[int], change: np.ndarray, limits: Thresholds
) -> bool:
    """Return whether fast changes are consistent with fitted parameters (see `fast_share`).

    They are not consistent if they give less than a certain share of the fitted change, and
    significantly less than all of it. Means of flights have no fast changes: always consistent.

    Args:
        block: block at the fit.
        indices: places of the fitted parameters.
        change: (P,) all fitted parameters minus those of the vehicle file.
        limits: smallest share.
    """
    if len(np.unique(block.data.flight)) == len(block.data.flight):
        return True
    columns = [block.along.index(index) for index in indices]
    share, half_width = fast_share(block.data, columns, change[list(indices)], limits)
    return share >= limits.least_fast_share or share + half_width >= 1.0


def view_candidates(among: Sequence[Candidate], block: Block) -> list[Candidate]:
    """Return the candidates that change a view's accelerations, without faults of sensors.

    Of a composite (several effects as one hypothesis), each effect has to change them, alone or
    through another effect.
    """
    acts, acting_through_others = block.acts(), carried(among)

    def changes_view(candidate: Candidate) -> bool:
        effect = EFFECTS[candidate.name]
        return (
            (bool(acts[list(candidate.indices)].any()) or candidate in acting_through_others)
            and effect.measure is None
            and effect.late is None
            and "command" not in effect.needs
        )

    return [one for one in among if all(changes_view(part) for part in one.singles)]
