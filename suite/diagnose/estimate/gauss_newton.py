"""Gauss-Newton with bounds and step halving, and 95 % intervals, for every source of evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import chi2
from scipy.stats import t as student

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

    At most `rounds` steps are taken (default: that of `limits`); `known` is the block at `start`,
    to save its computation.

    Returns:
        The best estimate, and the block there.
    """
    at, space = np.array(indices, dtype=int), evidence.space
    low, high = space.array("low")[at], space.array("high")[at]
    best, block = start, known or evidence.linearise(start, indices)
    for done in range(limits.fit_rounds if rounds is None else rounds):
        equations = block.equations.along_numbers(indices)
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


Z95 = 1.96
TINY = 1e-12
"""Information below this is none."""
RIDGE = 1e-9
"""Gives parameters that are not identifiable a wide interval; a pseudo-inverse would hide them."""
FEWEST = 3
"""Least number of flights whose differences are tested."""


class Intervals(NamedTuple):
    """Uncertainty of K fitted numbers."""

    half_width: np.ndarray
    """(K,) of the 95 % intervals."""
    by_stretch: np.ndarray
    """(K, K) covariance by how stretches disagree."""
    inverse: np.ndarray
    """(K, K) of the information, which is the covariance by independent noise."""


def intervals95(
    equations: NormalEquations,
    differ_p: float = 0.0,
    leave_out: bool = False,
    noise_share: float = 1.0,
    prior: np.ndarray | None = None,
) -> Intervals:
    """Return the intervals at the fit whose normal equations these are.

    The largest of these counts: by curvature, the covariance of the noise; by stretches, each of
    which is one draw (the sandwich; Liang and Zeger 1986), which holds where errors within one are
    not independent; and by flights, each left out in turn (jackknife), where they differ by more
    than their stretches explain (Cochran's Q): a model's error comes back in all of a flight.

    Args:
        equations: along the fitted numbers.
        differ_p: flights differ where chance makes them do so more rarely than this: 0 never, 1
            always.
        leave_out: stretches are left out in turn, too (CR3): a stretch with much information fits
            itself. With few of them their spread is itself not well known (Bell & McCaffrey 2002).
        noise_share: share of the interval by curvature below which no interval is.
        prior: (K,) information on each number in addition to the flights', as of a fixed one.
    """
    count, size = equations.gradient.shape
    if not size:
        none = np.zeros((0, 0))
        return Intervals(np.zeros(0), none, none)
    given = np.zeros(size) if prior is None else prior
    hessian = equations.hessian.sum(axis=0) + np.diag(given)
    gradient = equations.gradient
    if not leave_out:  # what stands at a bound pulls on, in every stretch alike
        gradient = gradient - gradient.mean(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), TINY))
    both = np.outer(scale, scale)

    def inverted(matrix: np.ndarray) -> np.ndarray:
        return np.linalg.inv(matrix * both + RIDGE * np.eye(size)) * both

    def moves(own: np.ndarray, pulls: np.ndarray) -> np.ndarray:
        """Return by how much draws (N, K) move the numbers, by the others' estimate of these."""
        return np.einsum("nij,nj->ni", inverted(hessian - own), pulls)

    inverse = inverted(hessian)
    widths = noise_share * Z95 * np.sqrt(np.diag(inverse))
    freedom = max(count - 1 if leave_out else count - size, 1 if leave_out else 2)
    if leave_out:
        moved = moves(equations.hessian, gradient)
    else:
        moved = gradient @ inverse * np.sqrt(count / freedom)
    by_stretch = moved.T @ moved + inverse @ np.diag(given) @ inverse
    spread = np.sqrt(np.diag(by_stretch)) * float(student.ppf(0.975, freedom))
    widths = np.maximum(widths, spread)
    flight = equations.flight
    numbers = [] if flight is None or not differ_p else np.unique(flight)
    if len(numbers) >= FEWEST:
        inside = np.array([flight == number for number in numbers], dtype=float)
        away, share = inside @ moved, len(numbers) / (len(numbers) - 1)
        q = away**2 / np.maximum(inside @ moved**2, 1e-300)
        differ = chi2.sf(q.sum(axis=0), len(numbers) - 1) < differ_p
        if not leave_out:  # a flight with much information fits itself, where its stretches do not
            own = np.einsum("fb,bij->fij", inside, equations.hessian)
            away, share = moves(own, inside @ gradient), 1.0 / share
            away -= away.mean(axis=0)
        among = share * (away**2).sum(axis=0)
        wide = np.sqrt(among) * float(student.ppf(0.975, len(numbers) - 1))
        widths = np.where(differ, np.maximum(widths, wide), widths)
    return Intervals(widths, by_stretch, inverse)
