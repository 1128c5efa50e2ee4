"""Force and torque: what each view compares, flight by flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.views.model import ForceModel, RowForces
from suite.diagnose.views.rows import FlightRows
from suite.diagnose.views.weak_form import WeakForm, weak_form


@dataclass(frozen=True)
class View:
    """One way to look at a flight: some equations under measurements of all else."""

    name: str
    """As in a diagnosis."""
    about: str
    """For people: what is compared under what."""
    unit: str
    """Of its three axes."""
    columns: slice
    """Of the model's accelerations."""
    width_s: float
    """Of the bumps that both sides are smoothed by [s]."""
    in_world: bool
    """Whether its accelerations are in world axes; they are turned into the body's."""
    axes: tuple[int, ...] = (0, 1, 2)
    """Of the body, along which it can be asked."""


FORCE = View(
    "force", "translation under the measured attitude and thrust", "m/s^2", slice(0, 3), 0.2, True
)
TORQUE = View(
    "torque", "rotation under the measured rotor speeds", "rad/s^2", slice(3, 6), 0.1, False
)
VIEWS = (FORCE, TORQUE)
"""In the order in which they are looked at."""


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


class SmoothedFlight(NamedTuple):
    """A flight's rows, with its measured side in one view."""

    rows: FlightRows
    form: WeakForm
    measured: np.ndarray
    """(M, 3) mean accelerations, axes as the view's model has them."""


def smoothed(view: View, rows: FlightRows, limits: Thresholds = THRESHOLDS) -> SmoothedFlight:
    """Return a flight's measured side in `view`."""
    form = weak_form(rows.time_s, rows.good, view.width_s, limits.longest_hole_s)
    return SmoothedFlight(rows, form, form.change @ (rows.vel_w if view.in_world else rows.rate_b))


def compare(
    view: View, model: ForceModel, theta: np.ndarray, flights: Sequence[SmoothedFlight]
) -> ViewData:
    """Return how `flights` differ from `model` at the numbers `theta` (P,)."""
    parts = []
    for number, flight in enumerate(flights):
        forces: RowForces = model.at(theta, flight.rows)
        mean, count = flight.form.mean, len(flight.form.middle_s)
        value = mean @ forces.value[:, view.columns]
        slope = forces.slope[:, view.columns].reshape(len(forces.slope), -1)
        slope = (mean @ slope).reshape(count, 3, -1)
        residual = flight.measured - value
        if view.in_world:
            to_body = np.swapaxes(flight.rows.rot_w[flight.form.middle_row], 1, 2)
            residual, value = ((to_body @ part[..., None])[..., 0] for part in (residual, value))
            slope = to_body @ slope
        dumb = [axis for axis in range(3) if axis not in view.axes]
        residual[:, dumb], slope[:, dumb] = 0.0, 0.0
        parts.append(ViewData(np.full(count, number), flight.form.middle_s, value, residual, slope))
    return ViewData(*(np.concatenate(field) for field in zip(*parts, strict=True)))
