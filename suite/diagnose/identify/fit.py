"""Robust least squares for `suite identify`; parameters that are not identifiable stay unchanged.

Gauss-Newton with Huber's weights on residuals of flights; intervals by stretches and flights. What
another fit has estimated is held fixed with that fit's covariance (Murphy and Topel 1985). The
least identifiable parameter is set back to its start, and the others are fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.block import Block, Estimate, without_nuisance
from suite.diagnose.estimate.gauss_newton import Z95, intervals95
from suite.diagnose.estimate.gauss_newton import fit as fit_numbers
from suite.diagnose.estimate.parameters import FittedNumber, ParameterSpace
from suite.diagnose.thresholds import THRESHOLDS

HUBER = 2.5
BLIND = 0.3
"""No interval is narrower than this share of what independent windows would make of it."""
LIMITS = replace(THRESHOLDS, converged=1e-3)
"""A step below 0.03 standard deviations is the last."""
ROUNDS = 6
"""Of weights, each for some steps."""
DIFFER_P = 0.05
"""Flights differ where chance would make them do so more rarely than this."""


class NothingWhole(ValueError):
    """No stretch of the flights is whole enough to compare anything in."""


class Unknown(NamedTuple):
    """A number that is fitted."""

    name: str
    start: float
    low: float
    high: float
    room: float
    """Largest half-width of its 95 % interval with which it counts as identified."""
    step: float
    """Of the finite differences."""
    floor: float = 0.0
    """Error of the method itself on flights without noise, by simulation; added to the half-width
    in squares."""


class Rows(NamedTuple):
    """Residuals of one flight: N windows in C channels."""

    value: np.ndarray
    """(N, C) measured less modelled."""
    block: np.ndarray
    """(N,) number of the block."""
    level: np.ndarray
    """(C,) bool: a constant of the flight is free in these channels."""


Residuals = Callable[[np.ndarray], Sequence[Rows]]
"""From all numbers to the residuals of every flight."""


class Known(NamedTuple):
    """Parameters that another fit has identified, held fixed, with that fit's covariance."""

    names: tuple[str, ...] = ()
    covariance: np.ndarray = np.zeros((0, 0))
    """Of these."""


@dataclass(frozen=True)
class Fitted:
    """What a fit found."""

    unknowns: tuple[Unknown, ...]
    value: np.ndarray
    """(P,) of all numbers."""
    half_width: np.ndarray
    """(P,) of the 95 % interval; NaN where the number was left as it was."""
    covariance: np.ndarray
    """(P, P) behind the intervals; of what was left, its prior variance."""
    not_identified: tuple[str, ...] = ()
    """Left as they were: not identifiable from these flights."""
    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(C,) root mean square of what is left in each channel."""
    known: tuple[str, ...] = ()
    """Identified by another fit."""

    def has(self, name: str) -> bool:
        """Return whether this fit identified the number."""
        fitted = any(u.name == name for u in self.unknowns)
        return fitted and name not in (*self.not_identified, *self.known)

    def as_known(self, *names: str) -> Known:
        """Return those of `names` that are there, for a fit that is built on them."""
        there = [k for k, unknown in enumerate(self.unknowns) if unknown.name in names]
        found = tuple(self.unknowns[k].name for k in there)
        return Known(found, self.covariance[np.ix_(there, there)])

    def index(self, name: str) -> int:
        """Return where the number is."""
        return [u.name for u in self.unknowns].index(name)


@dataclass(frozen=True)
class ResidualEvidence:
    """Residuals of flights as a source for Gauss-Newton: `estimate.block.Linearised`."""

    residuals: Residuals
    unknowns: tuple[Unknown, ...]
    weights: tuple[np.ndarray, ...] = ()
    """By flight, (N, C)."""

    @property
    def space(self) -> ParameterSpace:
        """The numbers."""
        entries = (
            FittedNumber("", u.name, None, u.low, u.high, u.start, u.step) for u in self.unknowns
        )
        return ParameterSpace(tuple(entries), {})

    def at(self, value: np.ndarray) -> Estimate:
        """Return the estimate with the numbers `value` (P,): nothing else is free."""
        return Estimate(value, np.zeros((0, 0)))

    def weighed(self, at: Estimate) -> ResidualEvidence:
        """Return this weighted by each channel's noise, and less for outliers (Huber 1964)."""
        rows = self.residuals(at.theta)
        off = np.concatenate([np.abs(_levelled(row)) for row in rows])
        sigma = np.maximum(1.4826 * np.median(off, axis=0), 1e-9)
        far = (np.maximum(np.abs(_levelled(row)) / sigma, 1e-9) for row in rows)
        weights = tuple(np.minimum(1.0, HUBER / one) / sigma**2 for one in far)
        return replace(self, weights=weights)

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return residuals and slopes, by finite differences away from the nearer limit."""
        along = range(len(self.unknowns)) if indices is None else indices
        here, columns = self.residuals(at.theta), []
        for k in along:
            near_top = self.unknowns[k].high - at.theta[k] < self.unknowns[k].step
            step = -self.unknowns[k].step if near_top else self.unknowns[k].step
            there = at.theta.copy()
            there[k] += step
            pairs = zip(self.residuals(there), here, strict=True)
            columns.append([(a.value - b.value) / step for a, b in pairs])
        values, slopes, numbers = [], [], []
        for flight, (row, weight) in enumerate(zip(here, self.weights, strict=True)):
            every = [row.value, *(-column[flight] for column in columns)]
            freed = _freed(np.stack(every, axis=-1), weight, row.level)
            white = np.sqrt(weight)[..., None] * freed
            values.append(white[..., 0])
            slopes.append(white[..., 1:])
            numbers.append(np.stack([np.full(len(row.block), flight), row.block]))
        places, stretch = np.unique(np.concatenate(numbers, axis=1), axis=1, return_inverse=True)
        rows = np.concatenate(values), np.concatenate(slopes)
        return without_nuisance(*rows, along, stretch.ravel(), places[0], places[1].astype(float))


def fit(
    residuals: Residuals,
    unknowns: Sequence[Unknown],
    held: Sequence[str] = (),
    known: Known | None = None,
) -> Fitted:
    """Return the parameters that minimise `residuals`, with intervals.

    A parameter that is not identifiable may be wrong by its `room`; the others' intervals include
    that.

    Args:
        residuals: the residuals.
        unknowns: the numbers.
        held: those that are left as they are from the first.
        known: those of `unknowns` that another fit has identified.

    Raises:
        NothingWhole: where there is not one window.
    """
    not_identified, known = list(held), known or Known()
    evidence = ResidualEvidence(residuals, tuple(unknowns))
    at = evidence.at(np.array([unknown.start for unknown in unknowns]))
    if not sum(len(rows.value) for rows in residuals(at.theta)):
        raise NothingWhole("no stretch of these flights is whole enough to compare anything in")
    while True:
        left = (*not_identified, *known.names)
        free = [k for k, unknown in enumerate(unknowns) if unknown.name not in left]
        for _ in range(ROUNDS if free else 0):
            before, evidence = at, evidence.weighed(at)
            at, _ = fit_numbers(evidence, at, free, limits=LIMITS)
            if (at.theta == before.theta).all():
                break
        covariance, half = _errors(evidence.weighed(at), at, free, known)
        ratio = [half[k] / unknowns[k].room for k in free]
        if not free or max(ratio) <= 1.0:
            break
        worst = free[int(np.argmax(ratio))]
        not_identified.append(unknowns[worst].name)
        at.theta[worst] = unknowns[worst].start
    misfit = np.concatenate([_levelled(row) for row in residuals(at.theta)])
    rms = np.sqrt(np.mean(misfit**2, axis=0))
    return Fitted(
        evidence.unknowns, at.theta, half, covariance, tuple(not_identified), rms, known.names
    )


def _levelled(rows: Rows) -> np.ndarray:
    mean = np.median(rows.value, axis=0) if len(rows.value) else np.zeros(rows.value.shape[1])
    return rows.value - np.where(rows.level, mean, 0.0)


def _freed(values: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return values (N, C, K) less their weighted mean in channels with a free constant."""
    total = np.maximum(weight.sum(axis=0), 1e-12)[:, None]
    mean = (weight[..., None] * values).sum(axis=0) / total
    return values - np.where(level[:, None], mean, 0.0)


def _errors(
    evidence: ResidualEvidence, at: Estimate, free: Sequence[int], known: Known
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance (P, P) and the half-widths (P,) of what is `free`."""
    unknowns = evidence.unknowns
    total, names = len(unknowns), [unknown.name for unknown in unknowns]
    half = np.full(total, np.nan)
    if not free:
        return np.diag([unknown.room**2 for unknown in unknowns]), half
    taken = [names.index(name) for name in known.names]
    others = [k for k in range(total) if k not in taken]
    equations = evidence.linearise(at).equations
    prior = np.array([0.0 if k in free else 1.0 / unknowns[k].room ** 2 for k in others])
    found = intervals95(equations.take(others), DIFFER_P, True, BLIND, prior)
    most = np.array([np.inf if k in free else Z95 * unknowns[k].room for k in others])
    widest = np.minimum(found.half_width, most)
    # The method's own errors are no part of what the noise makes alike in two numbers.
    floor = np.array([unknowns[k].floor for k in others])
    floor = np.minimum(floor, np.sqrt(most**2 - widest**2))
    sd = np.sqrt(np.diag(found.by_stretch))
    alike = found.by_stretch / np.maximum(np.outer(sd, sd), 1e-30)
    np.fill_diagonal(alike, 1.0)
    # What is known moves the numbers by so much.
    follow = found.inverse @ equations.sums()[0][np.ix_(others, taken)]
    noise = (alike * np.outer(widest, widest) + np.diag(floor**2)) / Z95**2
    covariance = np.zeros((total, total))
    covariance[np.ix_(others, others)] = noise + follow @ known.covariance @ follow.T
    covariance[np.ix_(taken, taken)] = known.covariance
    half[list(free)] = Z95 * np.sqrt(np.diag(covariance)[list(free)])
    return covariance, half
