"""Force and torque as evidence: measured mean accelerations compared with those of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.view import SmoothedFlight, View
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.composites import carried
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace, at_bound, usual_first
from suite.diagnose.evidence.evidence import Evaluation, Evidence, flights_agree
from suite.diagnose.evidence.view_means import (
    ForceModel,
    ViewData,
    Weights,
    block_of,
    fast_changes_agree,
    means_of,
    weights_of,
    whitened,
)


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
    carried: np.ndarray | None = None
    """(M, 3) residual that is carried over from reference flights, and subtracted."""
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
        """Return the residuals at `theta` (P,), with slopes along `indices`, or all with None."""
        parts = [self._residuals(n, theta, indices) for n in range(len(self.flights))]
        # Flights may have different numbers of unknowns of the pose: pad with zeros.
        widest = max(part.pose_slope.shape[2] for part in parts)
        for k, part in enumerate(parts):
            padding = ((0, 0), (0, 0), (0, widest - part.pose_slope.shape[2]))
            parts[k] = part._replace(pose_slope=np.pad(part.pose_slope, padding))
        data = ViewData(*(np.concatenate(field) for field in zip(*parts, strict=True)))
        if self.carried is not None:
            data = data._replace(residual=data.residual - self.carried)
        if not self.means:
            return data
        flight, *others = (means_of(field, data.flight) for field in data)
        return ViewData(flight.astype(int), *others)

    def _residuals(self, number: int, theta: np.ndarray, indices: Sequence[int] | None) -> ViewData:
        """Return the residuals of one flight at `theta` (P,), with slopes along `indices`."""
        view, flight = self.view, self.flights[number]
        value, slope = self.model.at(theta, flight.rows, indices)
        mean, count = flight.form.mean, len(flight.form.middle_s)

        def means(series: np.ndarray) -> np.ndarray:
            """Return the means (M, ...) of `series` (N, ...) by the bumps of the flight."""
            return (mean @ series.reshape(len(series), -1)).reshape(count, *series.shape[1:])

        # The model has six accelerations: three linear ones, then three angular ones.
        columns = slice(0, 3) if view.in_world else slice(3, 6)
        value, slope = (
            _attenuated(means(part[:, columns]), flight.reliability) for part in (value, slope)
        )
        residual, pose_slope = flight.measured - value, np.zeros((count, 3, 0))
        if view.in_world:
            to_body = np.swapaxes(flight.rows.motion.rot_w[flight.form.middle_row], 1, 2)
            residual, value = ((to_body @ part[..., None])[..., 0] for part in (residual, value))
            slope = to_body @ slope
            if flight.rows.pose_slope_b is not None:
                pose_slope = means(flight.rows.pose_slope_b)
        excluded = [axis for axis in range(3) if axis not in view.axes]
        residual[:, excluded], slope[:, excluded] = 0.0, 0.0
        fields = (flight.form.middle_s, value, residual, slope, pose_slope)
        return ViewData(np.full(count, number), *fields)

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> ViewBlock:
        """Return the block at `at`, with slopes along `indices`; see `Evidence`."""
        return self._block(self.residuals(at.theta, indices), indices)

    def estimate_noise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence with its noise estimated at `at`; see `Evidence`."""
        data = self.residuals(at.theta, None)
        evidence = replace(self, weights=weights_of(data, self.limits))
        return Evaluation(evidence, at, evidence._block(data))

    def folds(self, block: Block) -> np.ndarray:
        """Return the fold of each stretch: its flight, or parts of all flights if they are few."""
        if len(np.unique(block.flight)) >= 3:
            return block.flight
        return super().folds(block)

    def accepts(
        self, before: Block, after: Evaluation, candidate: Candidate, gains: np.ndarray
    ) -> bool:
        """Return whether a candidate may be named; see `Evidence`.

        Not at a physical bound, if flights or fast changes disagree, or if it explains little.
        """
        theta, fitted = after.at.theta, after.block
        assert isinstance(before, ViewBlock) and isinstance(fitted, ViewBlock)
        if at_bound(self.space, theta, candidate) or not flights_agree(gains):
            return False
        # Both errors are weighted by the noise estimated with the candidate: in an estimate without
        # it, a slow effect would count as noise.
        noise = weights_of(fitted.data, self.limits)
        chi2_after, chi2_before = (
            float((whitened(block.data, noise)[0] ** 2).sum()) for block in (fitted, before)
        )
        explains = 1.0 - chi2_after / chi2_before >= self.limits.least_view_share
        indices = list(candidate.indices)
        columns = [fitted.along.index(index) for index in indices]
        change = (theta - self.space.array("start"))[indices]
        return explains and fast_changes_agree(fitted.data, columns, change, self.limits)

    def preference(self, at: Estimate, candidate: Candidate) -> tuple[float, ...]:
        """Return a sort key: plausible values first, then single effects, then the catalogue."""
        return usual_first(self.space, at.theta, candidate)

    def _block(self, data: ViewData, indices: Sequence[int] | None = None) -> ViewBlock:
        """Return the block of `data`, whose slopes are along `indices` or all parameters."""
        assert self.weights is not None
        along = range(len(self.space.entries)) if indices is None else indices
        return ViewBlock(**vars(block_of(data, self.weights, along, self.limits)), data=data)


def _attenuated(series: np.ndarray, reliability: np.ndarray) -> np.ndarray:
    """Return `series` (M, 3, ...) with deviations from its mean scaled by `reliability` (3,)."""
    if not len(series) or (reliability == 1.0).all():
        return series
    mean = series.mean(axis=0)
    return mean + reliability.reshape(3, *[1] * (series.ndim - 2)) * (series - mean)


def view_candidates(among: Sequence[Candidate], block: Block) -> list[Candidate]:
    """Return the candidates that change a view's accelerations, without faults of sensors.

    Each effect of a composite has to change them, alone or through another effect.
    """
    acts, acting_through_others = block.acts(), carried(among)

    def changes_view(candidate: Candidate) -> bool:
        effect = EFFECTS[candidate.name]
        return (
            (bool(acts[list(candidate.indices)].any()) or candidate in acting_through_others)
            and effect.in_flight
            and "command" not in effect.needs
        )

    return [one for one in among if all(changes_view(part) for part in one.singles)]
