"""Delay of a state estimate, and the scale error of its velocity.

To first order a delay d causes the error -d times the derivative of the truth, and a scale error k
of the velocity causes k v. Both are fitted by least squares to the errors of all flights, less each
flight's mean; axes are weighted by their variance. Errors are correlated in time, so intervals come
from the disagreement of stretches. Rows are not whitened: that would weight fast motion, in which
an estimator's own dynamics dominate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from eval.logs.flight_log import FlightLog
from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.sensors.errors import PARTS, Errors, errors_of

STRETCH_S = 5.0
"""Errors further apart than this count as independent [s]."""
DIFFER_P = 0.05
"""Flights differ where chance makes them do so more rarely than this."""


ROUNDS = 3
"""Of the fit, each at the delay of the one before."""


class Lateness(NamedTuple):
    """The systematic part of the errors."""

    delay_s: Interval
    velocity_scale: Interval
    by_part: dict[str, Interval]
    """Delay by each part of the state alone [s]."""


def fit_lateness(logs: Sequence[FlightLog]) -> tuple[Lateness, list[Errors]]:
    """Return the delay and the scale of the velocity, and the errors at that delay.

    A delay whose interval contains 0 is set to 0.
    """
    delay_s, found = 0.0, None
    for _ in range(ROUNDS):
        flights = [errors_of(log, delay_s) for log in logs]
        found = _fitted(flights, delay_s)
        delay_s = found.delay_s.value
    assert found is not None
    return found, [errors_of(log, acting(found.delay_s)) for log in logs]


def _fitted(flights: Sequence[Errors], at_s: float) -> Lateness:
    fitted, scale = (0, 1), Interval(0.0, 0.0, 0.0)
    channels = _equations(flights)
    value, half = _solved(_summed(channels), fitted)
    if value[1]:
        scale = _interval(value[1], half[1])
        if not acting(scale):  # it would only widen the delay's interval
            fitted = (0,)
            value, half = _solved(_summed(channels), fitted)
    by_part = {}
    for k, part in enumerate(PARTS):
        own = channels[3 * k : 3 * k + 3]
        if any(equations.hessian[:, 0, 0].any() for equations in own):
            alone, width = _solved(_summed(own), fitted)
            by_part[part] = _interval(at_s + alone[0], width[0])
    return Lateness(_interval(at_s + value[0], half[0]), scale, by_part)


def acting(found: Interval) -> float:
    """Return the value, or 0 where the interval contains 0."""
    return 0.0 if found.low <= 0.0 <= found.high else found.value


def _interval(value: float, half: float) -> Interval:
    return Interval(float(value), float(value - half), float(value + half))


def without(flight: Errors, scale: float) -> np.ndarray:
    """Return the errors (T, 9) less what a scale of the velocity explains."""
    return flight.value - scale * _scaled(flight)


def stretches(flight: Errors) -> np.ndarray:
    """Return the number (T,) of each row's stretch."""
    return (np.arange(len(flight.value)) * flight.step_s / STRETCH_S).astype(int)


def _scaled(flight: Errors) -> np.ndarray:
    nothing = np.zeros_like(flight.vel_b)
    return np.concatenate([nothing, flight.vel_b, nothing], axis=1)


def _equations(flights: Sequence[Errors]) -> list[NormalEquations]:
    """Return the normal equations of each of the nine errors, by stretch."""
    found = []
    for c in range(9):
        rows, flight_of = [], []
        for number, flight in enumerate(flights):
            columns = [flight.value[:, c], -flight.slope[:, c], _scaled(flight)[:, c]]
            values = np.stack(columns, axis=1)
            whole = np.asarray(np.isfinite(values).all(axis=1))
            centred = np.where(whole[:, None], values - _mean(values[whole]), 0.0)
            stretch = stretches(flight)
            for place in np.unique(stretch):
                rows.append(centred[stretch == place])
                flight_of.append(number)
        sums = np.array([part.T @ part for part in rows])
        total = sums.sum(axis=0)
        # Noise in units of what is left, of which the fit itself takes little.
        freedom = max(sum(np.count_nonzero(part[:, 0]) for part in rows), 1)
        variance = max(float(total[0, 0]) / freedom, 1e-300)
        found.append(
            NormalEquations(
                sums[:, 1:, 1:] / variance,
                sums[:, 1:, 0] / variance,
                sums[:, 0, 0] / variance,
                np.array(flight_of),
            )
        )
    return found


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over rows, 0 for a column without any."""
    count = np.isfinite(values).sum(axis=0)
    return np.nansum(values, axis=0) / np.maximum(count, 1)


def _summed(channels: Sequence[NormalEquations]) -> NormalEquations:
    return NormalEquations(
        np.sum([c.hessian for c in channels], axis=0),
        np.sum([c.gradient for c in channels], axis=0),
        np.sum([c.chi2 for c in channels], axis=0),
        channels[0].flight,
    )


def _solved(equations: NormalEquations, fitted: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return delay and scale (2,) and their intervals' half-widths (2,); 0 where not fitted."""
    hessian, gradient = equations.sums()
    at = [k for k in fitted if hessian[k, k] > 1e-9]
    value, half = np.zeros(2), np.zeros(2)
    if at:
        value[at] = np.linalg.solve(hessian[np.ix_(at, at)], gradient[at])
        left = equations._replace(gradient=equations.gradient - equations.hessian @ value)
        half[at] = intervals95(left.take(at), DIFFER_P, leave_out=True).half_width
    return value, half
