"""The coefficient of blade flapping (a torque by moving air), from the torque view.

Inertia and lags are identified by fast changes alone (`body.py`), since the motors balance slow
disturbances. Their balance identifies flapping, once inertia and lags are known. The uncertainty of
those widens its interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.data.view import TORQUE
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.identify.drive import Driven
from suite.diagnose.identify.entries import inertia_of, of_force, put
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.numbers import Number, values_of
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.search.search import search

EFFECT, KEY = "blade_flapping", "coefficient"
UNIT = "N s^2/rad"


def flapping_of(
    logs: Sequence[FlightLog], vehicle: Vehicle, others: Sequence[Vehicle] = ()
) -> Number | None:
    """Return the coefficient that `logs` show next to all else in `vehicle`, None for no other.

    Whole logs count. It has to pass what a name of a diagnosis has to. `others` are vehicles one
    standard deviation off, each in its own way: by what they give the interval is wider.
    """
    whole = [log for log in logs if not log.partial]
    try:
        flights = ready(whole, vehicle) if whole else None
    except ValueError:  # nothing drives them, or none has a stretch without a hole
        return None
    if flights is None or TORQUE not in flights.views:
        return None
    voltage = all(log.voltage is not None for log in whole)
    task = _task(flights, vehicle, voltage)
    among = [one for one in candidates(task.model.space, voltage, ()) if one.name == EFFECT]
    begun = task.weighed(task.start)
    among = view_candidates(among, begun[1])
    found = search(begun[0], task.start, among, known=begun)
    if not found.named:
        return None
    value = float(found.estimate.theta[found.indices[0]])
    half = float(found.half_widths()[0])
    tasks = (_task(ready(whole, other), other, voltage) for other in others)
    moved = [_step(other, found) for other in tasks]
    half = float(np.hypot(half, Z95 * np.linalg.norm(moved)))
    return Number(f"effects.{EFFECT}.{KEY}", UNIT, [value], [(value - half, value + half)])


def _task(flights: ViewFlights, vehicle: Vehicle, voltage: bool) -> ViewEvidence:
    model = ForceModel(vehicle, make_space(vehicle), voltage)
    return ViewEvidence(TORQUE, model, flights.smoothed[TORQUE.name])


def _step(task: ViewEvidence, found: SearchResult) -> float:
    """Return by how much the coefficient of `found` moves where the vehicle is that of `task`."""
    theta, (at,) = task.model.space.array("start"), found.indices
    theta[at] = found.estimate.theta[at]
    last = found.last.evidence
    assert isinstance(last, ViewEvidence)
    then = replace(task, weights=last.weights)
    hessian, gradient = then.linearise(then.at(theta), [at]).equations.sums()
    return float(gradient[0] / hessian[0, 0])


MOTORS = ("thrust", "curve", "battery")
INERTIA = ("inertia_x", "inertia_y")


def one_sigma_off(fitted: Fitted, names: tuple[str, ...]) -> list[Fitted]:
    """Return the fit with the numbers `names` one standard deviation off, each way independent."""
    known = fitted.as_known(*names)
    if not known.names:
        return []
    variance, ways = np.linalg.eigh(known.covariance)
    found = []
    for size, way in zip(np.sqrt(np.maximum(variance, 0.0)), ways.T, strict=True):
        value = fitted.value.copy()
        value[[fitted.index(name) for name in known.names]] += size * way
        found.append(replace(fitted, value=value))
    return found


def perturbed(vehicle: Vehicle, driven: Driven, force: Fitted, torque: Fitted) -> list[Vehicle]:
    """Return `vehicle` with its motors or its inertia off, by what force and torque leave open.

    Args:
        vehicle: as identified.
        driven: what it was identified from.
        force: the fit of the force.
        torque: that of the torque.
    """
    found = []
    for fit in one_sigma_off(force, MOTORS):
        other = vehicle
        for entry in of_force(driven, fit):
            if not entry.key.startswith("effects."):
                other = put(other, entry)
        found.append(other)
    for fit in one_sigma_off(torque, INERTIA):
        found.append(
            replace(vehicle, inertia=tuple(inertia_of(driven.start, values_of(fit)).tolist()))
        )
    return found
