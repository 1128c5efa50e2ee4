"""Force and torque as evidence: flights of one view, weighted by the residual's own noise."""

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
    fast_share,
    means_of,
    share_taken,
    stretch_of,
    units_of,
    weights_of,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class ViewBlock(Block):
    """A block, with the moments that it is made of."""

    data: ViewData


@dataclass(frozen=True)
class ViewEvidence(Evidence):
    """The flights of one view; its noise is estimated by `weighed`."""

    view: View
    model: ForceModel
    flights: Sequence[SmoothedFlight]
    limits: Thresholds = THRESHOLDS
    carried: np.ndarray | None = None
    """(M, 3) known residual of reference flights, subtracted from the residual."""
    means: bool = False
    """Whether only the mean of each flight is compared."""
    weights: Weights | None = None
    """Noise of the rows; None before it is estimated."""

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's numbers."""
        return self.model.space

    @property
    def repeatability(self) -> np.ndarray:
        """(3,) how flights' means differ among themselves; infinite where too few show it."""
        return np.full(3, np.inf) if self.weights is None else self.weights.trim

    @property
    def start(self) -> Estimate:
        """The vehicle file's numbers."""
        return self.at(self.space.array("start"))

    def at(self, theta: np.ndarray) -> Estimate:
        """Return the estimate with the numbers `theta` (P,): nothing else is free."""
        return Estimate(theta, np.zeros((0, 0)))

    def left(self, theta: np.ndarray, indices: Sequence[int] | None = ()) -> ViewData:
        """Return the residuals at the numbers `theta` (P,), slopes along `indices`."""
        data = compare(self.view, self.model, theta, self.flights, indices)
        if self.carried is not None:
            data = data._replace(residual=data.residual - self.carried)
        if not self.means:
            return data
        flight, *others = (means_of(field, data.flight) for field in data)
        return ViewData(flight.astype(int), *others)

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> ViewBlock:
        """Return the block along these numbers, see `Evidence`."""
        return self._block(self.left(at.theta, indices), indices)

    def weighed(self, at: Estimate) -> tuple[ViewEvidence, ViewBlock]:
        """Return this with its noise as it is there, see `Evidence`."""
        data = self.left(at.theta, None)
        found = replace(self, weights=weights_of(data, self.limits))
        return found, found._block(data)

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold of each stretch: its flight, with three flights or more."""
        if len(np.unique(block.flight)) >= 3:
            return block.flight
        return folds_of(block.flight, np.arange(len(block.flight), dtype=float))

    def parts(self, block: Block) -> np.ndarray:
        """Return flights, or thirds of a lone one."""
        return units_of(block.flight)

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return what a candidate takes, see `Evidence`."""
        assert isinstance(now, ViewBlock) and isinstance(then, ViewBlock)
        if at_bound(self.space, at.theta, candidate) or not flights_agree(gains):
            return None
        share = share_taken(now.data, then.data, self.limits)
        away = at.theta - self.space.array("start")
        known = holds_at_any_speed(then, candidate.indices, away, self.limits)
        return share if share >= self.limits.least_view_share and known else None

    def order(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return what is usual first."""
        return usual_first(self.space, at.theta, candidate)

    def _block(self, data: ViewData, indices: Sequence[int] | None = None) -> ViewBlock:
        assert self.weights is not None
        each = np.arange(len(data.flight))
        stretch = each if self.means else stretch_of(data, self.limits)
        along = range(len(self.space.entries)) if indices is None else indices
        return ViewBlock(**vars(block_of(data, self.weights, stretch, along)), data=data)


def holds_at_any_speed(
    then: ViewBlock, indices: Sequence[int], away: np.ndarray, limits: Thresholds
) -> bool:
    """Return whether fast changes are consistent with the numbers at `indices`, fitted in `then`.

    They are not where they give less than a share of these values, and significantly less than all.
    Means of flights have no changes. `away` (P,) is the change of all numbers since the vehicle
    file.
    """
    if len(np.unique(then.data.flight)) == len(then.data.flight):
        return True
    columns = [then.along.index(number) for number in indices]
    share, half_width = fast_share(then.data, columns, away[list(indices)], limits)
    return share >= limits.least_fast_share or share + half_width >= 1.0


def view_candidates(among: Sequence[Candidate], block: Block) -> list[Candidate]:
    """Return the candidates to which a view is sensitive, without faults of sensors.

    Of a composite each effect has to act on it, if only through another.
    """
    seen, through = block.acts(), carried(among)

    def moves(one: Candidate) -> bool:
        effect = EFFECTS[one.name]
        return (
            (bool(seen[list(one.indices)].any()) or one in through)
            and effect.measure is None
            and effect.late is None
            and "command" not in effect.needs
        )

    return [one for one in among if all(moves(part) for part in one.singles)]
