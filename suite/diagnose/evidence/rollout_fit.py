"""Rollouts as evidence: their normal equations, starts projected out, and their fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suite.diagnose.data.colour import measured_noise
from suite.diagnose.data.whitening import (
    Linearisation,
    Whitening,
    make_whitening,
    project_out_start,
    whiten,
    whitened_residual,
)
from suite.diagnose.data.windows import STATE, FlightWindows
from suite.diagnose.estimate.gauss_newton import NormalEquations, gauss_newton_step, products
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class Estimate:
    """Where a fit stands."""

    theta: np.ndarray
    """(P,) the vector of all numbers."""
    offset: np.ndarray
    """(W, F) of what is free in each window, from what was measured."""


def start_estimate(model: RolloutModel, windows: FlightWindows) -> Estimate:
    """Return the vehicle file's numbers and the measured starts."""
    return Estimate(model.space.array("start"), np.zeros((len(windows.flight), model.free)))


def normal_equations_of(
    whitening: Whitening, linear: Linearisation, directions: int
) -> NormalEquations:
    """Return the normal equations of `linear` along its first `directions`."""
    residual = project_out_start(whitening, whitened_residual(whitening, linear))
    slope = project_out_start(whitening, whiten(whitening, linear.slope[..., :directions]))
    hessian, gradient = products(slope, residual)
    residual = residual[..., 0]
    # What the start explains is out of the residual, so the slow errors need not be freed of it.
    rows = residual[:, : whitening.weight[0].size].reshape(whitening.weight.shape)[..., :STATE]
    slow = ((np.swapaxes(rows, 1, 2)[:, :, None] @ whitening.slow)[:, :, 0] ** 2).sum(axis=2)
    return NormalEquations(hessian, gradient, (residual**2).sum(axis=1), slow)


def information(
    linear: Linearisation,
    windows: FlightWindows,
    directions: int,
    limits: Thresholds = THRESHOLDS,
) -> np.ndarray:
    """Return what each window tells of each of the first `directions`, (W, K)."""
    noise = measured_noise(linear.residual, linear.start_slope, windows, limits)
    whitening = make_whitening(linear, noise, windows, limits)
    return np.einsum("wkk->wk", normal_equations_of(whitening, linear, directions).hessian)


def fit(
    model: RolloutModel,
    windows: FlightWindows,
    whitening: Whitening,
    start: Estimate,
    indices: list[int],
    rounds: int = 3,
    known: Linearisation | None = None,
    limits: Thresholds = THRESHOLDS,
) -> tuple[Estimate, NormalEquations]:
    """Fit the numbers at `indices` and every window's start (Gauss-Newton, halved where it fails).

    At most `rounds` steps are taken; `known` are the slopes at `start` along all numbers, to save
    their first calculation.

    Returns:
        The best estimate, and its normal equations along `indices`.
    """
    at = np.array(indices, dtype=int)
    low, high = model.space.array("low")[at], model.space.array("high")[at]

    def look(estimate: Estimate) -> tuple[Linearisation, NormalEquations]:
        linear = model.linearise(estimate.theta, estimate.offset, windows, indices)
        return linear, normal_equations_of(whitening, linear, len(indices))

    def step(estimate: Estimate, equations: NormalEquations) -> tuple[np.ndarray, float]:
        hessian, gradient = equations.hessian.sum(0), equations.gradient.sum(0)
        return gauss_newton_step(hessian, gradient, estimate.theta, model.space, indices)

    if known is None:
        linear, equations = look(start)
    else:
        linear = known._replace(slope=known.slope[..., at])
        equations = normal_equations_of(whitening, linear, len(indices))
    best, (change, promised) = start, step(start, equations)
    for _ in range(rounds):
        total = float(equations.chi2.sum())
        white = whitened_residual(whitening, linear)
        if len(at):
            white = white - whiten(whitening, (linear.slope @ change)[..., None])
        moved = np.linalg.solve(whitening.upper, np.swapaxes(whitening.start, 1, 2) @ white)[..., 0]
        share = 1.0
        while share > 0.1:
            theta = best.theta.copy()
            theta[at] = np.clip(theta[at] + share * change, low, high)
            trial = Estimate(theta, best.offset + share * moved)
            new_linear, new_equations = look(trial)
            chi2 = float(new_equations.chi2.sum())
            if np.isfinite(chi2) and chi2 <= total + 1e-6:
                break
            share /= 2.0
        else:
            break
        best, linear, equations = trial, new_linear, new_equations
        change, promised = step(best, equations)
        if promised < limits.converged:
            break
    return best, equations
