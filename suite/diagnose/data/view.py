"""Force and torque: what each view compares, flight by flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.rows import FlightRows
from suite.diagnose.data.weak_form import WeakForm, weak_form
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


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


class SmoothedFlight(NamedTuple):
    """A flight's rows, with its measured side in one view."""

    rows: FlightRows
    form: WeakForm
    measured: np.ndarray
    """(M, 3) mean accelerations, axes as the view's model has them."""
    credible: np.ndarray = np.ones(3)
    """(3,) share of the model's changes within the flight that is no noise of what turns it."""


def smoothed(view: View, rows: FlightRows, limits: Thresholds = THRESHOLDS) -> SmoothedFlight:
    """Return a flight's measured side in `view`."""
    form = weak_form(rows.time_s, rows.good, view.width_s, limits.longest_hole_s)
    measured = form.change @ (rows.vel_w if view.in_world else rows.rate_b)
    return SmoothedFlight(rows, form, measured)


def calibrated(flight: SmoothedFlight, turned: np.ndarray, noise: np.ndarray) -> SmoothedFlight:
    """Return a flight whose model is believed as far as what drives it is no noise.

    Noise in what drives makes every slope smaller (errors in variables), as more inertia or less
    thrust would. What is expected of the truth, given what was measured, does not (regression
    calibration; Carroll et al. 2006, Measurement Error in Nonlinear Models, Ch. 4).

    Args:
        flight: in a view.
        turned: (N, 3) the acceleration that the rotors make by what was measured of them.
        noise: (N, 3) what noise as large as theirs adds to it.
    """
    mean = flight.form.mean
    if len(flight.form.middle_s) < 2:
        return flight
    whole = np.var(mean @ turned, axis=0)
    share = np.mean((mean @ noise) ** 2, axis=0) / np.maximum(whole, 1e-12)
    return flight._replace(credible=np.maximum(1.0 - share, 0.0))
