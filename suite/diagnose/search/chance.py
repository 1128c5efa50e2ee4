"""P-values of changes since reference flights, corrected for the number of candidates.

A candidate is an effect that may have changed. Each flight is compared by its mean residual. In the
means of a few flights most candidates look alike, so a Bonferroni correction by their number would
be too strict. Instead the distribution of the smallest p-value of all candidates is simulated under
the null hypothesis, that nothing has changed (Westfall and Young 1993).

An unchanged vehicle does not fly twice exactly the same. This spread from flight to flight is
estimated here, too, as a relative change of one rotor's thrust that would cause it.
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
        gains: fall of chi-square by each group, after the columns `always` are fitted.
        slope: (F, 3, P) derivative of F flights' means by P parameters (columns), in units of
            independent noise.
        groups: columns that are fitted together, such as all parameters of a candidate.
        always: columns that are always fitted.
        variance_ratios: (D, 3) draws of each axis's estimated variance over the true variance. The
            smallest possible p-value is 1 / (D + 1).
        rng: generator of the noise. If it has drawn `variance_ratios`, it must not be seeded again.
    """
    draws = len(variance_ratios)
    noise = rng.standard_normal((draws, len(slope), 3))
    noise = (noise / np.sqrt(variance_ratios)[:, None]).reshape(draws, -1)
    slope = slope.reshape(-1, slope.shape[-1])
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    fitted = _orthonormal_basis(slope[:, list(always)])
    free = slope - fitted @ (fitted.T @ slope)
    # Groups differ in size, so they are compared by their p-values and not by their gains.
    smallest = np.ones(draws)
    for group in groups:
        gain = ((noise @ _orthonormal_basis(free[:, list(group)])) ** 2).sum(axis=1)
        smallest = np.minimum(smallest, chi2.sf(gain, len(group)))
    return [
        float((1 + (smallest <= chi2.sf(max(gain, 0.0), len(group))).sum()) / (1 + draws))
        for gain, group in zip(gains, groups, strict=True)
    ]


def _orthonormal_basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (M, R) of the span of `columns` (M, K).

    The columns must have unit length or be 0, as smaller singular values count as dependence.
    """
    directions, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return directions[:, sizes > 1e-6]


@dataclass(frozen=True)
class RotorSpread:
    """Spread from flight to flight of one unchanged vehicle, relative to a rotor's thrust."""

    share: float
    """Standard deviation from flight to flight, relative to a rotor's thrust, pooled over all
    axes."""
    freedom: int
    """Degrees of freedom of this pooled estimate."""
    along: Mapping[str, np.ndarray]
    """(3,) standard deviation along each axis, by view (force or torque): a weighted mean of the
    estimate of the axis alone and the pooled estimate."""
    freedom_along: Mapping[str, np.ndarray]
    """(3,) degrees of freedom of the estimate of each axis alone, by view."""
    prior: int
    """Weight of the pooled estimate in `along`, in degrees of freedom."""

    def variance_ratios(self, view: str, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Return draws (D, 3) of the estimated variance over the true one, by axis of `view`.

        All axes have the same true variance here. Where the estimate is too small by chance, any
        change seems too large, which the draws take into account.
        """
        freedom = np.concatenate(list(self.freedom_along.values()))
        square = rng.chisquare(np.maximum(freedom, 1e-9), (draws, len(freedom)))
        pooled = square.sum(axis=1, keepdims=True) / max(self.freedom, 1)
        axes = 3 * list(self.freedom_along).index(view) + np.arange(3)
        return _moderated(pooled, square[:, axes], freedom[axes], self.prior)


def _moderated(
    pooled: np.ndarray | float, square: np.ndarray, freedom: np.ndarray, prior: int
) -> np.ndarray:
    """Return a weighted mean of the pooled variance and of each axis's own (Smyth 2004).

    `square` is the sum of squares of an axis with `freedom`, and `prior` the weight of `pooled`.
    """
    return (prior * pooled + square) / (prior + freedom)


def rotor_gain(task: ViewEvidence) -> np.ndarray:
    """Return the accelerations (3,) by a relative change of a rotor's thrust, in the view's unit.

    Along each axis this is the root of the sum of the four rotors' squared accelerations.
    """
    space = task.model.space
    weak_motor = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    slope = task.residuals(space.array("start"), weak_motor).slope.mean(axis=0)
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
    count = int(sum(by_axis.sum() for by_axis in freedom.values()))
    share = float(np.sqrt(sum(by_axis.sum() for by_axis in square.values()) / max(count, 1)))
    prior = sets[0].limits.spread_freedom
    along = {
        name: np.sqrt(_moderated(share**2, square[name], freedom[name], prior)) for name in square
    }
    return RotorSpread(share, count, along, dict(freedom), prior)
