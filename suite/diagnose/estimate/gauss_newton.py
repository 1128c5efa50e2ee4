"""The one fit: Gauss-Newton with bounds, halved where a step fails, on whatever makes blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from suite.diagnose.estimate.block import Block, Estimate, Linearised, NormalEquations
from suite.diagnose.estimate.parameters import ParameterSpace
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


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
    equations: NormalEquations,
    theta: np.ndarray,
    space: ParameterSpace,
    inside: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Return the best change of the equations' numbers and the fall of chi-square it promises.

    Args:
        equations: along numbers that are fitted together, taken at `theta`.
        theta: (P,) all numbers.
        space: their bounds.
        inside: (B,) bool: the stretches that count; all if not given.
    """
    hessian, gradient = equations.sums(inside)
    at = np.array(equations.numbers, dtype=int)
    low, high, scale = (space.array(name)[at] for name in ("low", "high", "step"))
    change = solve(hessian, gradient, low - theta[at], high - theta[at], scale)
    return change, float(2 * gradient @ change - change @ hessian @ change)


def chi2_fall(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, columns: Sequence[int]
) -> float:
    """Return the fall of chi-square to first order where the numbers at `columns` are fitted."""
    some = equations.take(sorted(set(columns)))
    if not some.gradient.shape[1] or np.einsum("bkk->", some.hessian) < 1e-12:
        return 0.0
    return gauss_newton_step(some, theta, space)[1]


def chi2_by_part(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, part: np.ndarray
) -> np.ndarray:
    """Return the squared error (G,) of each part under what the others fit of the numbers.

    To first order about `theta` (P,), where the equations were taken; `part` (B,) is the number of
    each stretch's part.
    """
    found = []
    for number in np.unique(part):
        inside = part == number
        moved, _ = gauss_newton_step(equations, theta, space, ~inside)
        own, pull = equations.sums(inside)
        found.append(equations.chi2[inside].sum() - 2.0 * pull @ moved + moved @ own @ moved)
    return np.array(found, dtype=float)


def fit(
    evidence: Linearised,
    start: Estimate,
    indices: Sequence[int],
    rounds: int | None = None,
    known: Block | None = None,
    limits: Thresholds = THRESHOLDS,
) -> tuple[Estimate, Block]:
    """Fit the numbers at `indices` and what is free in every stretch.

    At most `rounds` steps are taken, those of the limits if not given; `known` is what the evidence
    says at `start`, to save its calculation.

    Returns:
        The best estimate, and what the evidence says there.
    """
    at, space = np.array(indices, dtype=int), evidence.space
    low, high = space.array("low")[at], space.array("high")[at]
    best, block = start, known or evidence.linearise(start, indices)
    for done in range(limits.fit_rounds if rounds is None else rounds):
        equations = block.equations().along_numbers(indices)
        change, promised = gauss_newton_step(equations, best.theta, space)
        # What is free moves as well, at least once.
        if promised < limits.converged and (done or not block.free.shape[1]):
            break
        columns = [block.along.index(number) for number in indices]
        moved = block.free - block.free_slope[..., columns] @ change
        share, total = 1.0, float(equations.chi2.sum())
        while share > 0.1:
            theta = best.theta.copy()
            theta[at] = np.clip(theta[at] + share * change, low, high)
            free = best.free + share * moved if moved.size else best.free
            trial = Estimate(theta, free)
            there = evidence.linearise(trial, indices)
            chi2 = float((there.residual**2).sum())
            if np.isfinite(chi2) and chi2 <= total + 1e-6:
                break
            share /= 2.0
        else:
            break
        best, block = trial, there
    return best, block
