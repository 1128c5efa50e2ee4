"""P-values of changes since reference flights, corrected for the number of candidates.

A candidate is an effect that may have changed. On the means of a few flights most candidates are
strongly correlated, so Bonferroni's correction by their number would be too strict. Instead the
smallest p-value of all candidates is simulated under the null hypothesis (Westfall and Young 1993).
The spread of flights of an unchanged vehicle, in units of a rotor's thrust, is estimated here, too.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from suite.diagnose.evidence.moments import means_of
from suite.diagnose.evidence.views import ViewEvidence


def corrected_p_values(
    gains: Sequence[float],
    slope: np.ndarray,
    groups: Sequence[Sequence[int]],
    always: Sequence[int],
    variance_ratios: np.ndarray,
    rng: np.random.Generator,
) -> list[float]:
    """Return for each group the probability that the best of all groups gains as much by chance.

    Args:
        gains: falls of chi-square by each group of columns, in addition to those of `always`.
        slope: (F, 3, P) of flights' means along all columns, in units of independent noise.
        groups: columns that are fitted together.
        always: columns that are always fitted.
        variance_ratios: (D, 3) draws of each axis's estimated variance over the true one; the
            smallest p-value is 1 / (D + 1).
        rng: of the noise. It may be the one that drew `variance_ratios`, but not seeded again.
    """
    draws = len(variance_ratios)
    noise = rng.standard_normal((draws, len(slope), 3))
    noise = (noise / np.sqrt(variance_ratios)[:, None]).reshape(draws, -1)
    slope = slope.reshape(-1, slope.shape[-1])
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    fitted = _orthonormal_basis(slope[:, list(always)])
    free = slope - fitted @ (fitted.T @ slope)
    # P-values of single groups compare groups of different sizes.
    smallest = np.ones(draws)
    for group in groups:
        gain = ((noise @ _orthonormal_basis(free[:, list(group)])) ** 2).sum(axis=1)
        smallest = np.minimum(smallest, chi2.sf(gain, len(group)))
    return [
        float((1 + (smallest <= chi2.sf(max(gain, 0.0), len(group))).sum()) / (1 + draws))
        for gain, group in zip(gains, groups, strict=True)
    ]


def _orthonormal_basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (M, R) of the span of `columns` (M, K), of unit length or 0."""
    left, value, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, value > 1e-6]


@dataclass(frozen=True)
class RotorSpread:
    """Spread of flights of one unchanged vehicle, in units of a rotor's thrust."""

    share: float
    """Standard deviation of a rotor's thrust from flight to flight, by all axes together [1]."""
    freedom: int
    """Degrees of freedom of this estimate."""
    along: Mapping[str, np.ndarray]
    """By view (force, torque), the same along each axis (3,): its own estimate, moderated by that
    of all axes."""
    freedom_along: Mapping[str, np.ndarray]
    """By view, degrees of freedom of each axis's own estimate (3,)."""
    prior: int
    """Degrees of freedom of the estimate of all axes in that along an axis."""

    def variance_ratios(self, view: str, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Return draws (D, 3) of the estimated variance over the true one, if all axes are equal.

        Where the estimate is too small, changes seem too large.
        """
        freedom = np.concatenate(list(self.freedom_along.values()))
        square = rng.chisquare(np.maximum(freedom, 1e-9), (draws, len(freedom)))
        pooled = square.sum(axis=1, keepdims=True) / max(self.freedom, 1)
        axes = 3 * list(self.freedom_along).index(view) + np.arange(3)
        return _moderated(pooled, square[:, axes], freedom[axes], self.prior)


def _moderated(
    pooled: np.ndarray | float, square: np.ndarray, freedom: np.ndarray, prior: int
) -> np.ndarray:
    """Return each axis's variance, by its sum of squares and the pooled variance (Smyth 2004)."""
    return (prior * pooled + square) / (prior + freedom)


def rotor_gain(task: ViewEvidence) -> np.ndarray:
    """Return the accelerations (3,) by a relative change of one rotor's thrust.

    Along each axis they are the root of the four rotors' summed squares, in the view's unit.
    """
    space = task.model.space
    indices = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    slope = task.residuals(space.array("start"), indices).slope.mean(axis=0)
    return np.sqrt((slope**2).sum(axis=1))


def rotor_spread(sets: Sequence[ViewEvidence]) -> RotorSpread:
    """Return the spread of flights within each of `sets` (the reference and later flights)."""
    square: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))
    freedom: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for task in sets:
        data, gain = task.residuals(task.start.theta), rotor_gain(task)
        means = means_of(data.residual, data.flight)
        axes = gain > task.limits.least_rotor_gain * gain.max()
        if task.view.in_world:
            axes &= np.arange(3) == 2  # rotors only push along body z
        deviation = (means - means.mean(axis=0)) / np.where(axes, gain, np.inf)
        square[task.view.name] += (deviation**2).sum(axis=0)
        freedom[task.view.name] += axes * (len(means) - 1)
    count = int(sum(one.sum() for one in freedom.values()))
    share = float(np.sqrt(sum(one.sum() for one in square.values()) / max(count, 1)))
    prior = sets[0].limits.spread_freedom
    along = {
        name: np.sqrt(_moderated(share**2, square[name], freedom[name], prior)) for name in square
    }
    return RotorSpread(share, count, along, dict(freedom), prior)
