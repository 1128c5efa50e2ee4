"""Which candidate lowers the error on data left out, and whether chance could do as well."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.evidence import Sums, solve
from suite.diagnose.parameters import Candidate, Space

FLIPS = 999
"""Draws of the null."""


class Score(NamedTuple):
    """How much a candidate explains, beside what is named already."""

    candidate: Candidate
    gain: float
    """Fall of the error on windows that were left out of its fit, summed over the folds."""
    p_value: float
    """How often the best of all candidates gains as much on data whose signs were shuffled."""


def folds_of(flight: np.ndarray, start_s: np.ndarray) -> np.ndarray:
    """Return each window's fold: its flight, or a quarter of the time where flights are few."""
    flights = np.unique(flight)
    if len(flights) >= 3:
        return np.searchsorted(flights, flight) % 6
    order = np.lexsort((start_s, flight))
    fold = np.empty(len(flight), int)
    fold[order] = np.arange(len(flight)) * 4 // max(len(flight), 1)
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
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (FLIPS, len(fold)))
    low, high, scale = (space.array(name) for name in ("low", "high", "step"))
    folds = [(fold != f, fold == f) for f in np.unique(fold)]

    def gains(at: list[int]) -> tuple[float, np.ndarray]:
        """Return the true gain and those of the null, (FLIPS,)."""
        total, null = 0.0, np.zeros(FLIPS)
        if not at:
            return total, null
        square = sums.square[:, at][:, :, at]
        cross = sums.cross[:, at]
        for inside, outside in folds:
            known, test = square[inside].sum(0), square[outside].sum(0)
            change = solve(
                known, cross[inside].sum(0), low[at] - theta[at], high[at] - theta[at], scale[at]
            )
            total += float(2 * cross[outside].sum(0) @ change - change @ test @ change)
            right = signs[:, inside] @ cross[inside]
            damp = 1e-9 * np.diag(np.diag(known)) + 1e-30 * np.eye(len(at))
            changes = np.linalg.solve(known + damp, right.T).T
            fall = 2 * ((signs[:, outside] @ cross[outside]) * changes).sum(1)
            null += fall - np.einsum("fi,ij,fj->f", changes, test, changes)
        return total, null

    without, null_without = gains(list(named))
    found, nulls = [], []
    for candidate in among:
        at = sorted({*named, *candidate.indices})
        if (
            float(np.trace(sums.square[:, candidate.indices][:, :, candidate.indices].sum(0)))
            < 1e-9
        ):
            continue
        gain, null = gains(at)
        found.append((gain - without, candidate))
        nulls.append(null - null_without)
    best = np.max(nulls, axis=0) if nulls else np.zeros(FLIPS)
    scores = [
        Score(candidate, gain, float((1 + (best >= gain).sum()) / (1 + FLIPS)))
        for gain, candidate in found
    ]
    return sorted(scores, key=lambda s: -s.gain)
