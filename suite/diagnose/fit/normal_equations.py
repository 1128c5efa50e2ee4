"""The normal equations of whitened windows, and the Gauss-Newton fit that solves them.

All that the search needs of a window is then a few sums: J'J, J'r and r'r of what is left when its
start is projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student

from suite.diagnose.data.colour import measured_noise
from suite.diagnose.data.windows import FlightWindows
from suite.diagnose.fit.model import Linearisation, RolloutModel
from suite.diagnose.fit.parameters import Candidate, ParameterSpace
from suite.diagnose.fit.rollout import STATE
from suite.diagnose.fit.whitening import (
    Whitening,
    make_whitening,
    project_out_start,
    whiten,
    whitened_residual,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class NormalEquations(NamedTuple):
    """Gauss-Newton's sums of each of W windows along K numbers, J and r whitened."""

    hessian: np.ndarray
    """(W, K, K) J'J."""
    gradient: np.ndarray
    """(W, K) J'r."""
    chi2: np.ndarray
    """(W,) r'r."""
    slow_energy: np.ndarray
    """(W, 12) energy of slow errors, by channel of pose, velocity and rates."""
    lent: tuple[int, ...] = ()
    """Numbers whose columns come once more, last: as they are where what they act through is there
    (`composites.Lent`)."""

    def columns_of(self, candidate: Candidate) -> tuple[int, ...]:
        """Return the columns of `candidate` where the first are along all numbers, in order."""
        if not candidate.parts:
            return candidate.indices
        first = self.gradient.shape[1] - len(self.lent)
        again = {number: first + k for k, number in enumerate(self.lent)}
        return tuple(again.get(number, number) for number in candidate.indices)

    def numbers_of(self, columns: Sequence[int]) -> list[int]:
        """Return the place in the vector of what each of `columns` is along."""
        first = self.gradient.shape[1] - len(self.lent)
        return [c if c < first else self.lent[c - first] for c in columns]


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


def products(slope: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J'J (W, K, K) and J'r (W, K) of `slope` (W, M, K) and `residual` (W, M, 1)."""
    turned = np.swapaxes(slope, 1, 2)
    return turned @ slope, (turned @ residual)[..., 0]


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


def solve(
    hessian: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Return the change (K,) within [low, high] that lowers chi-square most.

    `scale` (K,), the usual size of each number, conditions the equations.

    Raises:
        ValueError: where something is not finite, which no bound would show.
    """
    if not len(gradient):
        return np.zeros(0)
    for name, values in (("J'J", hessian), ("J'r", gradient), ("scale", scale)):
        if not np.isfinite(values).all():
            raise ValueError(
                f"{name} of a fit of {len(gradient)} numbers has values that are not finite: a "
                "signal of the flights has no noise estimate, or the model diverges on them"
            )
    matrix = hessian * np.outer(scale, scale)
    ridge = 1e-9 * max(float(np.trace(matrix)) / len(matrix), 1e-12)
    factor = np.linalg.cholesky(matrix + ridge * np.eye(len(matrix)))
    right = np.linalg.solve(factor, gradient * scale)
    free = np.linalg.solve(factor.T, right)
    low, high = np.minimum(low / scale, -1e-12), np.maximum(high / scale, 1e-12)
    if np.all((free >= low) & (free <= high)):
        return free * scale
    return lsq_linear(factor.T, right, (low, high)).x * scale


def gauss_newton_step(
    hessian: np.ndarray,
    gradient: np.ndarray,
    theta: np.ndarray,
    space: ParameterSpace,
    indices: Sequence[int],
) -> tuple[np.ndarray, float]:
    """Return the best change of the numbers at `indices` and the fall of chi-square it promises.

    `hessian` (K, K) and `gradient` (K,) are along them alone, taken at `theta` (P,).
    """
    at = np.array(indices, dtype=int)
    low, high, scale = (space.array(name)[at] for name in ("low", "high", "step"))
    change = solve(hessian, gradient, low - theta[at], high - theta[at], scale)
    return change, float(2 * gradient @ change - change @ hessian @ change)


def along_numbers(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, columns: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the change (P,) of all numbers that `columns` ask for, and what is told of each (P,).

    `equations` were taken at `theta` (P,); numbers that no column is along are not changed.
    """
    at, numbers = list(columns), equations.numbers_of(columns)
    hessian = equations.hessian.sum(axis=0)[np.ix_(at, at)]
    gradient = equations.gradient.sum(axis=0)[at]
    moved, _ = gauss_newton_step(hessian, gradient, theta, space, numbers)
    change, told = np.zeros_like(theta), np.zeros_like(theta)
    change[numbers], told[numbers] = moved, np.diag(hessian)
    return change, told


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


def half_widths95(
    equations: NormalEquations, flight: np.ndarray | None = None, noise_freedom: int | None = None
) -> np.ndarray:
    """Return half-widths (K,) of 95 % intervals at the fit whose normal equations these are.

    The largest of these counts: by the covariance of the noise (Gauss-Newton), and by the one in
    which each window's slope is one draw (the block sandwich; Liang and Zeger 1986), which holds
    where errors within a window are not independent. With `flight` (W,), the number of each
    window's flight, one in which each flight is one draw: a model's error comes back in every
    window of a flight. The noise is known with `noise_freedom` degrees of freedom, that of the
    windows if not given.

    Few flights pull a fit of several numbers towards what they themselves want, so that by their
    slopes it is surer than it is: each flight is left out in turn as well (jackknife).
    """
    count, size = equations.gradient.shape
    if not size:
        return np.zeros(0)
    hessian = equations.hessian.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    inverse = np.linalg.pinv(hessian * np.outer(scale, scale)) * np.outer(scale, scale)

    def by_draws(gradient: np.ndarray, freedom: int) -> np.ndarray:
        centred = gradient - gradient.mean(axis=0)
        blocks = inverse @ (centred.T @ centred * len(gradient) / freedom) @ inverse
        return np.sqrt(np.maximum(np.diag(blocks), 0.0)) * float(student.ppf(0.975, freedom))

    freedom = max(count - size, 2)
    known = float(student.ppf(0.975, noise_freedom or freedom))
    widths = np.sqrt(np.maximum(np.diag(inverse), 0.0)) * known
    widths = np.maximum(widths, by_draws(equations.gradient, freedom))
    numbers = [] if flight is None else np.unique(flight)
    if len(numbers) > 2:
        flights = np.array([equations.gradient[flight == one].sum(axis=0) for one in numbers])
        told = np.array([equations.hessian[flight == one].sum(axis=0) for one in numbers])
        widths = np.maximum(widths, by_draws(flights, len(flights) - 1))
        widths = np.maximum(widths, _by_leaving_out(told, flights, scale))
    return widths


def _by_leaving_out(hessian: np.ndarray, gradient: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return half-widths (K,) from the solutions without each of F flights.

    Args:
        hessian: (F, K, K) of each flight.
        gradient: (F, K), likewise.
        scale: (K,) of the numbers.
    """
    count = len(gradient)
    rest = (hessian.sum(axis=0) - hessian) * np.outer(scale, scale)
    slopes = (gradient.sum(axis=0) - gradient) * scale
    found = scale * np.einsum("fij,fj->fi", np.linalg.pinv(rest, hermitian=True), slopes)
    spread = (count - 1) / count * np.sum((found - found.mean(axis=0)) ** 2, axis=0)
    return np.sqrt(spread) * float(student.ppf(0.975, count - 1))
