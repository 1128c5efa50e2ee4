"""Gauss-Newton: normal equations of blocks of evidence, and the step that solves them in bounds.

All that a search needs of a block is a few sums: J'J, J'r and r'r of what is left when its nuisance
parameters are projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from suite.diagnose.estimate.parameters import Candidate, ParameterSpace


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


def products(slope: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J'J (W, K, K) and J'r (W, K) of `slope` (W, M, K) and `residual` (W, M, 1)."""
    turned = np.swapaxes(slope, 1, 2)
    return turned @ slope, (turned @ residual)[..., 0]


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
