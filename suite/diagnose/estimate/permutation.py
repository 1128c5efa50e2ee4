"""Cross-validated gain of each candidate effect, and its p-value by a permutation test.

The gain is the fall of the squared error on stretches of flights that were left out of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.gauss_newton import NormalEquations, solve
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class CandidateScore(NamedTuple):
    """How much a candidate explains in addition to the effects that are already named."""

    candidate: Candidate
    gain: float
    """Fall of chi-square on windows that were left out of the fit, summed over the folds."""
    p_value: float
    """Probability that the best of all candidates gains as much under the null hypothesis."""
    chance: float
    """Gain that the best of all candidates reaches with 1 % probability under the null."""


def folds_of(flight: np.ndarray, start_s: np.ndarray, folds: int = THRESHOLDS.folds) -> np.ndarray:
    """Return the cross-validation fold (W,) of each window, in turn along every flight.

    Whole flights are not left out: one flight alone may identify a parameter, as a chirp does a
    rate loop's gain. `flight` (W,) is the number of each window's flight, `start_s` (W,) its start.
    """
    order = np.lexsort((start_s, flight))
    fold = np.empty(len(flight), int)
    fold[order] = np.arange(len(flight)) % folds
    return fold


def score_candidates(
    equations: NormalEquations,
    theta: np.ndarray,
    space: ParameterSpace,
    named: Sequence[int],
    among: Sequence[Candidate],
    fold: np.ndarray,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
) -> list[CandidateScore]:
    """Return the scores of candidates, each fitted with the `named` parameters, best first.

    Args:
        equations: along all parameters.
        theta: (P,) parameters at which they were computed.
        space: bounds of the parameters.
        named: places of the parameters that are always fitted.
        among: the candidates; those without any effect on the flights get no score.
        fold: (W,) cross-validation fold of each window.
        seed: of the draws.
        limits: numbers of draws.
    """
    along = list(equations.numbers)
    scale = space.array("step")[along]
    low, high = ((space.array(end) - theta)[along] / scale for end in ("low", "high"))
    hessian, gradient = equations.hessian * np.outer(scale, scale), equations.gradient * scale
    information, columns = np.einsum("wjj->j", hessian), equations.columns_of
    acting = [c for c in among if information[list(columns(c))].sum() > 1e-9]
    groups = [tuple(sorted({*named, *columns(c)})) for c in acting]
    gains, p_values, chance = permutation_test(
        hessian, gradient, groups, tuple(named), fold, seed, (low, high), limits
    )
    scores = [CandidateScore(*item, chance) for item in zip(acting, gains, p_values, strict=True)]
    return sorted(scores, key=lambda s: -s.gain)


def permutation_test(
    hessian: np.ndarray,
    gradient: np.ndarray,
    groups: Sequence[tuple[int, ...]],
    always: tuple[int, ...],
    fold: np.ndarray,
    seed: int,
    room: tuple[np.ndarray, np.ndarray] | None = None,
    limits: Thresholds = THRESHOLDS,
) -> tuple[list[float], list[float], float]:
    """Return for each group of columns its gain and p-value, and one gain that chance reaches.

    The null is the distribution of the largest gain of all groups under random signs of whole
    windows, which keep the correlation within a window. What the best group explains (and groups
    nearly as good, if it explains much) is subtracted first (Freedman and Lane 1983): otherwise a
    real effect in a few windows would be part of the null. With too few windows the null is drawn
    from the measured noise instead. The last value is the 99 % quantile of the null.

    Args:
        hessian: (W, K, K) of the normal equations, columns of similar size.
        gradient: (W, K).
        groups: columns that are fitted together, including those of `always`.
        always: columns that are always fitted; gains are relative to these alone.
        fold: (W,) cross-validation fold of each window.
        seed: of the draws.
        room: (K,) lowest and highest change of each column; no bounds if not given.
        limits: numbers of draws, and thresholds.
    """
    if not groups:
        return [], [], 0.0
    draws = limits.sign_draws
    folds = [(fold != f, fold == f) for f in np.unique(fold)]
    hessians = [(hessian[fitted].sum(0), hessian[tested].sum(0)) for fitted, tested in folds]
    unbounded = (np.full(len(gradient.T), -np.inf), np.full(len(gradient.T), np.inf))
    low, high = unbounded if room is None else room

    def fitted_change(hessian: np.ndarray, gradient: np.ndarray, at: list[int]) -> np.ndarray:
        return solve(hessian[np.ix_(at, at)], gradient[at], low[at], high[at], np.ones(len(at)))

    def gain(columns: tuple[int, ...]) -> float:
        total, at = 0.0, list(columns)
        for (known, test), (inside, outside) in zip(hessians, folds, strict=True):
            change = fitted_change(known, gradient[inside].sum(0), at)
            slope = gradient[outside].sum(0)[at]
            total += float(2 * slope @ change - change @ test[np.ix_(at, at)] @ change)
        return total

    def gain_by_chance(columns: tuple[int, ...]) -> np.ndarray:
        total, at = np.zeros(draws), list(columns)
        if not at:
            return total
        for (known, test), (inside, outside) in zip(hessians, drawn, strict=True):
            known, test = known[np.ix_(at, at)], test[np.ix_(at, at)]
            damping = 1e-9 * np.diag(np.diag(known)) + 1e-30 * np.eye(len(at))
            change = np.linalg.solve(known + damping, inside[:, at].T).T
            slope = outside[:, at]
            total += 2 * (slope * change).sum(1) - ((change @ test) * change).sum(1)
        return total

    without = gain(always)
    falls = [gain(group) - without for group in groups]
    rng = np.random.default_rng(seed)
    if len(fold) >= limits.few_windows:
        best = max(falls)
        share = limits.alike_share if best > limits.strong_gain else 1.0
        close = [g for g, fall in zip(groups, falls, strict=True) if fall >= share * best]
        at = sorted({column for group in close for column in group})
        change = fitted_change(hessian.sum(0), gradient.sum(0), at)
        unexplained = gradient - hessian[:, :, at] @ change
        signs = rng.choice([-1.0, 1.0], (draws, len(fold)))
        drawn = [(signs[:, i] @ unexplained[i], signs[:, o] @ unexplained[o]) for i, o in folds]
    else:
        noise = _noise_gradients(hessian, draws, rng)
        drawn = [(noise[:, i].sum(axis=1), noise[:, o].sum(axis=1)) for i, o in folds]
    null = np.max([gain_by_chance(group) for group in groups], axis=0) - gain_by_chance(always)
    p_values = [float((1 + (null >= fall).sum()) / (1 + draws)) for fall in falls]
    return falls, p_values, float(np.quantile(null, 0.99))


def _noise_gradients(hessian: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Return draws (D, W, K) of the gradient by noise alone."""
    values, vectors = np.linalg.eigh(hessian)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normal = rng.standard_normal((draws, *hessian.shape[:2], 1))
    return (root @ normal)[..., 0]
