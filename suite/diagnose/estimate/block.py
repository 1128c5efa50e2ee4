"""Blocks: whitened residuals and Jacobians of stretches of flights, and their normal equations.

A stretch is a piece of a flight whose rows may be correlated. Whitened residuals are in units of
independent noise. Fit, intervals and search use blocks only. A number is one scalar parameter of
the vehicle model; all numbers form one vector (`estimate/parameters.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.parameters import Candidate


class Estimate(NamedTuple):
    """Values of all parameters: those of the vehicle model, and the nuisance parameters."""

    theta: np.ndarray
    """(P,) vector of the model's parameters."""
    free: np.ndarray = np.zeros((0, 0))
    """(B, F) nuisance parameters of B stretches, such as start states; (0, 0) without any."""


@dataclass(frozen=True)
class Block:
    """B stretches of M rows, linearised at one estimate, in units of independent noise.

    What nuisance parameters of a stretch could explain is projected out of its rows. Stretches with
    fewer rows are padded with zeros.
    """

    residual: np.ndarray
    """(B, M) residuals, measured - model."""
    slope: np.ndarray
    """(B, M, K) derivative of the model's values by K parameters."""
    along: tuple[int, ...]
    """Place of each column's parameter in the vector. A parameter without any effect at the present
    estimate may have a second column, at the end (see `search/evaluation.py`)."""
    flight: np.ndarray
    """(B,) number of each stretch's flight."""
    start_s: np.ndarray
    """(B,) start of each stretch, from the first row of the flight [s]."""
    free: np.ndarray
    """(B, F) change of the nuisance parameters that fits best, at the present parameters."""
    free_slope: np.ndarray
    """(B, F, K) decrease of `free` for a unit change of each of the K parameters."""

    @cached_property
    def equations(self) -> NormalEquations:
        """The normal equations of the stretches."""
        return normal_equations(self.slope, self.residual, self.flight, self.along)

    def acts(self) -> np.ndarray:
        """Return for each column (K,) whether its parameter changes the model at all."""
        return np.abs(self.slope).max(axis=(0, 1), initial=0.0) > 0.0


class NormalEquations(NamedTuple):
    """Terms of the normal equations of each of B stretches, along K parameters.

    J are the slopes of a block, and r its residuals.
    """

    hessian: np.ndarray
    """(B, K, K) J'J, the information on the parameters."""
    gradient: np.ndarray
    """(B, K) J'r."""
    chi2: np.ndarray
    """(B,) r'r, the squared error in units of the noise variance."""
    flight: np.ndarray | None = None
    """(B,) number of each stretch's flight."""
    along: tuple[int, ...] = ()
    """Place of each column's parameter in the vector."""

    def columns_of(self, candidate: Candidate) -> list[int]:
        """Return the columns of the parameters of `candidate`.

        A composite (several effects) uses the second column of a parameter that has two: that is
        computed as if the other effects were there.
        """
        place = {number: column for column, number in enumerate(self.along)}
        if not candidate.parts:
            place |= {number: self.along.index(number) for number in candidate.indices}
        return [place[number] for number in candidate.indices]

    def take(self, columns: Sequence[int]) -> NormalEquations:
        """Return the equations along `columns` only."""
        chosen = np.array(columns, dtype=int)
        return self._replace(
            hessian=self.hessian[:, chosen][:, :, chosen],
            gradient=self.gradient[:, chosen],
            along=tuple(self.along[k] for k in chosen),
        )

    def along_numbers(self, indices: Sequence[int]) -> NormalEquations:
        """Return the equations along the parameters at `indices` of the vector, in that order."""
        return self.take([self.along.index(number) for number in indices])

    def sums(self, inside: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return J'J (K, K) and J'r (K,), summed over all stretches or over those `inside`."""
        rows = slice(None) if inside is None else inside
        return self.hessian[rows].sum(axis=0), self.gradient[rows].sum(axis=0)

    def chi2_at(self, change: np.ndarray) -> np.ndarray:
        """Return the squared error (B,) of each stretch after a change (K,) or (B, K)."""
        change = np.broadcast_to(change, self.gradient.shape)
        quadratic = np.einsum("bi,bij,bj->b", change, self.hessian, change)
        return self.chi2 - 2.0 * (self.gradient * change).sum(axis=1) + quadratic


def normal_equations(
    slope: np.ndarray,
    residual: np.ndarray,
    flight: np.ndarray | None = None,
    along: tuple[int, ...] = (),
) -> NormalEquations:
    """Return the normal equations of `slope` (B, M, K) and `residual` (B, M).

    Without `along`, column k is along parameter k.
    """
    transposed, along = np.swapaxes(slope, 1, 2), along or tuple(range(slope.shape[2]))
    gradient = (transposed @ residual[..., None])[..., 0]
    return NormalEquations(transposed @ slope, gradient, (residual**2).sum(axis=1), flight, along)


def without_nuisance(
    residual: np.ndarray,
    slope: np.ndarray,
    along: Sequence[int],
    stretch: np.ndarray,
    flight: np.ndarray,
    start_s: np.ndarray,
) -> Block:
    """Return the block of rows that have no nuisance parameters, see `Block`.

    `residual` (R, C) and `slope` (R, C, K), of R rows and C channels, are divided by the noise.
    `stretch` (R,) is the number of each row's stretch: 0, 1, 2 and so on, none left out.
    """
    count, rows = len(flight), np.bincount(stretch)
    order = np.argsort(stretch, kind="stable")
    place_in_stretch = np.arange(len(stretch)) - np.repeat(np.cumsum(rows) - rows, rows)
    shape = (count, rows.max(initial=0) * residual.shape[1])

    def arranged(values: np.ndarray) -> np.ndarray:
        """Return `values` (R, C, ...) by stretch (B, M, ...), padded with zeros."""
        table = np.zeros((count, rows.max(initial=0), *values.shape[1:]))
        table[stretch[order], place_in_stretch] = values[order]
        return table.reshape(*shape, *values.shape[2:])

    free, free_slope = np.zeros((count, 0)), np.zeros((count, 0, slope.shape[2]))
    residual, slope = arranged(residual), arranged(slope)
    return Block(residual, slope, tuple(along), flight, start_s, free, free_slope)


def less_nuisance(nuisance: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return `values` (N, C, K) with independent noise again, to which nuisance parameters add.

    Nuisance parameters of unit variance change values of unit noise by `nuisance` (N, C, L), so
    their covariance is `1 + nuisance nuisance'`. Returned is its inverse root times the values.
    """
    flat, width = values.reshape(-1, values.shape[-1]), nuisance.shape[-1]
    basis, size, _ = np.linalg.svd(nuisance.reshape(-1, width), full_matrices=False)
    shrinkage = 1.0 / np.sqrt(1.0 + size**2) - 1.0
    return (flat + basis @ (shrinkage[:, None] * (basis.T @ flat))).reshape(values.shape)
