"""What a black box could explain: a fit of no physics to the same flights, judged on held-out ones.

A ridge regression (Hoerl and Kennard 1970) on products of what was flown: airspeed, rates, thrust,
differences of the rotors, height. How strongly it is held back is chosen on flights left out of it.
It names nothing; what it closes is what there is to explain with the log's columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.views.data.rows import FlightRows
from suite.diagnose.views.data.view import SmoothedFlight
from suite.diagnose.views.fit.by_flight import centred, units_of

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
