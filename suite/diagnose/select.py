"""Which candidate lowers the error on data left out, and whether chance could do as well."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.evidence import Sums, solve
from suite.diagnose.parameters import Candidate, Space

FLIPS = 999
"""Draws of the null."""
FOLDS = 5
FEW = 10
"""Signs of fewer windows can be shuffled in too few ways for a p-value of 1 %."""


class Score(NamedTuple):
    """How much a candidate explains, beside what is named already."""

    candidate: Candidate
    gain: float
    """Fall of the error on windows that were left out of its fit, summed over the folds."""
    p_value: float
    """How often the best of all candidates gains as much on data of the null."""


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
    gains, p_values = compare(square, cross, groups, tuple(named), fold, seed, (low, high))
    scores = [Score(*item) for item in zip(seen, gains, p_values, strict=True)]
    return sorted(scores, key=lambda s: -s.gain)


def compare(
    square: np.ndarray,
    cross: np.ndarray,
    groups: Sequence[tuple[int, ...]],
    beside: tuple[int, ...],
    fold: np.ndarray,
    seed: int,
    room: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[list[float], list[float]]:
    """Return the gain of each group of columns over those `beside`, and its p-value.

    The null is the largest gain of all groups where the signs of whole windows are shuffled, which
    keeps all that is coloured within a window. Where there are fewer than `FEW` windows it is
    drawn from the measured noise instead.

    Args:
        square: (W, K, K) normal equations, columns of like size.
        cross: (W, K).
        groups: columns that are fitted together, those of `beside` among them.
        beside: columns that are fitted anyhow.
        fold: (W,) windows of one number are left out together.
        seed: of the null's draws.
        room: (K,) lowest and highest change of each column; no bounds if not given.
    """
    rng = np.random.default_rng(seed)
    if len(fold) >= FEW:
        drawn = rng.choice([-1.0, 1.0], (FLIPS, len(fold), 1)) * cross
    else:
        drawn = _noise_like(square, rng)
    folds = [(fold != f, fold == f) for f in np.unique(fold)]
    sums = [(square[i].sum(0), square[o].sum(0)) for i, o in folds]
    crosses = [(cross[i].sum(0), cross[o].sum(0)) for i, o in folds]
    nulls = [(drawn[:, i].sum(1), drawn[:, o].sum(1)) for i, o in folds]
    free = (np.full(len(cross.T), -np.inf), np.full(len(cross.T), np.inf))
    low, high = free if room is None else room

    def gains(columns: tuple[int, ...]) -> tuple[float, np.ndarray]:
        total, null, at = 0.0, np.zeros(FLIPS), list(columns)
        if not at:
            return total, null
        for (known, test), pull, chance in zip(sums, crosses, nulls, strict=True):
            known, test = known[np.ix_(at, at)], test[np.ix_(at, at)]
            change = solve(known, pull[0][at], low[at], high[at], np.ones(len(at)))
            total += float(2 * pull[1][at] @ change - change @ test @ change)
            damp = 1e-9 * np.diag(np.diag(known)) + 1e-30 * np.eye(len(at))
            changes = np.linalg.solve(known + damp, chance[0][:, at].T).T
            null += 2 * (chance[1][:, at] * changes).sum(1) - ((changes @ test) * changes).sum(1)
        return total, null

    without, null_without = gains(beside)
    found = [gains(group) for group in groups]
    best = np.max([null - null_without for _, null in found], axis=0, initial=-np.inf)
    falls = [gain - without for gain, _ in found]
    return falls, [float((1 + (best >= fall).sum()) / (1 + FLIPS)) for fall in falls]


def _noise_like(square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return draws (FLIPS, W, K) of what noise alone would give for `cross`."""
    values, vectors = np.linalg.eigh(square)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    draws = rng.standard_normal((FLIPS, *square.shape[:2], 1))
    return (root @ draws)[..., 0]
