"""Gain of each candidate effect, and its p-value by draws of the null hypothesis.

The gain is the fall of the squared error. The p-value is the probability that the best of all
candidates gains as much if no effect is missing. The distribution of gains in that case is called
the null below.

Where windows (1 s of a flight) are fitted, a gain is cross-validated, and the null is drawn by a
permutation test. Where a few flights are compared by their mean residuals, most candidates look
alike, so a Bonferroni correction by their number would be too strict. There the null is drawn from
the known noise: it is the smallest p-value of all candidates (Westfall and Young 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from suite.diagnose.estimate.gauss_newton import solve
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class CandidateScore(NamedTuple):
    """How much a candidate explains in addition to the effects that are already named."""

    candidate: Candidate
    gain: float
    """Fall of chi-square on windows that were left out of the fit, summed over the folds."""
    p_value: float
    """Probability that the best of all candidates gains as much under the null hypothesis."""
    chance: float
    """Gain with a p-value of 1 %."""


def permutation_test(
    among: Sequence[Candidate],
    hessian: np.ndarray,
    gradient: np.ndarray,
    groups: Sequence[tuple[int, ...]],
    always: tuple[int, ...],
    fold: np.ndarray,
    seed: int,
    room: tuple[np.ndarray, np.ndarray] | None = None,
    limits: Thresholds = THRESHOLDS,
) -> list[CandidateScore]:
    """Return the scores of candidates, best first.

    The null is the distribution of the largest gain of all groups if each window's residual gets a
    random sign. A sign for a whole window keeps the correlation within it. First the part that the
    best group explains is subtracted (Freedman and Lane 1983), since otherwise a real effect in a
    few windows would be part of the null; if that part is large, also those of similar groups.
    With too few windows the null is drawn from the measured noise instead. A group on which errors
    of the model act gains more by chance than others. So each gain is divided by what its own group
    gains by chance, before the largest counts.

    The columns of `hessian` (W, K, K) and `gradient` (W, K) are scaled to similar size. `groups`
    are those of the candidates `among`. They contain the columns `always`; gains are relative to a
    fit of these. `fold` (W,) is the cross-validation fold of each window, and `room` the lowest and
    highest change (K,) of each column.
    """
    if not groups:
        return []
    draws = limits.sign_draws
    folds = [(fold != f, fold == f) for f in np.unique(fold)]
    hessians = [(hessian[fitted].sum(0), hessian[tested].sum(0)) for fitted, tested in folds]
    unbounded = (np.full(len(gradient.T), -np.inf), np.full(len(gradient.T), np.inf))
    low, high = unbounded if room is None else room

    def fitted_change(hessian: np.ndarray, gradient: np.ndarray, places: list[int]) -> np.ndarray:
        ends, scale = (low[places], high[places]), np.ones(len(places))
        return solve(hessian[np.ix_(places, places)], gradient[places], *ends, scale)

    # In the loops below, one part of the windows is fitted and the other part (a fold) is tested.
    def gain(columns: tuple[int, ...]) -> float:
        total, places = 0.0, list(columns)
        for (fit_hessian, test_hessian), (fit_part, test_part) in zip(hessians, folds, strict=True):
            change = fitted_change(fit_hessian, gradient[fit_part].sum(0), places)
            slope = gradient[test_part].sum(0)[places]
            square = change @ test_hessian[np.ix_(places, places)] @ change
            total += float(2 * slope @ change - square)
        return total

    def gain_by_chance(columns: tuple[int, ...]) -> np.ndarray:
        total, places = np.zeros(draws), list(columns)
        for (fit_hessian, test_hessian), (fit_part, test_part) in zip(hessians, drawn, strict=True):
            chosen = np.ix_(places, places)
            fit_hessian, test_hessian = fit_hessian[chosen], test_hessian[chosen]
            damping = 1e-9 * np.diag(np.diag(fit_hessian)) + 1e-30 * np.eye(len(places))
            change = np.linalg.solve(fit_hessian + damping, fit_part[:, places].T).T
            slope = test_part[:, places]
            total += 2 * (slope * change).sum(1) - ((change @ test_hessian) * change).sum(1)
        return total

    without = gain(always)
    falls = [gain(group) - without for group in groups]
    rng = np.random.default_rng(seed)
    # Draws of the null: the gradient over the fitted and over the tested part of the windows.
    if len(fold) >= limits.few_windows:
        best = max(falls)
        share = limits.alike_share if best > limits.strong_gain else 1.0
        close = [g for g, fall in zip(groups, falls, strict=True) if fall >= share * best]
        places = sorted({column for group in close for column in group})
        change = fitted_change(hessian.sum(0), gradient.sum(0), places)
        unexplained = gradient - hessian[:, :, places] @ change
        signs = rng.choice([-1.0, 1.0], (draws, len(fold)))
        drawn = [(signs[:, i] @ unexplained[i], signs[:, o] @ unexplained[o]) for i, o in folds]
    else:
        # The covariance of the gradient by noise alone is the Hessian.
        values, vectors = np.linalg.eigh(hessian)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        noise = (root @ rng.standard_normal((draws, *gradient.shape, 1)))[..., 0]
        drawn = [(noise[:, i].sum(axis=1), noise[:, o].sum(axis=1)) for i, o in folds]
    own = np.stack([gain_by_chance(group) for group in groups]) - gain_by_chance(always)
    usual = np.maximum(np.quantile(own, 0.99, axis=1), limits.rival_chi2)
    null = (own / usual[:, None]).max(axis=0)
    scores = [
        CandidateScore(
            one, fall, _p_value(null >= fall / size), size * float(np.quantile(null, 0.99))
        )
        for one, fall, size in zip(among, falls, usual, strict=True)
    ]
    return sorted(scores, key=lambda s: -s.gain)


def _p_value(as_extreme: np.ndarray) -> float:
    """Return a p-value from draws of the null; `as_extreme` (D,) is true for those that count."""
    return float((1 + as_extreme.sum()) / (1 + len(as_extreme)))


def corrected_p_values(
    gains: Sequence[float],
    slope: np.ndarray,
    groups: Sequence[Sequence[int]],
    always: Sequence[int],
    variance_ratios: np.ndarray,
    rng: np.random.Generator,
) -> list[float]:
    """Return for each group the probability that the best of all groups gains as much by chance.

    `gains` are the falls of chi-square by each group, after the columns `always` are fitted.
    `slope` (F, 3, P) is the derivative of F flights' means by P parameters (columns), in units of
    independent noise. `variance_ratios` (D, 3) are draws of each axis's estimated variance over the
    true variance; if `rng` has drawn them, it must not be seeded again. The smallest possible
    p-value is 1 / (D + 1).
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
    pairs = zip(gains, groups, strict=True)
    return [_p_value(smallest <= chi2.sf(max(gain, 0.0), len(group))) for gain, group in pairs]


def _orthonormal_basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (M, R) of `columns` (M, K), each of unit length at most."""
    directions, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return directions[:, sizes > 1e-6]
