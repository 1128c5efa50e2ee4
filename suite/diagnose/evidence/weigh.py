"""How a view's moments are weighed: what is left is the noise, and flights have trims of their own.

An unchanged vehicle flies each time with a slightly other trim, so that each flight's mean of each
axis is a draw of its own: a random effect (Laird and Ware 1982). Rows are made independent of it by
taking off a share of their flight's mean (quasi-demeaning; Fuller and Battese 1973). What all
flights are judged from is off by a draw, too, which is the same for all: there a share of the mean
of all goes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.gauss_newton import NormalEquations
from suite.diagnose.evidence.moments import ViewData, means_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class Weights(NamedTuple):
    """What a view's numbers are judged by."""

    scatter: np.ndarray
    """(3,) RMS of what is left within flights, by axis."""
    memory: np.ndarray
    """(3,) how many neighbouring moments tell as much as one that is independent."""
    trim: np.ndarray
    """(3,) standard deviation of flights' means; infinite where too few flights can tell."""
    base: np.ndarray | None = None
    """(3,) standard deviation of what all flights are judged from, where only their means count;
    None where that is known."""


def weights_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> Weights:
    """Return the weights that `data`, the best model's, ask for."""
    flights = [data.residual[data.flight == n] for n in np.unique(data.flight)]
    inside = [f - f.mean(axis=0) for f in flights]
    count = sum(len(f) for f in inside)
    power = np.sum([(f**2).sum(axis=0) for f in inside], axis=0)
    scatter = np.sqrt(power / max(count - len(inside), 1))
    scatter = np.maximum(scatter, 1e-6)
    memory = np.maximum(1.0, _memory(inside, limits))
    trim = np.full(3, np.inf)
    if len(flights) >= limits.least_flights:
        means = means_of(data.residual, data.flight)
        own = np.mean([scatter**2 * memory / len(f) for f in flights], axis=0)
        trim = np.sqrt(np.maximum(means.var(axis=0, ddof=1) - own, 0.0))
    return Weights(scatter, memory, trim)


def _memory(inside: list[np.ndarray], limits: Thresholds) -> np.ndarray:
    """Return the sum of the autocorrelation (3,), up to where it has fallen to nothing."""
    power = np.sum([(f**2).sum(axis=0) for f in inside], axis=0)
    total, alive = np.ones(3), np.ones(3, bool)
    for lag in range(1, limits.longest_memory):
        product = np.sum([(f[lag:] * f[:-lag]).sum(axis=0) for f in inside], axis=0)
        share = product / np.maximum(power, 1e-300)
        alive &= share > 0.05
        total += np.where(alive, 2.0 * share, 0.0)
        if not alive.any():
            break
    return total


def weighed(data: ViewData, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of `data` in units of independent noise."""
    residual, slope = data.residual.copy(), data.slope.copy()
    for number in np.unique(data.flight):
        rows = data.flight == number
        own = weights.scatter**2 * weights.memory / rows.sum()
        share = 1.0 - np.sqrt(own / (own + weights.trim**2))
        residual[rows] -= share * residual[rows].mean(axis=0)
        slope[rows] -= share[:, None] * slope[rows].mean(axis=0)
    if weights.base is not None:
        # Where flights' means tell nothing this is 0.
        own = weights.scatter**2 * weights.memory + weights.trim**2
        share = 1.0 - 1.0 / np.sqrt(1.0 + len(residual) * weights.base**2 / own)
        residual -= share * residual.mean(axis=0)
        slope -= share[:, None] * slope.mean(axis=0)
    unit = weights.scatter * np.sqrt(weights.memory)
    return residual / unit, slope / unit[:, None]


def blocks_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return the number of each moment's block (M,): stretches of a flight that stand apart."""
    inside = (data.middle_s / limits.view_block_s).astype(int)
    _, block = np.unique(np.stack([data.flight, inside]), axis=1, return_inverse=True)
    return block.ravel()


def equations_of(data: ViewData, weights: Weights, block: np.ndarray) -> NormalEquations:
    """Return the normal equations of each block of `data` along all numbers."""
    residual, slope = weighed(data, weights)
    hessian, gradient, chi2 = [], [], []
    for number in range(block.max() + 1):
        rows = block == number
        right, left = residual[rows].ravel(), slope[rows].reshape(-1, slope.shape[-1])
        hessian.append(left.T @ left)
        gradient.append(left.T @ right)
        chi2.append(right @ right)
    return NormalEquations(
        np.array(hessian), np.array(gradient), np.array(chi2), np.zeros((len(chi2), 12))
    )
