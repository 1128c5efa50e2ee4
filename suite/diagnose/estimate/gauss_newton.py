"""Computes Gauss-Newton steps with bounds, and 95 % intervals.

All functions work on normal equations (`estimate/block.py`). J is the Jacobian of the model and r
the residual; chi-square is the squared error over the noise variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import chi2
from scipy.stats import t as student

from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.parameters import ParameterSpace

Z95 = 1.96
"""Half-width of a normal 95 % interval, in standard deviations."""
TINY = 1e-12
"""Smaller information counts as none."""
RIDGE = 1e-9
"""Added to the scaled information. So a parameter that is not identifiable gets a wide interval; a
pseudo-inverse would give it a narrow one."""
FEWEST = 3
"""Smallest number of flights whose differences are tested."""


def solve(
    hessian: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Return the change (K,) of K parameters, from `low` to `high`, that lowers chi-square most.

    `hessian` is J'J and `gradient` J'r. In units of `scale` (K,), the usual size of each parameter,
    the equations are well conditioned.

    Raises:
        ValueError: for values that are not finite.
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
    scaled_gradient = np.linalg.solve(factor, gradient * scale)
    unbounded = np.linalg.solve(factor.T, scaled_gradient)
    low, high = np.minimum(low / scale, -1e-12), np.maximum(high / scale, 1e-12)
    if np.all((unbounded >= low) & (unbounded <= high)):
        return unbounded * scale
    return lsq_linear(factor.T, scaled_gradient, (low, high)).x * scale


def gauss_newton_step(
    equations: NormalEquations,
    theta: np.ndarray,
    space: ParameterSpace,
    inside: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Return the best change (K,) of the parameters, and the expected fall of chi-square.

    `equations` are along the K fitted parameters, computed at `theta` (P,). Only the stretches
    `inside` (B,) bool are fitted, if given.
    """
    hessian, gradient = equations.sums(inside)
    indices = np.array(equations.along, dtype=int)
    low, high, scale = (space.array(name)[indices] for name in ("low", "high", "step"))
    change = solve(hessian, gradient, low - theta[indices], high - theta[indices], scale)
    return change, float(2 * gradient @ change - change @ hessian @ change)


def chi2_fall(
    equations: NormalEquations, theta: np.ndarray, space: ParameterSpace, columns: Sequence[int]
) -> float:
    """Return the fall of chi-square, to first order, by a fit of the parameters at `columns`."""
    fitted = equations.take(sorted(set(columns)))
    if np.einsum("bkk->", fitted.hessian) < TINY:
        return 0.0
    return gauss_newton_step(fitted, theta, space)[1]


class Intervals(NamedTuple):
    """Uncertainty of K fitted parameters."""

    half_width: np.ndarray
    """(K,) half-widths of the 95 % intervals."""
    by_stretch: np.ndarray
    """(K, K) covariance of the parameters, estimated from the differences between stretches."""
    inverse: np.ndarray
    """(K, K) inverse of the information: the covariance of the parameters by independent noise."""

    def factor(self) -> np.ndarray:
        """Return F (K, K): F F' is the parameters' joint uncertainty, with `half_width` as scale.

        Its correlations are those of `by_stretch`; the rows of F are as long as the half-widths.
        """
        deviation = np.sqrt(np.maximum(np.diag(self.by_stretch), TINY))
        values, vectors = np.linalg.eigh(self.by_stretch / np.outer(deviation, deviation))
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        length = np.maximum(np.linalg.norm(factor, axis=1), TINY)
        return (self.half_width / length)[:, None] * factor


def intervals95(
    equations: NormalEquations,
    differ_p: float = 0.0,
    leave_out: bool = False,
    noise_share: float = 1.0,
    prior: np.ndarray | None = None,
) -> Intervals:
    """Return the 95 % intervals at a fit, from its normal equations.

    Each half-width is the largest of up to three:

    - by curvature: independent noise in all rows;
    - by stretches: each stretch is one random draw (the sandwich estimator; Liang and Zeger 1986).
      This holds if errors within a stretch are not independent;
    - by flights: each flight is left out in turn (jackknife). This is used where flights differ by
      more than their stretches explain (Cochran's Q): a model's error persists along a flight.

    Args:
        equations: normal equations along the K fitted parameters.
        differ_p: significance level of the test for differences between flights. With 0 no
            difference is significant, with 1 every one is.
        leave_out: also leave out each stretch in turn (CR3; Bell & McCaffrey 2002), because a
            stretch with much information pulls the fit towards itself.
        noise_share: smallest half-width, as a share of that by curvature.
        prior: (K,) information on each parameter in addition to that of the flights.
    """
    count, size = equations.gradient.shape
    prior = np.zeros(size) if prior is None else prior
    hessian = equations.hessian.sum(axis=0) + np.diag(prior)
    gradient = equations.gradient
    if not leave_out:  # at a bound the mean gradient is not zero; only the spread matters here
        gradient = gradient - gradient.mean(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), TINY))
    scales = np.outer(scale, scale)

    def inverted(matrix: np.ndarray) -> np.ndarray:
        return np.linalg.inv(matrix * scales + RIDGE * np.eye(size)) * scales

    def changes_without(own_hessian: np.ndarray, own_gradient: np.ndarray) -> np.ndarray:
        """Return the change (N, K) of the parameters if each of N draws is left out alone."""
        return np.einsum("nij,nj->ni", inverted(hessian - own_hessian), own_gradient)

    # By curvature.
    inverse = inverted(hessian)
    variance = np.diag(inverse)
    if leave_out:  # a fit follows a stretch that alone informs on a parameter: no spread shows this
        rest = inverted(hessian - equations.hessian)
        variance = np.maximum(variance, np.einsum("nii->ni", rest).max(axis=0))
    half_width = noise_share * Z95 * np.sqrt(variance)
    # By stretches.
    freedom = max(count - 1 if leave_out else count - size, 1 if leave_out else 2)
    if leave_out:
        change = changes_without(equations.hessian, gradient)
    else:
        change = gradient @ inverse * np.sqrt(count / freedom)
    by_stretch = change.T @ change + inverse @ np.diag(prior) @ inverse
    spread = np.sqrt(np.diag(by_stretch)) * float(student.ppf(0.975, freedom))
    half_width = np.maximum(half_width, spread)
    # By flights.
    flight = equations.flight
    flight_numbers = [] if flight is None or not differ_p else np.unique(flight)
    if len(flight_numbers) >= FEWEST:
        inside = np.array([flight == number for number in flight_numbers], dtype=float)
        by_flight, share = inside @ change, len(flight_numbers) / (len(flight_numbers) - 1)
        cochran_q = by_flight**2 / np.maximum(inside @ change**2, 1e-300)
        differ = chi2.sf(cochran_q.sum(axis=0), len(flight_numbers) - 1) < differ_p
        if not leave_out:  # a flight with much information pulls the fit; its stretches do not
            own_hessian = np.einsum("fb,bij->fij", inside, equations.hessian)
            by_flight = changes_without(own_hessian, inside @ gradient)
            by_flight, share = by_flight - by_flight.mean(axis=0), 1.0 / share
        variance = share * (by_flight**2).sum(axis=0)
        by_flight_width = np.sqrt(variance) * float(student.ppf(0.975, len(flight_numbers) - 1))
        half_width = np.where(differ, np.maximum(half_width, by_flight_width), half_width)
    return Intervals(half_width, by_stretch, inverse)
