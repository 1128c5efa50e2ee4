"""Least squares with intervals from how parts of flights, and flights, disagree.

Gauss and Newton with Huber's weights. A number's error is the jackknife of blocks of a flight (the
sandwich CR3; neighbouring windows are not independent), with Student's t of so many blocks. What
another fit gave is known no better than that fit says (Murphy and Topel 1985). Where the flights
differ by more than their blocks explain (Cochran's Q), the flights are the units and Student's t
their quantile. A number that the flights cannot tell is left as it was, the worst first, and the
others are fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

Z95 = 1.96
HUBER = 2.5
BLIND = 0.3
"""No interval is narrower than this share of what independent windows would make of it."""
TINY = 1e-12
"""Information below this is none."""
RIDGE = 1e-9
SMALL = 0.03
"""A step below this many standard deviations of every number is the last."""
ROUNDS = 12
DIFFER_P = 0.05
"""Flights differ where chance would make them do so more rarely than this."""
FEWEST = 3
"""Flights, to say that they differ."""


class NothingWhole(ValueError):
    """No stretch of the flights is whole enough to compare anything in."""


class Unknown(NamedTuple):
    """A number that is looked for."""

    name: str
    start: float
    low: float
    high: float
    room: float
    """It is told where its 95 % interval reaches less far than this to either side."""
    step: float
    """Of the finite differences."""
    floor: float = 0.0
    """How far the method itself is off where nothing is noisy, by simulation; added to the
    half-width in squares."""


class Rows(NamedTuple):
    """Residuals of one flight: N windows in C channels."""

    value: np.ndarray
    """(N, C) what is missed."""
    block: np.ndarray
    """(N,) number of the block."""
    level: np.ndarray
    """(C,) bool: a constant of the flight is free in these channels."""


Misses = Callable[[np.ndarray], Sequence[Rows]]
"""From all numbers to the residuals of every flight."""


class Given(NamedTuple):
    """Numbers that another fit has told; they are not looked for, and doubted as it doubts them."""

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
    """(P, P) behind the intervals; of what was left, the doubt about it."""
    untold: tuple[str, ...] = ()
    """Left as they were: these flights cannot tell them."""
    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(C,) root mean square of what is left in each channel."""
    given: tuple[str, ...] = ()
    """Told by another fit."""

    def has(self, name: str) -> bool:
        """Return whether this fit told the number."""
        looked_for = any(u.name == name for u in self.unknowns)
        return looked_for and name not in (*self.untold, *self.given)

    def give(self, *names: str) -> Given:
        """Return those of `names` that are there, for a fit that is built on them."""
        there = [k for k, unknown in enumerate(self.unknowns) if unknown.name in names]
        told = tuple(self.unknowns[k].name for k in there)
        return Given(told, self.covariance[np.ix_(there, there)])

    def index(self, name: str) -> int:
        """Return where the number is."""
        return [u.name for u in self.unknowns].index(name)


def fit(
    misses: Misses,
    unknowns: Sequence[Unknown],
    held: Sequence[str] = (),
    given: Given | None = None,
) -> Fitted:
    """Return the numbers that make `misses` least, with intervals.

    What is left as it was may be wrong by its `room`; that is part of the others' intervals.

    Args:
        misses: the residuals.
        unknowns: the numbers.
        held: those that are left as they are from the first.
        given: those of `unknowns` that another fit has told.

    Raises:
        NothingWhole: where there is not one window.
    """
    unknowns, untold, given = tuple(unknowns), list(held), given or Given()
    value = np.array([unknown.start for unknown in unknowns])
    if not sum(len(rows.value) for rows in misses(value)):
        raise NothingWhole("no stretch of these flights is whole enough to compare anything in")
    while True:
        left = (*untold, *given.names)
        free = [k for k, unknown in enumerate(unknowns) if unknown.name not in left]
        value = _least(misses, unknowns, value, free)
        covariance, half = _errors(misses, unknowns, value, free, given)
        ratio = [half[k] / unknowns[k].room for k in free]
        if not free or max(ratio) <= 1.0:
            break
        worst = free[int(np.argmax(ratio))]
        untold.append(unknowns[worst].name)
        value[worst] = unknowns[worst].start
    misfit = _left(misses, unknowns, value)
    return Fitted(unknowns, value, half, covariance, tuple(untold), misfit, given.names)


def _levelled(rows: Rows) -> np.ndarray:
    mean = np.median(rows.value, axis=0) if len(rows.value) else np.zeros(rows.value.shape[1])
    return rows.value - np.where(rows.level, mean, 0.0)


def _weights(misses: Sequence[Rows]) -> list[np.ndarray]:
    """Return the weights (N, C) of every flight: over a channel's noise, less for what is wild."""
    off = np.concatenate([np.abs(_levelled(rows)) for rows in misses])
    sigma = np.maximum(1.4826 * np.median(off, axis=0), 1e-9)
    weights = []
    for rows in misses:
        far = np.abs(_levelled(rows)) / sigma
        weights.append(np.minimum(1.0, HUBER / np.maximum(far, 1e-9)) / sigma**2)
    return weights


def _freed(values: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return values (N, C, ...) less their weighted mean in channels with a free constant."""
    weight = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
    total = np.maximum(weight.sum(axis=0), 1e-12)
    mean = (weight * values).sum(axis=0) / total
    level = level.reshape(level.shape + (1,) * (values.ndim - 2))
    return values - np.where(level, mean, 0.0)


def _slopes(
    misses: Misses, unknowns: Sequence[Unknown], value: np.ndarray, free: Sequence[int]
) -> list[np.ndarray]:
    """Return the slopes (N, C, F) of every flight's residuals along the free numbers."""
    columns: list[list[np.ndarray]] = []
    here = misses(value)
    for k in free:
        # Away from the nearer limit.
        near_top = unknowns[k].high - value[k] < unknowns[k].step
        step = -unknowns[k].step if near_top else unknowns[k].step
        there = value.copy()
        there[k] += step
        both = zip(misses(there), here, strict=True)
        columns.append([(a.value - b.value) / step for a, b in both])
    return [np.stack([column[f] for column in columns], axis=-1) for f in range(len(here))]


def _least(
    misses: Misses, unknowns: Sequence[Unknown], value: np.ndarray, free: Sequence[int]
) -> np.ndarray:
    if not free:
        return value
    low = np.array([unknowns[k].low for k in free])
    high = np.array([unknowns[k].high for k in free])
    value = value.copy()
    for _ in range(ROUNDS):
        rows = misses(value)
        weights = _weights(rows)
        slopes = _slopes(misses, unknowns, value, free)
        square, pull = _normal(rows, weights, slopes)
        scale = np.sqrt(np.maximum(np.diag(square), TINY))
        change = -np.linalg.lstsq(square / np.outer(scale, scale), pull / scale, rcond=1e-9)[0]
        change = change / scale
        before = _cost(rows, weights)
        for _ in range(8):
            trial = value.copy()
            trial[list(free)] = np.clip(value[list(free)] + change, low, high)
            if _cost(misses(trial), weights) <= before * (1.0 + 1e-12):
                break
            change = 0.5 * change
        else:
            break
        moved = np.abs(trial - value)[list(free)] * scale
        value = trial
        if moved.max() < SMALL:
            break
    return value


def _cost(rows: Sequence[Rows], weights: Sequence[np.ndarray]) -> float:
    return float(
        sum(
            (w * _freed(r.value, w, r.level) ** 2).sum() for r, w in zip(rows, weights, strict=True)
        )
    )


def _normal(
    rows: Sequence[Rows], weights: Sequence[np.ndarray], slopes: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    count = slopes[0].shape[-1]
    square, pull = np.zeros((count, count)), np.zeros(count)
    for row, weight, slope in zip(rows, weights, slopes, strict=True):
        off, along = _freed(row.value, weight, row.level), _freed(slope, weight, row.level)
        square += np.einsum("nc,nci,ncj->ij", weight, along, along)
        pull += np.einsum("nc,nci,nc->i", weight, along, off)
    return square, pull


def _errors(
    misses: Misses,
    unknowns: Sequence[Unknown],
    value: np.ndarray,
    free: Sequence[int],
    given: Given,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance (P, P) and the half-widths (P,)."""
    from scipy.stats import chi2, t

    total = len(unknowns)
    half = np.full(total, np.nan)
    if not free:
        return np.diag([unknown.room**2 for unknown in unknowns]), half
    names = [unknown.name for unknown in unknowns]
    told, taken = list(free), [names.index(name) for name in given.names]
    free = [k for k in range(total) if k not in taken]
    rows, slopes = misses(value), _slopes(misses, unknowns, value, range(total))
    weights = _weights(rows)
    whole, _ = _normal(rows, weights, slopes)
    square = whole[np.ix_(free, free)]
    slopes = [slope[..., free] for slope in slopes]
    doubt = np.array([0.0 if k in told else 1.0 / unknowns[k].room ** 2 for k in free])
    square = square + np.diag(doubt)
    scale = np.sqrt(np.maximum(np.diag(square), TINY))
    # The ridge makes what cannot be told apart wide, where a pseudo-inverse would hide it.
    ridge = RIDGE * np.eye(len(free))
    inverse = np.linalg.inv(square / np.outer(scale, scale) + ridge) / np.outer(scale, scale)
    by_flight = []
    for row, weight, slope in zip(rows, weights, slopes, strict=True):
        off, along = _freed(row.value, weight, row.level), _freed(slope, weight, row.level)
        each = []
        for number in np.unique(row.block):
            w, a, o = (part[row.block == number] for part in (weight, along, off))
            # What all others say of the numbers: a block with much to say fits itself.
            others = square - np.einsum("nc,nci,ncj->ij", w, a, a)
            others = np.linalg.inv(others / np.outer(scale, scale) + ridge)
            others = others / np.outer(scale, scale)
            each.append(others @ np.einsum("nc,nci,nc->i", w, a, o))
        by_flight.append(np.array(each).reshape(-1, len(free)))
    influence = np.concatenate(by_flight)
    blocks = influence.T @ influence + inverse @ np.diag(doubt) @ inverse
    sums = np.array([each.sum(axis=0) for each in by_flight])
    flights = [k for k, each in enumerate(by_flight) if len(each)]
    # With few blocks their spread is itself not well known (Bell and McCaffrey 2002).
    quantile = float(t.ppf(0.975, max(len(influence) - 1, 1)))
    widest = quantile * np.sqrt(np.maximum(np.diag(blocks), 0.0))
    if len(flights) >= FEWEST:
        spread = np.array([(each**2).sum(axis=0) for each in by_flight])[flights]
        q = (sums[flights] ** 2 / np.maximum(spread, 1e-300)).sum(axis=0)
        between = len(flights) / (len(flights) - 1) * (sums[flights] ** 2).sum(axis=0)
        wide = float(t.ppf(0.975, len(flights) - 1)) * np.sqrt(between)
        differ = chi2.sf(q, len(flights) - 1) < DIFFER_P
        widest = np.where(differ, np.maximum(widest, wide), widest)
    # What white noise of this size makes of it: where that is far more, the equations are blind.
    widest = np.maximum(widest, BLIND * Z95 * np.sqrt(np.diag(inverse)))
    most = np.array([np.inf if k in told else Z95 * unknowns[k].room for k in free])
    widest = np.minimum(widest, most)
    # The method's own errors are no part of what the noise makes alike in two numbers.
    floor = np.array([unknowns[k].floor for k in free])
    floor = np.minimum(floor, np.sqrt(most**2 - widest**2))
    sd = np.sqrt(np.diag(blocks))
    alike = blocks / np.maximum(np.outer(sd, sd), 1e-30)
    np.fill_diagonal(alike, 1.0)
    # What was given moves the numbers by so much.
    follow = inverse @ whole[np.ix_(free, taken)]
    noise = (alike * np.outer(widest, widest) + np.diag(floor**2)) / Z95**2
    found = noise + follow @ given.covariance @ follow.T
    covariance = np.zeros((total, total))
    covariance[np.ix_(free, free)] = found
    covariance[np.ix_(taken, taken)] = given.covariance
    half[told] = Z95 * np.sqrt(np.diag(covariance)[told])
    return covariance, half


def _left(misses: Misses, unknowns: Sequence[Unknown], value: np.ndarray) -> np.ndarray:
    rows = misses(value)
    left = np.concatenate([_levelled(row) for row in rows])
    return np.sqrt(np.mean(left**2, axis=0))
