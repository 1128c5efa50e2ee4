"""Identifies the blade flapping coefficient, the torque of moving air on the rotors.

Inertia and lags come from fast changes of the rates alone (`body.py`), since the motors balance
slow disturbances. Once these are known, the motors' balance shows flapping. The uncertainty of
motors and inertia widens its interval. `identify.py` calls this after the other fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.data.view import TORQUE
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.identify.body import FORCE_NUMBERS
from suite.diagnose.identify.drive import DrivenVehicle
from suite.diagnose.identify.entries import force_entries, inertia_from, with_entry
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.numbers import Number
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.search.search import search

FLAPPING, KEY = "blade_flapping", "coefficient"
UNIT = "N s^2/rad"


def flapping_of(
    logs: Sequence[FlightLog], vehicle: Vehicle, perturbed: Sequence[Vehicle] = ()
) -> Number | None:
    """Return the flapping coefficient of `vehicle` by `logs`, or None if none is significant.

    Only complete logs are used. The significance test is that of a diagnosis.

    Args:
        logs: flights.
        vehicle: the vehicle with all other identified numbers.
        perturbed: vehicles one standard deviation off, from `perturbed_vehicles`. The change of
            the coefficient under each widens the interval.
    """
    complete = [log for log in logs if not log.partial]
    try:
        flights = ready(complete, vehicle) if complete else None
    except ValueError:  # the flights have no drive, or no stretch without a hole
        return None
    if flights is None or TORQUE not in flights.views:
        return None
    voltage = all(log.voltage is not None for log in complete)
    evidence = _torque_evidence(flights, vehicle, voltage)
    every = candidates(evidence.model.space, voltage, ())
    flapping = [candidate for candidate in every if candidate.name == FLAPPING]
    weighed, block = evidence.estimate_noise(evidence.start)
    allowed = view_candidates(flapping, block)
    result = search(weighed, evidence.start, allowed, known=(weighed, block))
    if not result.named:
        return None
    value = float(result.estimate.theta[result.indices[0]])
    others = (_torque_evidence(ready(complete, other), other, voltage) for other in perturbed)
    steps = [_coefficient_step(other, result) for other in others]
    half = float(np.hypot(result.half_widths()[0], Z95 * np.linalg.norm(steps)))
    return Number(f"effects.{FLAPPING}.{KEY}", UNIT, [value], [(value - half, value + half)])


def _torque_evidence(flights: ViewFlights, vehicle: Vehicle, voltage: bool) -> ViewEvidence:
    model = ForceModel(vehicle, make_space(vehicle), voltage)
    return ViewEvidence(TORQUE, model, flights.smoothed[TORQUE.name])


def _coefficient_step(evidence: ViewEvidence, result: SearchResult) -> float:
    """Return the Gauss-Newton step of the coefficient of `result` under another vehicle."""
    theta, (index,) = evidence.model.space.array("start"), result.indices
    theta[index] = result.estimate.theta[index]
    last = result.last.evidence
    assert isinstance(last, ViewEvidence)
    weighted = replace(evidence, weights=last.weights)
    hessian, gradient = weighted.linearise(Estimate(theta), [index]).equations.sums()
    return float(gradient[0] / hessian[0, 0])


def one_sigma_off(fitted: Fitted, names: tuple[str, ...]) -> list[Fitted]:
    """Return the fit with the numbers `names` moved by one standard deviation.

    One result for each principal axis of their covariance; these errors are independent.
    """
    known = fitted.known_numbers(*names)
    if not known.names:
        return []
    variance, axes = np.linalg.eigh(known.covariance)
    indices = [fitted.index(name) for name in known.names]
    moved = []
    for sigma, axis in zip(np.sqrt(np.maximum(variance, 0.0)), axes.T, strict=True):
        value = fitted.value.copy()
        value[indices] += sigma * axis
        moved.append(replace(fitted, value=value))
    return moved


def perturbed_vehicles(
    vehicle: Vehicle, driven: DrivenVehicle, force: Fitted, torque: Fitted
) -> list[Vehicle]:
    """Return `vehicle` with motors or inertia one standard deviation off, one error each.

    Args:
        vehicle: with the identified numbers.
        driven: the start of the fits.
        force: result of the force's fit.
        torque: result of the torque's fit.
    """
    vehicles = []
    for fitted in one_sigma_off(force, FORCE_NUMBERS):
        other = vehicle
        for entry in force_entries(driven, fitted):
            if not entry.key.startswith("effects."):
                other = with_entry(other, entry)
        vehicles.append(other)
    for fitted in one_sigma_off(torque, ("inertia_x", "inertia_y")):
        x, y, z = inertia_from(driven.start, fitted.values()).tolist()
        vehicles.append(replace(vehicle, inertia=(x, y, z)))
    return vehicles
