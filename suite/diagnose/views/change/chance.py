"""How often chance alone makes the best of all candidates stand out as much.

Candidates of a handful of flights' means are nearly one another's likeness, so that Bonferroni's
factor, their number, would hide what is there. The least p-value of all of them is drawn instead,
on data of the null (Westfall and Young 1993).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2


def chance_of(
    gains: Sequence[float],
    slope: np.ndarray,
    groups: Sequence[Sequence[int]],
    beside: Sequence[int],
    sizes: np.ndarray,
    rng: np.random.Generator,
) -> list[float]:
    """Return how often any group gains as much by chance, for the gain of each.

    Args:
        gains: falls of chi-square by each group of columns beside those of `beside`.
        slope: (F, 3, P) of flights' means along all columns, in units of independent noise.
        groups: columns that are fitted together.
        beside: columns that are fitted anyhow.
        sizes: (D, 3) draws of the estimate of each axis's variance over the true one; the smallest
            p-value is one in as many.
        rng: of the noise; what `sizes` were drawn by may go on, but not begin again.
    """
    draws = len(sizes)
    noise = rng.standard_normal((draws, len(slope), 3))
    noise = (noise / np.sqrt(sizes)[:, None]).reshape(draws, -1)
    slope = slope.reshape(-1, slope.shape[-1])
    slope = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    known = _directions(slope[:, list(beside)])
    free = slope - known @ (known.T @ slope)
    least = np.ones(draws)
    for group in groups:
        told = ((noise @ _directions(free[:, list(group)])) ** 2).sum(axis=1)
        least = np.minimum(least, _alone(told, len(group)))
    return [
        float((1 + (least <= _alone(max(gain, 0.0), len(group))).sum()) / (1 + draws))
        for gain, group in zip(gains, groups, strict=True)
    ]


def _alone(gain: np.ndarray | float, size: int) -> np.ndarray:
    """Return how unusual the gain of a group of `size` columns is, to set groups side by side."""
    return chi2.sf(gain, size)


def _directions(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (M, R) of what `columns` (M, K), of unit size or none, span."""
    left, value, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, value > 1e-6]
