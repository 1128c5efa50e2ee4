"""Cross-validated gain of each candidate effect, and its p-value by a permutation test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.gauss_newton import NormalEquations, solve
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class CandidateScore(NamedTuple):
    """How much a candidate explains in addition to the effects named already."""

    candidate: Candidate
    gain: float
    """Fall of chi-square on windows that were left out of its fit, summed over the folds."""
    p_value: float
    """How often the best of all candidates gains as much on data of the null."""
    chance: float
    """Gain that the best of all candidates reaches on data of the null once in a hundred."""


def folds_of(flight: np.ndarray, start_s: np.ndarray, folds: int = THRESHOLDS.folds) -> np.ndarray:
    """Return each window's fold, (W,): windows are dealt out in turn along every flight.

    Whole flights are not left out: one flight alone may identify a parameter, as a chirp does a
    rate loop's gain.
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
    """Return the score of each of `among` when joined to the numbers at `named`, best first.

    `equations` are along all numbers, taken at `theta` (P,); windows of one `fold` (W,) are left
    out together; `seed` is of the null's draws.
    """
    along = list(equations.numbers)
    scale = space.array("step")[along]
    low, high = ((space.array(end) - theta)[along] / scale for end in ("low", "high"))
    hessian, gradient = equations.hessian * np.outer(scale, scale), equations.gradient * scale
    informed, columns = np.einsum("wjj->j", hessian), equations.columns_of
    seen = [c for c in among if informed[list(columns(c))].sum() > 1e-9]
    groups = [tuple(sorted({*named, *columns(c)})) for c in seen]
    gains, p_values, chance = permutation_test(
        hessian, gradient, groups, tuple(named), fold, seed, (low, high), limits
    )
    scores = [CandidateScore(*item, chance) for item in zip(seen, gains, p_values, strict=True)]
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
    """Return the gain of each group of columns over those `always`, its p-value, and chance's gain.

    The null is the largest gain of all groups under random signs of whole windows, which keeps the
    correlation within a window. What the best group explains (and groups nearly as good, where it
    explains much) is subtracted first (Freedman and Lane 1983): otherwise a real effect in a few
    windows would be part of the null. With too few windows the null is drawn from the measured
    noise instead. Chance's gain is the 99 % quantile of the null.

    Args:
        hessian: (W, K, K) of the normal equations, columns of like size.
        gradient: (W, K).
        groups: columns that are fitted together, those of `always` among them.
        always: columns that are fitted in any case.
        fold: (W,) windows of one number are left out together.
        seed: of the null's draws.
        room: (K,) lowest and highest change of each column; no bounds if not given.
        limits: draws, and what is alike or few.
    """
    if not groups:
        return [], [], 0.0
    draws = limits.sign_draws
    folds = [(fold != f, fold == f) for f in np.unique(fold)]
    hessians = [(hessian[i].sum(0), hessian[o].sum(0)) for i, o in folds]
    anywhere = (np.full(len(gradient.T), -np.inf), np.full(len(gradient.T), np.inf))
    low, high = anywhere if room is None else room

    def change(known: np.ndarray, pull: np.ndarray, at: list[int]) -> np.ndarray:
        return solve(known[np.ix_(at, at)], pull[at], low[at], high[at], np.ones(len(at)))

    def gain(columns: tuple[int, ...]) -> float:
        total, at = 0.0, list(columns)
        for (known, test), (inside, outside) in zip(hessians, folds, strict=True):
            moved = change(known, gradient[inside].sum(0), at)
            pull = gradient[outside].sum(0)[at]
            total += float(2 * pull @ moved - moved @ test[np.ix_(at, at)] @ moved)
        return total

    def gain_by_chance(columns: tuple[int, ...]) -> np.ndarray:
        total, at = np.zeros(draws), list(columns)
        if not at:
            return total
        for (known, test), (inside, outside) in zip(hessians, drawn, strict=True):
            known, test = known[np.ix_(at, at)], test[np.ix_(at, at)]
            damp = 1e-9 * np.diag(np.diag(known)) + 1e-30 * np.eye(len(at))
            moved = np.linalg.solve(known + damp, inside[:, at].T).T
            pull = outside[:, at]
            total += 2 * (pull * moved).sum(1) - ((moved @ test) * moved).sum(1)
        return total

    without = gain(always)
    falls = [gain(group) - without for group in groups]
    rng = np.random.default_rng(seed)
    if len(fold) >= limits.few_windows:
        best = max(falls)
        share = limits.alike_share if best > limits.strong_gain else 1.0
        alike = [g for g, fall in zip(groups, falls, strict=True) if fall >= share * best]
        at = sorted({column for group in alike for column in group})
        left = gradient - hessian[:, :, at] @ change(hessian.sum(0), gradient.sum(0), at)
        signs = rng.choice([-1.0, 1.0], (draws, len(fold)))
        drawn = [(signs[:, i] @ left[i], signs[:, o] @ left[o]) for i, o in folds]
    else:
        noise = _noise_like(hessian, draws, rng)
        drawn = [(noise[:, i].sum(axis=1), noise[:, o].sum(axis=1)) for i, o in folds]
    null = np.max([gain_by_chance(group) for group in groups], axis=0) - gain_by_chance(always)
    p_values = [float((1 + (null >= fall).sum()) / (1 + draws)) for fall in falls]
    return falls, p_values, float(np.quantile(null, 0.99))


def _noise_like(hessian: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Return draws (D, W, K) of what noise alone would give for the gradient."""
    values, vectors = np.linalg.eigh(hessian)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normal = rng.standard_normal((draws, *hessian.shape[:2], 1))
    return (root @ normal)[..., 0]
