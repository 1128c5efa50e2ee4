"""P-values of a change since reference flights, corrected for the number of candidates.

On the means of a few flights most candidates are strongly correlated, so Bonferroni's correction by
their number would be too strict. The smallest p-value of all candidates is simulated under the null
instead (Westfall and Young 1993).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from suite.diagnose.evidence.moments import means_of
from suite.diagnose.evidence.views import ViewEvidence


def chance_of(
    gains: Sequence[float],
    slope: np.ndarray,
    groups: Sequence[Sequence[int]],
    always: Sequence[int],
    sizes: np.ndarray,
    rng: np.random.Generator,
) -> list[float]:
    """Return for each group how often the best of all groups gains as much by chance.

    Args:
        gains: falls of chi-square by each group of columns next to those of `always`.
        slope: (F, 3, P) of flights' means along all columns, in units of independent noise.
        groups: columns that are fitted together.
        always: columns that are fitted in any case.
        sizes: (D, 3) draws of the estimate of each axis's variance over the true one; the smallest
            p-value is one in as many.
        rng: of the noise; what `sizes` were drawn by may go on, but not begin again.
    """
    draws = len(sizes)
    noise = rng.standard_normal((draws, len(slope), 3))
    noise = (noise / np.sqrt(sizes)[:, None]).reshape(draws, -1)
    slope = slope.reshape(-1, slope.shape[-1])
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    known = _directions(slope[:, list(always)])
    free = slope - known @ (known.T @ slope)
    least = np.ones(draws)
    for group in groups:
        gain = ((noise @ _directions(free[:, list(group)])) ** 2).sum(axis=1)
        least = np.minimum(least, _alone(gain, len(group)))
    return [
        float((1 + (least <= _alone(max(gain, 0.0), len(group))).sum()) / (1 + draws))
        for gain, group in zip(gains, groups, strict=True)
    ]


def _alone(gain: np.ndarray | float, size: int) -> np.ndarray:
    """Return the p-value of one group's gain alone, which compares groups of different `size`."""
    return chi2.sf(gain, size)


def _directions(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (M, R) of what `columns` (M, K), of unit size or none, span."""
    left, value, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, value > 1e-6]


@dataclass(frozen=True)
class RotorSpread:
    """How much flights of one unchanged vehicle differ."""

    share: float
    """Standard deviation of a rotor's thrust from flight to flight, by all axes together [1]."""
    freedom: int
    """Degrees of freedom that it was estimated with."""
    along: Mapping[str, np.ndarray]
    """By view, the same along each axis (3,), from its own differences and those of all axes."""
    freedom_along: Mapping[str, np.ndarray]
    """By view, degrees of freedom of each axis's own differences (3,)."""
    prior: int
    """Degrees of freedom for which the spread of all axes counts next to an axis's own."""

    def sizes(self, view: str, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Return draws (D, 3) of the square of `along` over the true one, where all axes are alike.

        Where it comes out small, changes come out large.
        """
        freedom = np.concatenate(list(self.freedom_along.values()))
        square = rng.chisquare(np.maximum(freedom, 1e-9), (draws, len(freedom)))
        pooled = square.sum(axis=1, keepdims=True) / max(self.freedom, 1)
        at = 3 * list(self.freedom_along).index(view) + np.arange(3)
        return _moderated(pooled, square[:, at], freedom[at], self.prior)


def _moderated(
    pooled: np.ndarray | float, square: np.ndarray, freedom: np.ndarray, prior: int
) -> np.ndarray:
    """Return an axis's variance by its own squares and that of all (Smyth 2004)."""
    return (prior * pooled + square) / (prior + freedom)


def rotor_gain(task: ViewEvidence) -> np.ndarray:
    """Return what a rotor's own change of thrust does along each axis (3,), all four together."""
    space = task.model.space
    at = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    slope = task.left(space.array("start"), at).slope.mean(axis=0)
    return np.sqrt((slope**2).sum(axis=1))


def rotor_spread(sets: Sequence[ViewEvidence]) -> RotorSpread:
    """Return how flights differ within each of `sets`: the reference's and the others', by view."""
    square: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))
    freedom: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for task in sets:
        data, gain = task.left(task.start.theta), rotor_gain(task)
        means = means_of(data.residual, data.flight)
        axes = gain > task.limits.least_rotor_gain * gain.max()
        if task.view.in_world:
            axes &= np.arange(3) == 2  # across the thrust rotors do nothing
        away = (means - means.mean(axis=0)) / np.where(axes, gain, np.inf)
        square[task.view.name] += (away**2).sum(axis=0)
        freedom[task.view.name] += axes * (len(means) - 1)
    count = int(sum(one.sum() for one in freedom.values()))
    share = float(np.sqrt(sum(one.sum() for one in square.values()) / max(count, 1)))
    prior = sets[0].limits.spread_freedom
    along = {
        name: np.sqrt(_moderated(share**2, square[name], freedom[name], prior)) for name in square
    }
    return RotorSpread(share, count, along, dict(freedom), prior)
