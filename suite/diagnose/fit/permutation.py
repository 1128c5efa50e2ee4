"""Which candidate lowers the error on data left out, and whether chance could do as well."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.fit.normal_equations import Sums, solve
from suite.diagnose.fit.parameters import Candidate, Space

FLIPS = 1999
"""Draws of the null."""
FOLDS = 5
LOUD = 50.0
"""A gain that noise never has: what else explains as much as the best is no chance either."""
ALIKE = 0.5
"""Share of the best gain from which a group explains about as much."""
FEW = 10
"""Signs of fewer windows can be shuffled in too few ways for a p-value of 1 %."""


class Score(NamedTuple):
    """How much a candidate explains, beside what is named already."""

    candidate: Candidate
    gain: float
    """Fall of the error on windows that were left out of its fit, summed over the folds."""
    p_value: float
    """How often the best of all candidates gains as much on data of the null."""
    chance: float
    """Gain that the best of all candidates reaches on data of the null once in a hundred."""


def folds_of(flight: np.ndarray, start_s: np.ndarray) -> np.ndarray:
    """Return each window's fold, (W,): windows are dealt out in turn along every flight.

    Leaving out whole flights would ask the others for what only one of them can show, as a chirp
    alone shows a rate loop's gain.
    """
    order = np.lexsort((start_s, flight))
    fold = np.empty(len(flight), int)
    fold[order] = np.arange(len(flight)) % FOLDS
    return fold


def score(
    sums: Sums,
    theta: np.ndarray,
    space: Space,
    named: Sequence[int],
    among: Sequence[Candidate],
    fold: np.ndarray,
    seed: int = 0,
) -> list[Score]:
    """Return the score of each of `among` when joined to the numbers `named`, best first.

    Args:
        sums: along all numbers at `theta`.
        theta: (P,) where the sums were taken.
        space: bounds.
        named: places of the numbers that are fitted along.
        among: the candidates.
        fold: (W,) windows of one number are left out together.
        seed: of the null's draws.
    """
    scale = space.array("step")
    low, high = (space.array("low") - theta) / scale, (space.array("high") - theta) / scale
    square, cross = sums.square * np.outer(scale, scale), sums.cross * scale
    seen = [c for c in among if np.einsum("wjj->j", square)[list(c.indices)].sum() > 1e-9]
    groups = [tuple(sorted({*named, *c.indices})) for c in seen]
    found = compare(square, cross, groups, tuple(named), fold, seed, (low, high))
    gains, p_values, chance = found
    scores = [Score(*item, chance) for item in zip(seen, gains, p_values, strict=True)]
    return sorted(scores, key=lambda s: -s.gain)


def compare(
    square: np.ndarray,
    cross: np.ndarray,
    groups: Sequence[tuple[int, ...]],
    beside: tuple[int, ...],
    fold: np.ndarray,
    seed: int,
    room: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[list[float], list[float], float]:
    """Return the gain of each group of columns over those `beside`, its p-value, and chance's gain.

    The null is the largest gain of all groups where the signs of whole windows are shuffled, which
    keeps all that is coloured within a window. What the best group explains, with those that are
    nearly as good where it is much, is taken off before (Freedman and Lane 1983): a real effect
    that a few windows show would otherwise stand in the null as well. Where there are fewer than
    `FEW` windows the null is drawn from the measured noise instead. Chance's gain is what one draw
    in a hundred exceeds.

    Args:
        square: (W, K, K) normal equations, columns of like size.
        cross: (W, K).
        groups: columns that are fitted together, those of `beside` among them.
        beside: columns that are fitted anyhow.
        fold: (W,) windows of one number are left out together.
        seed: of the null's draws.
        room: (K,) lowest and highest change of each column; no bounds if not given.
    """
    folds = [(fold != f, fold == f) for f in np.unique(fold)]
    sums = [(square[i].sum(0), square[o].sum(0)) for i, o in folds]
    free = (np.full(len(cross.T), -np.inf), np.full(len(cross.T), np.inf))
    low, high = free if room is None else room

    def change(known: np.ndarray, pull: np.ndarray, at: list[int]) -> np.ndarray:
        return solve(known[np.ix_(at, at)], pull[at], low[at], high[at], np.ones(len(at)))

    def gain(columns: tuple[int, ...]) -> float:
        total, at = 0.0, list(columns)
        for (known, test), (inside, outside) in zip(sums, folds, strict=True):
            moved = change(known, cross[inside].sum(0), at)
            pull = cross[outside].sum(0)[at]
            total += float(2 * pull @ moved - moved @ test[np.ix_(at, at)] @ moved)
        return total

    def chance(columns: tuple[int, ...]) -> np.ndarray:
        total, at = np.zeros(FLIPS), list(columns)
        if not at:
            return total
        for (known, test), (inside, outside) in zip(sums, drawn, strict=True):
            known, test = known[np.ix_(at, at)], test[np.ix_(at, at)]
            damp = 1e-9 * np.diag(np.diag(known)) + 1e-30 * np.eye(len(at))
            moved = np.linalg.solve(known + damp, inside[:, at].T).T
            pull = outside[:, at]
            total += 2 * (pull * moved).sum(1) - ((moved @ test) * moved).sum(1)
        return total

    if not groups:
        return [], [], 0.0
    without = gain(beside)
    falls = [gain(group) - without for group in groups]
    rng = np.random.default_rng(seed)
    if len(fold) >= FEW:
        best = max(falls)
        share = ALIKE if best > LOUD else 1.0
        alike = [g for g, fall in zip(groups, falls, strict=True) if fall >= share * best]
        at = sorted({column for group in alike for column in group})
        left = cross - square[:, :, at] @ change(square.sum(0), cross.sum(0), at)
        signs = rng.choice([-1.0, 1.0], (FLIPS, len(fold)))
        drawn = [(signs[:, i] @ left[i], signs[:, o] @ left[o]) for i, o in folds]
    else:
        noise = _noise_like(square, rng)
        drawn = [(noise[:, i].sum(axis=1), noise[:, o].sum(axis=1)) for i, o in folds]
    null = np.max([chance(group) for group in groups], axis=0) - chance(beside)
    p_values = [float((1 + (null >= fall).sum()) / (1 + FLIPS)) for fall in falls]
    return falls, p_values, float(np.quantile(null, 0.99))


def _noise_like(square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return draws (FLIPS, W, K) of what noise alone would give for `cross`."""
    values, vectors = np.linalg.eigh(square)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    draws = rng.standard_normal((FLIPS, *square.shape[:2], 1))
    return (root @ draws)[..., 0]
