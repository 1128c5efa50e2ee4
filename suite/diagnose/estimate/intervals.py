"""The one interval of fitted numbers: by curvature, by stretches of flights and by flights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from suite.diagnose.estimate.block import NormalEquations

Z95 = 1.96
TINY = 1e-12
"""Information below this is none."""
RIDGE = 1e-9
"""Makes what cannot be told apart wide, where a pseudo-inverse would hide it."""
FEWEST = 3
"""Flights from which how they differ says something."""


class Intervals(NamedTuple):
    """How far K fitted numbers may be off."""

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
        leave_out: stretches are left out in turn, too (CR3): a stretch with much to say fits
            itself. With few of them their spread is itself not well known (Bell & McCaffrey 2002).
        noise_share: share of the interval by curvature below which no interval is.
        prior: (K,) information on each number beside the flights', as of one that was held.
    """
    count, size = equations.gradient.shape
    if not size:
        none = np.zeros((0, 0))
        return Intervals(np.zeros(0), none, none)
    given = np.zeros(size) if prior is None else prior
    hessian = equations.hessian.sum(axis=0) + np.diag(given)
    gradient = equations.gradient - equations.gradient.mean(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), TINY))
    both = np.outer(scale, scale)

    def inverted(matrix: np.ndarray) -> np.ndarray:
        return np.linalg.inv(matrix * both + RIDGE * np.eye(size)) * both

    def moves(own: np.ndarray, pulls: np.ndarray) -> np.ndarray:
        """Return by how much draws (N, K) move the numbers, by what all others say of these."""
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
        q = (inside @ moved) ** 2 / np.maximum(inside @ moved**2, 1e-300)
        differ = chi2.sf(q.sum(axis=0), len(numbers) - 1) < differ_p
        own = np.einsum("fb,bij->fij", inside, equations.hessian)
        away = moves(own, inside @ gradient)
        among = (len(numbers) - 1) / len(numbers) * ((away - away.mean(axis=0)) ** 2).sum(axis=0)
        wide = np.sqrt(among) * float(student.ppf(0.975, len(numbers) - 1))
        widths = np.where(differ, np.maximum(widths, wide), widths)
    return Intervals(widths, by_stretch, inverse)
