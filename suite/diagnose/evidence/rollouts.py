"""Rollouts of a second as evidence: whitened, and freed from the state in which each starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from suite.diagnose.data.colour import Noise, left_as_noise, measured_noise
from suite.diagnose.data.whitening import (
    Linearisation,
    Whitening,
    make_whitening,
    slow_energy,
    whiten,
    whitened_residual,
)
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.gauss_newton import gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.evidence.evidence import Evidence, flights_agree
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class RolloutEvidence(Evidence):
    """Rollouts of W stretches, weighed by their noise."""

    model: RolloutModel
    windows: FlightWindows
    """At full length."""
    trusted: FlightWindows
    """As long as slopes can be trusted."""
    noise: Noise
    whitening: Whitening
    limits: Thresholds = THRESHOLDS
    off: bool = False
    """Whether all that the model leaves is taken for noise."""

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's numbers."""
        return self.model.space

    @property
    def draws(self) -> float:
        """Flights are draws where the model is off: its error comes back in all of one."""
        return 1.0 if self.off else 0.0

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return the block along these numbers, see `Evidence`."""
        linear = self.model.linearise(at.theta, at.free, self.trusted, indices)
        along = range(self.model.size) if indices is None else indices
        return block_of(self.whitening, linear, along, self.windows)

    def weighed(self, at: Estimate) -> tuple[RolloutEvidence, Block]:
        """Return this with its noise as it is there, see `Evidence`."""
        # Noise is measured best where the model fits best, and slopes are trusted for longer.
        return weighed_by(self.model, self.windows, self._everything(at), self.limits)

    def again(self, at: Estimate) -> tuple[RolloutEvidence, Block]:
        """Return this with the noise that it has, see `Evidence`."""
        linear = self._everything(at)
        found, block = weighed_by(self.model, self.windows, linear, self.limits, self.noise)
        return replace(found, off=self.off), block

    def misfit(self, at: Estimate, block: Block) -> tuple[RolloutEvidence, Block] | None:
        """Return this where more than noise is left, see `Evidence`."""
        slow, expected = self.slow_errors(block)
        if slow.sum() <= self.limits.structure_rotor_input * expected.sum():
            return None
        linear = self._everything(at)
        noise = left_as_noise(linear.residual, linear.start_slope, self.trusted, self.limits)
        whitening = make_whitening(linear, noise, self.trusted, self.limits)
        found = replace(self, noise=noise, whitening=whitening, off=True)
        return found, block_of(whitening, linear, range(self.model.size), self.windows)

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return what a candidate takes, see `Evidence`."""
        if self.off and not flights_agree(gains):
            return None
        return super().share(now, at, then, candidate, gains)

    def slow_errors(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy (W, 12) of slow errors in `block`, and what noise gives of it."""
        return slow_energy(self.whitening, block.residual), self.whitening.slow_freedom

    def _everything(self, at: Estimate) -> Linearisation:
        return self.model.linearise(at.theta, at.free, self.windows, None)


def start_estimate(model: RolloutModel, windows: FlightWindows) -> Estimate:
    """Return the vehicle file's numbers and the measured starts."""
    return Estimate(model.space.array("start"), np.zeros((len(windows.flight), model.free)))


def weighed_by(
    model: RolloutModel,
    windows: FlightWindows,
    linear: Linearisation,
    limits: Thresholds = THRESHOLDS,
    noise: Noise | None = None,
    along: Sequence[int] | None = None,
) -> tuple[RolloutEvidence, Block]:
    """Return the evidence of `windows` whose noise is that of the slopes `linear`, and its block.

    Args:
        model: the rollout.
        windows: W of them.
        linear: slopes along all numbers and what is free.
        limits: of every step.
        noise: where it is known already.
        along: the numbers of the first slopes; all numbers if not given.
    """
    view = trusted(windows, linear.residual, limits)
    noise = noise or measured_noise(linear.residual, linear.start_slope, view, limits)
    whitening = make_whitening(linear, noise, view, limits)
    found = RolloutEvidence(model, windows, view, noise, whitening, limits)
    numbers = range(model.size) if along is None else along
    return found, block_of(whitening, linear, numbers, windows)


def block_of(
    whitening: Whitening, linear: Linearisation, along: Sequence[int], windows: FlightWindows
) -> Block:
    """Return the block of `linear`, whose first columns are `along` these numbers."""
    residual = whitened_residual(whitening, linear)
    slope = whiten(whitening, linear.slope[..., : len(along)])
    turned = np.swapaxes(whitening.start, 1, 2)
    by_start = turned @ np.concatenate([residual, slope], axis=2)
    moved = np.linalg.solve(whitening.upper, by_start)
    return Block(
        (residual - whitening.start @ by_start[..., :1])[..., 0],
        slope - whitening.start @ by_start[..., 1:],
        tuple(along),
        np.asarray(windows.flight),
        np.asarray(windows.start_s),
        moved[..., 0],
        moved[..., 1:],
    )


def information(
    linear: Linearisation, windows: FlightWindows, size: int, limits: Thresholds = THRESHOLDS
) -> np.ndarray:
    """Return what each window tells of each of the first `size` numbers, (W, K)."""
    noise = measured_noise(linear.residual, linear.start_slope, windows, limits)
    whitening = make_whitening(linear, noise, windows, limits)
    block = block_of(whitening, linear, range(size), windows)
    return np.asarray((block.slope**2).sum(axis=1))


def least_left(
    model: RolloutModel, windows: FlightWindows, linear: Linearisation, limits: Thresholds
) -> float:
    """Return the squared error a value, 1 of noise, that all numbers of the catalogue leave.

    To first order about `linear`, the slopes of `windows` along all numbers.
    """
    evidence, block = weighed_by(model, windows, linear, limits)
    equations = block.equations()
    told = np.einsum("bkk->k", equations.hessian)
    some = equations.take(np.flatnonzero(told > 1e-9).tolist())
    _, fall = gauss_newton_step(some, model.space.array("start"), model.space)
    seen = int(np.asarray(evidence.trusted.seen).sum())
    return (float(equations.chi2.sum()) - fall) / max(seen, 1)


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
