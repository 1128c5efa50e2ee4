"""What a view's names are worth on flights that took no part, beside what a black box is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.view import FlightRows, SmoothedFlight
from suite.diagnose.evidence.moments import ViewData, centred, units_of
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.look import SearchResult


class ViewGap(NamedTuple):
    """One view's errors on held-out flights, by axis of the body."""

    before: np.ndarray
    """(3,) RMS as given [the view's unit]."""
    after: np.ndarray
    """(3,) with what was named."""
    floor: np.ndarray
    """(3,) what measurement noise gives."""
    repeatability: np.ndarray
    """(3,) how flights' means differ among themselves; NaN where too few flights tell it."""
    closed: np.ndarray
    """(3,) share of the variance within flights that the names close."""
    explainable: np.ndarray
    """(3,) share that a black box, fitted to the same flights, closes."""
    left: np.ndarray
    """(3,) share that a black box closes of it beyond the names."""
    variance: np.ndarray
    """(3,) within flights, as given."""

    def share(self, by_axis: np.ndarray) -> float:
        """Return a share by axis (3,) as one of all axes together, at least 0."""
        return float(max((by_axis * self.variance).sum() / max(self.variance.sum(), 1e-12), 0.0))

    def rms(self, by_axis: np.ndarray) -> float:
        """Return the root of the sum of squares over the axes of errors (3,)."""
        return float(np.sqrt((by_axis**2).sum()))


def judge(found: SearchResult, held: ViewEvidence, floor: np.ndarray) -> ViewGap:
    """Return what `found` is worth on the flights of `held`; `floor` (3,) is the noise's."""
    before, after = held.left(found.start.theta), held.left(found.estimate.theta)
    evidence = found.last.evidence
    assert isinstance(evidence, ViewEvidence)
    if held.means:
        return _judge_change(before, after, floor, evidence.repeatability)
    start, fitted = evidence.left(found.start.theta), evidence.left(found.estimate.theta)
    inside = np.concatenate([inputs_of(flight) for flight in evidence.flights])
    outside = np.concatenate([inputs_of(flight) for flight in held.flights])
    numbers = before.flight
    whole = fit_black_box(inside, start.residual, start.flight)
    beyond = fit_black_box(inside, fitted.residual, fitted.flight)
    shares = [
        closed_share(before.residual, left, numbers)
        for left in (
            after.residual,
            before.residual - whole.predict(outside),
            after.residual - beyond.predict(outside),
        )
    ]
    closed, explainable, both = shares
    return ViewGap(
        before=_rms(before.residual),
        after=_rms(after.residual),
        floor=floor,
        repeatability=_finite(evidence.repeatability),
        closed=closed,
        explainable=np.maximum(explainable, closed),
        left=both - closed,
        variance=(centred(before.residual, numbers) ** 2).mean(axis=0),
    )


def _judge_change(
    before: ViewData, after: ViewData, floor: np.ndarray, trim: np.ndarray
) -> ViewGap:
    """Return what the names of a change are worth: means alone count."""
    power = (before.residual**2).mean(axis=0)
    closed = 1.0 - (after.residual**2).mean(axis=0) / np.maximum(power, 1e-12)
    return ViewGap(
        before=_rms(before.residual),
        after=_rms(after.residual),
        floor=floor,
        repeatability=_finite(trim),
        closed=closed,
        explainable=np.maximum(closed, 0.0),
        left=np.zeros(3),
        variance=power,
    )


def gap_without(found: SearchResult, held: ViewEvidence, indices: Sequence[int]) -> np.ndarray:
    """Return the RMS (3,) on held-out flights where the numbers at `indices` are as given."""
    theta = found.estimate.theta.copy()
    theta[list(indices)] = found.start.theta[list(indices)]
    return _rms(held.left(theta).residual)


def _rms(residual: np.ndarray) -> np.ndarray:
    return np.sqrt((residual**2).mean(axis=0))


def _finite(trim: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(trim), trim, np.nan)


RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Weights of the coefficients' squares that are tried, against a moment's each."""


class BlackBox(NamedTuple):
    """A fitted black box."""

    spread: np.ndarray
    """(K,) of the inputs."""
    weight: np.ndarray
    """(K, 3)."""

    def predict(self, inputs: np.ndarray) -> np.ndarray:
        """Return what it says (M, 3) for `inputs` (M, K)."""
        return (inputs / self.spread) @ self.weight


def inputs_of(flight: SmoothedFlight) -> np.ndarray:
    """Return the products (M, K) that a black box sees of a flight, smoothed as the view is."""
    return flight.form.mean @ _products(flight.rows)


def fit_black_box(inputs: np.ndarray, left: np.ndarray, flight: np.ndarray) -> BlackBox:
    """Return the black box that explains `left` (M, 3) best on flights left out of its fit.

    Means of flights are taken off both sides: they are trims. `flight` (M,) says whose each is;
    a lone flight's thirds stand for flights.
    """
    units = units_of(flight)
    inputs, left = centred(inputs, flight), centred(left, flight)
    spread = np.maximum(inputs.std(axis=0), 1e-9)
    scaled = inputs / spread

    def solve(rows: np.ndarray, ridge: float) -> np.ndarray:
        square = scaled[rows].T @ scaled[rows] + ridge * rows.sum() * np.eye(scaled.shape[1])
        return np.linalg.solve(square, scaled[rows].T @ left[rows])

    errors = []
    for ridge in RIDGES:
        missed = np.zeros(3)
        for unit in np.unique(units):
            out = units == unit
            missed += ((left[out] - scaled[out] @ solve(~out, ridge)) ** 2).sum(axis=0)
        errors.append(missed)
    best = np.argmin(errors, axis=0)
    every = np.ones(len(units), bool)
    columns = [solve(every, RIDGES[k])[:, axis] for axis, k in enumerate(best)]
    none = (left**2).sum(axis=0) <= np.min(errors, axis=0)  # better to say nothing at all
    return BlackBox(spread, np.where(none, 0.0, np.stack(columns, axis=1)))


def closed_share(left: np.ndarray, after: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the share (3,) of the variance of `left` (M, 3) within flights that is gone."""
    before = (centred(left, flight) ** 2).sum(axis=0)
    return 1.0 - (centred(after, flight) ** 2).sum(axis=0) / np.maximum(before, 1e-12)


def _products(rows: FlightRows) -> np.ndarray:
    """Return the inputs (N, K) on every row: what was flown, and its products by two."""
    vel_b = rows.vel_b
    push = rows.rotor_speed**2
    push = push / np.maximum(push.mean(), 1e-9)
    pairs = push @ np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [-1, 1, 1, -1], [1, -1, 1, -1]]).T / 4.0
    # Near the ground heights matter; far from it no height is like no other.
    near = 1.0 / (1.0 + np.maximum(rows.pos_w[:, 2:], 0.0))
    one = np.concatenate([vel_b, rows.rate_b, pairs, near, rows.voltage_drop[:, None]], axis=1)
    row, column = np.triu_indices(one.shape[1])
    speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
    return np.concatenate([one, one[:, row] * one[:, column], speed * vel_b], axis=1)
