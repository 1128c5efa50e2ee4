"""Robust least squares for `suite identify`; numbers that are not identifiable keep their start.

A number is a fitted parameter; P is the count of all. Gauss-Newton steps with Huber's weights
minimise the residuals of flights. Intervals come from the disagreement between flights, and between
blocks (pieces of a flight). Numbers from an earlier fit are held fixed, with the covariance of that
fit (Murphy and Topel 1985). If an interval is too wide, the least identifiable number is reset to
its start, and the others are fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from suite.diagnose.estimate.block import Block, Estimate, less_nuisance, without_nuisance
from suite.diagnose.estimate.gauss_newton import Z95, intervals95
from suite.diagnose.estimate.parameters import FittedNumber, ParameterSpace
from suite.diagnose.evidence.evidence import Evaluation, Evidence
from suite.diagnose.thresholds import THRESHOLDS

HUBER = 2.5
"""Residuals beyond this many standard deviations get a lower weight."""
LEAST_NOISE_SHARE = 0.3
"""Least width of an interval, as a share of its width if all windows were independent."""
LIMITS = replace(THRESHOLDS, converged=1e-3)
"""Thresholds of the fit. It ends with a step below 0.03 standard deviations."""
ROUNDS = 6
"""Largest number of rounds; each computes new weights and takes some Gauss-Newton steps."""
DIFFER_P = 0.05
"""P-value below which flights differ more than their blocks explain. Intervals are then wider."""
LEAST_SIGMA, LEAST_ERROR, LEAST_WEIGHT, LEAST_VARIANCE = 1e-9, 1e-9, 1e-12, 1e-30
"""Lower limits of noise, of an error over it, of a sum of weights, and of two deviations'
product."""


class NoWholeWindow(ValueError):
    """No window of the flights has all signals that a fit compares."""


class Unknown(NamedTuple):
    """A number to fit, in its own unit."""

    name: str
    start: float
    """Value from which the fit starts; a number that is not identifiable keeps it."""
    low: float
    """Lower bound."""
    high: float
    """Upper bound."""
    max_half_width: float
    """Largest half-width of the 95 % interval with which the number counts as identified."""
    step: float
    """Step of the finite differences."""
    method_error: float = 0.0
    """Half-width of the method's own error, from simulated flights; adds to that by noise."""


class Rows(NamedTuple):
    """Residuals of one flight in N windows and C channels."""

    value: np.ndarray
    """(N, C) measured minus modelled value; NaN where a channel was not measured."""
    block: np.ndarray
    """(N,) number of the window's block; errors of different blocks are independent."""
    offset: np.ndarray
    """(C,) bool: channels in which the flight has a free constant, such as a trim."""
    nuisance: np.ndarray | None = None
    """(N, C, K) change of the residuals by one prior standard deviation of nuisance parameters."""


Residuals = Callable[[Mapping[str, float]], Sequence[Rows]]
"""Function from the values of numbers by name to the residuals of every flight."""


class KnownNumbers(NamedTuple):
    """Numbers that an earlier fit has identified, to be held fixed."""

    names: tuple[str, ...] = ()
    covariance: np.ndarray = np.zeros((0, 0))
    """(K, K) covariance of these numbers in the earlier fit."""


NONE_KNOWN = KnownNumbers()
"""No earlier fit."""


@dataclass(frozen=True)
class Fitted:
    """Result of a fit of P numbers."""

    unknowns: tuple[Unknown, ...]
    value: np.ndarray
    """(P,) values of all numbers."""
    covariance: np.ndarray
    """(P, P) covariance; for a number that was not fitted, the square of `max_half_width`."""
    not_identified: tuple[str, ...] = ()
    """Names of numbers that these flights do not identify; they keep their start."""
    residual_rms: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(C,) root mean square of the residual in each channel."""
    measured_rms: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(C,) the same of what was measured, as if the model were zero."""
    known: tuple[str, ...] = ()
    """Names of numbers that an earlier fit has identified."""

    def identifies(self, name: str) -> bool:
        """Return whether this fit identified the number `name`."""
        return name in self.names and name not in (*self.not_identified, *self.known)

    def known_numbers(self, *names: str) -> KnownNumbers:
        """Return those of `names` that this fit has, for another fit that depends on them."""
        indices = [k for k, unknown in enumerate(self.unknowns) if unknown.name in names]
        present = tuple(self.unknowns[k].name for k in indices)
        return KnownNumbers(present, self.covariance[np.ix_(indices, indices)])

    @property
    def names(self) -> list[str]:
        """Names of all numbers."""
        return [unknown.name for unknown in self.unknowns]

    @property
    def half_width(self) -> np.ndarray:
        """(P,) half-widths of the 95 % intervals; NaN for a number that was not fitted."""
        half = Z95 * np.sqrt(np.diag(self.covariance))
        return np.where([self.identifies(name) for name in self.names], half, np.nan)

    def index(self, name: str) -> int:
        """Return the position of the number `name` among the P numbers."""
        return self.names.index(name)

    def interval(self, name: str) -> Interval:
        """Return the value of the fitted number `name` with its 95 % interval."""
        value, half = (float(array[self.index(name)]) for array in (self.value, self.half_width))
        return Interval(value, value - half, value + half)

    def values(self) -> dict[str, float]:
        """Return the values of all numbers by name."""
        return dict(zip(self.names, self.value.tolist(), strict=True))


@dataclass(frozen=True)
class ResidualEvidence(Evidence):
    """Residuals of flights as evidence on the numbers."""

    residuals: Residuals
    unknowns: tuple[Unknown, ...]
    fixed: Mapping[str, float]
    """Values of further numbers on which the residuals depend, by name."""
    noise: np.ndarray | None
    """(C,) standard deviation of the residuals, by channel; None to estimate it."""
    weights: tuple[np.ndarray, ...] = ()
    """Weights (N, C) of the residuals, one array for each flight."""

    @property
    def space(self) -> ParameterSpace:
        """The numbers with their bounds and steps."""
        entries = (
            FittedNumber("", u.name, None, u.low, u.high, u.start, u.step) for u in self.unknowns
        )
        return ParameterSpace(tuple(entries), {})

    def rows(self, theta: np.ndarray) -> Sequence[Rows]:
        """Return the residuals of every flight at the numbers `theta` (P,)."""
        names = (unknown.name for unknown in self.unknowns)
        return self.residuals({**self.fixed, **dict(zip(names, theta.tolist(), strict=True))})

    def weighed(self, at: Estimate) -> ResidualEvidence:
        """Return this evidence with weights of the residuals at the estimate `at`.

        A weight is one over the noise variance; with estimated noise, less for an outlier (Huber
        1964).
        """
        errors = [np.abs(_without_median(row)) for row in self.rows(at.theta)]
        if self.noise is not None:
            known = tuple(np.isfinite(error) / self.noise**2 for error in errors)
            return replace(self, weights=known)
        # 1.4826 times the median absolute deviation is a normal variable's standard deviation.
        sigma = np.maximum(1.4826 * _median(np.concatenate(errors)), LEAST_SIGMA)
        scaled = (np.maximum(error / sigma, LEAST_ERROR) for error in errors)
        weights = (np.minimum(1.0, HUBER / one) / sigma**2 for one in scaled)
        return replace(self, weights=tuple(np.nan_to_num(weight) for weight in weights))

    def estimate_noise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence with the weights at `at`; see `Evidence`."""
        return self.weighed(at).relinearise(at)

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return whitened residuals and slopes along the numbers at `indices`; see `Evidence`.

        Slopes are finite differences, with a step away from an upper limit.
        """
        # Differentiate the residuals along each number.
        along = range(len(self.unknowns)) if indices is None else indices
        rows, differences = self.rows(at.theta), []
        for k in along:
            near_top = self.unknowns[k].high - at.theta[k] < self.unknowns[k].step
            step = -self.unknowns[k].step if near_top else self.unknowns[k].step
            moved = at.theta.copy()
            moved[k] += step
            pairs = zip(self.rows(moved), rows, strict=True)
            differences.append([(a.value - b.value) / step for a, b in pairs])
        # Remove the free constants of each flight, and scale by the root of the weights (whiten).
        values, slopes, blocks = [], [], []
        for flight, (row, weight) in enumerate(zip(rows, self.weights, strict=True)):
            columns = [row.value, *(-difference[flight] for difference in differences)]
            table = np.nan_to_num(np.stack(columns, axis=-1))
            centred = _without_mean(table, weight, row.offset)
            root = np.sqrt(weight)[..., None]
            white = root * centred
            if row.nuisance is not None:
                nuisance = root * _without_mean(row.nuisance, weight, row.offset)
                white = less_nuisance(nuisance, white)
            values.append(white[..., 0])
            slopes.append(white[..., 1:])
            blocks.append(np.stack([np.full(len(row.block), flight), row.block]))
        places, stretch = np.unique(np.concatenate(blocks, axis=1), axis=1, return_inverse=True)
        residual, slope = np.concatenate(values), np.concatenate(slopes)
        flight_of, block = places
        return without_nuisance(
            residual, slope, along, stretch.ravel(), flight_of, block.astype(float)
        )


def fit(
    residuals: Residuals,
    unknowns: Sequence[Unknown],
    held: Sequence[str] = (),
    known: KnownNumbers = NONE_KNOWN,
    noise: np.ndarray | None = None,
    fixed: Mapping[str, float] = MappingProxyType({}),
) -> Fitted:
    """Return the numbers that minimise `residuals`, with intervals.

    A number that is not identifiable may be wrong by its `max_half_width`, which the intervals of
    the others include. The numbers `held` and `known` (by another fit) keep their start. `noise`
    (C,) is the standard deviation of the residuals by channel, or else is estimated. `fixed` are
    the values of numbers that are not among `unknowns`.

    Raises:
        NoWholeWindow: if the residuals have no window.
    """
    not_identified = list(held)
    evidence = ResidualEvidence(residuals, tuple(unknowns), fixed, noise, limits=LIMITS)
    at = Estimate(np.array([unknown.start for unknown in unknowns]))
    if not sum(len(rows.value) for rows in evidence.rows(at.theta)):
        raise NoWholeWindow("no window of these flights has all signals that this fit compares")
    while True:
        not_fitted = (*not_identified, *known.names)
        free = [k for k, unknown in enumerate(unknowns) if unknown.name not in not_fitted]
        # Fit the free numbers; each round has new weights.
        for _ in range(ROUNDS if free else 0):
            before, evidence = at, evidence.weighed(at)
            at = evidence.fitted(at, free).at
            if (at.theta == before.theta).all():
                break
        # Reset the number with the widest interval to its start, until all intervals are narrow.
        covariance = _covariance(evidence, at, free, known)
        half = Z95 * np.sqrt(np.diag(covariance))
        ratio = [half[k] / unknowns[k].max_half_width for k in free]
        if not free or max(ratio) <= 1.0:
            break
        worst = free[int(np.argmax(ratio))]
        not_identified.append(unknowns[worst].name)
        at.theta[worst] = unknowns[worst].start
    return Fitted(
        evidence.unknowns,
        at.theta,
        covariance,
        tuple(not_identified),
        residual_rms=rms_of(evidence.rows(at.theta)),
        known=known.names,
    )


def rms_of(flights: Sequence[Rows]) -> np.ndarray:
    """Return the root mean square (C,) of residuals, less the median where a constant is free."""
    misfit = np.concatenate([_without_median(row) for row in flights])
    return np.sqrt(np.ma.mean(np.ma.masked_invalid(misfit**2), axis=0).filled(0.0))


def _without_median(rows: Rows) -> np.ndarray:
    """Return the residuals (N, C) minus their median in channels with a free constant."""
    if not len(rows.value):
        return rows.value
    return rows.value - np.where(rows.offset, _median(rows.value), 0.0)


def _median(values: np.ndarray) -> np.ndarray:
    """Return the median (C,) of the measured ones of `values` (N, C); 0 where there are none."""
    if len(values) and np.isfinite(values).all():
        return np.median(values, axis=0)  # many times faster than that of masked values
    return np.ma.median(np.ma.masked_invalid(values), axis=0).filled(0.0)


def _without_mean(values: np.ndarray, weight: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return values (N, C, K) minus their weighted mean in channels with a free constant."""
    total = np.maximum(weight.sum(axis=0), LEAST_WEIGHT)[:, None]
    mean = (weight[..., None] * values).sum(axis=0) / total
    return values - np.where(offset[:, None], mean, 0.0)


def _covariance(
    evidence: ResidualEvidence, at: Estimate, free: Sequence[int], known: KnownNumbers
) -> np.ndarray:
    """Return the covariance (P, P) of all numbers; `free` are the indices of the fitted ones."""
    unknowns = evidence.unknowns
    names = [unknown.name for unknown in unknowns]
    fixed = [names.index(name) for name in known.names]
    covariance = np.diag([unknown.max_half_width**2 for unknown in unknowns])
    covariance[np.ix_(fixed, fixed)] = known.covariance
    if not free:
        return covariance
    others = [k for k in range(len(names)) if k not in fixed]
    equations = evidence.estimate_noise(at).block.equations
    prior = np.array([0.0 if k in free else 1.0 / unknowns[k].max_half_width ** 2 for k in others])
    intervals = intervals95(equations.take(others), DIFFER_P, True, LEAST_NOISE_SHARE, prior)
    # A number that is not fitted has at most its prior uncertainty.
    most = np.array([np.inf if k in free else Z95 * unknowns[k].max_half_width for k in others])
    noise_half = np.minimum(intervals.half_width, most)
    # Errors of the method are not correlated between numbers; errors by noise are.
    method = np.array([unknowns[k].method_error for k in others])
    method = np.minimum(method, np.sqrt(most**2 - noise_half**2))
    sd = np.sqrt(np.diag(intervals.by_stretch))
    correlation = intervals.by_stretch / np.maximum(np.outer(sd, sd), LEAST_VARIANCE)
    np.fill_diagonal(correlation, 1.0)
    # How far the fitted numbers move with each number that is held fixed.
    response = intervals.inverse @ equations.sums()[0][np.ix_(others, fixed)]
    own_covariance = (correlation * np.outer(noise_half, noise_half) + np.diag(method**2)) / Z95**2
    covariance[np.ix_(others, others)] = own_covariance + response @ known.covariance @ response.T
    return covariance
