"""How flights differ from the model at one set of numbers, moment by moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.view import SmoothedFlight, View
from suite.diagnose.evidence.force_torque import ForceModel, RowForces


class ViewData(NamedTuple):
    """M smoothed moments of all flights, in one view."""

    flight: np.ndarray
    """(M,) number of the flight."""
    middle_s: np.ndarray
    """(M,) since the first row of the flight [s]."""
    value: np.ndarray
    """(M, 3) the model's, body axes."""
    residual: np.ndarray
    """(M, 3) measured - model, body axes."""
    slope: np.ndarray
    """(M, 3, P) of the model along every number."""


def compare(
    view: View, model: ForceModel, theta: np.ndarray, flights: Sequence[SmoothedFlight]
) -> ViewData:
    """Return how `flights` differ from `model` at the numbers `theta` (P,)."""
    parts = []
    for number, flight in enumerate(flights):
        forces: RowForces = model.at(theta, flight.rows)
        mean, count = flight.form.mean, len(flight.form.middle_s)
        value = mean @ forces.value[:, view.columns]
        slope = forces.slope[:, view.columns]
        slope = (mean @ slope.reshape(len(slope), -1)).reshape(count, *slope.shape[1:])
        value, slope = (_believed(part, flight.credible) for part in (value, slope))
        residual = flight.measured - value
        if view.in_world:
            to_body = np.swapaxes(flight.rows.rot_w[flight.form.middle_row], 1, 2)
            residual, value = ((to_body @ part[..., None])[..., 0] for part in (residual, value))
            slope = to_body @ slope
        dumb = [axis for axis in range(3) if axis not in view.axes]
        residual[:, dumb], slope[:, dumb] = 0.0, 0.0
        parts.append(ViewData(np.full(count, number), flight.form.middle_s, value, residual, slope))
    return ViewData(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def _believed(series: np.ndarray, credible: np.ndarray) -> np.ndarray:
    """Return `series` (M, 3, ...) with as much of its changes as is `credible` (3,)."""
    if not len(series) or (credible == 1.0).all():
        return series
    mean = series.mean(axis=0)
    return mean + credible.reshape(3, *[1] * (series.ndim - 2)) * (series - mean)


def means_of(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the mean (F, ...) of `values` (M, ...) over each flight; `flight` (M,) numbers it."""
    return np.array([values[flight == number].mean(axis=0) for number in np.unique(flight)])


def centred(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return `values` (M, ...) less the mean of each's flight."""
    _, place = np.unique(flight, return_inverse=True)
    return values - means_of(values, flight)[place.ravel()]


def units_of(flight: np.ndarray) -> np.ndarray:
    """Return what is left out together (M,): flights, or thirds of a lone one."""
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)
