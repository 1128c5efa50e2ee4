"""Identifies the coefficient of blade flapping, a torque of moving air on the rotors.

The motors balance slow torques such as flapping. The fits of inertia and lag therefore use fast
changes of the rates alone (`body.py`). Once inertia and motors are known, the slow part of the
motors' torque shows the flapping that it balances. Their uncertainty widens the interval.
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
from suite.diagnose.estimate.parameters import candidates
from suite.diagnose.evidence.view_means import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.identify.body import FORCE_NUMBERS
from suite.diagnose.identify.drive import DrivenVehicle
from suite.diagnose.identify.entries import entries_of, with_entry
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.numbers import Number
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.search.search import search

FLAPPING = "blade_flapping"


def flapping_of(
    logs: Sequence[FlightLog], vehicle: Vehicle, perturbed: Sequence[Vehicle] = ()
) -> Number | None:
    """Return the flapping coefficient that complete `logs` show, None if it is not significant.

    The test is that of a diagnosis. Each vehicle of `perturbed` has one error of one standard
    deviation, and the change of the coefficient with it widens the interval.
    """
    complete = [log for log in logs if not log.partial]
    try:
        flights = ready(complete, vehicle)
    except ValueError:  # there is no flight, no drive, or no stretch without a hole
        return None
    if TORQUE not in flights.views:
        return None
    voltage = all(log.voltage is not None for log in complete)
    evidence = _torque_evidence(flights, vehicle, voltage)
    # Search for flapping alone, as a diagnosis searches for an effect.
    all_candidates = candidates(evidence.model.space, voltage, ())
    flapping = [candidate for candidate in all_candidates if candidate.name == FLAPPING]
    begin = evidence.estimate_noise(evidence.start)
    result = search(begin, view_candidates(flapping, begin.block))
    if not result.named:
        return None
    value = float(result.estimate.theta[result.indices[0]])
    # Errors of motors and inertia are independent, so their squares are added.
    others = (_torque_evidence(ready(complete, other), other, voltage) for other in perturbed)
    steps = [_coefficient_step(other, result) for other in others]
    half = float(np.hypot(result.half_widths()[0], Z95 * np.linalg.norm(steps)))
    ci95 = (value - half, value + half)
    return Number(f"effects.{FLAPPING}.coefficient", "N s^2/rad", [value], [ci95])


def _torque_evidence(flights: ViewFlights, vehicle: Vehicle, voltage: bool) -> ViewEvidence:
    """Return the torques of `flights` compared with those of `vehicle`."""
    return ViewEvidence(TORQUE, ForceModel(vehicle, voltage), flights.smoothed[TORQUE.name])


def _coefficient_step(evidence: ViewEvidence, result: SearchResult) -> float:
    """Return by how much one Gauss-Newton step on `evidence` moves the coefficient of `result`."""
    theta, (index,) = evidence.model.space.array("start"), result.indices
    theta[index] = result.estimate.theta[index]
    last = result.last.evidence
    assert isinstance(last, ViewEvidence)
    weighted = replace(evidence, weights=last.weights)
    hessian, gradient = weighted.linearise(Estimate(theta), [index]).equations.sums()
    return float(gradient[0] / hessian[0, 0])


def perturbed_vehicles(
    vehicle: Vehicle, driven: DrivenVehicle, force: Fitted, torque: Fitted
) -> list[Vehicle]:
    """Return copies of `vehicle` with one independent error of one standard deviation each.

    They are along the principal axes of the covariances of motors and inertia.
    """
    vehicles = []
    motors = (force, FORCE_NUMBERS, ("motors", "rotors"))
    inertia = (torque, ("inertia_x", "inertia_y"), ("inertia",))
    for fitted, names, tables in (motors, inertia):
        known = fitted.known_numbers(*names)
        indices = [fitted.index(name) for name in known.names]
        variance, axes = np.linalg.eigh(known.covariance)
        for sigma, axis in zip(np.sqrt(np.maximum(variance, 0.0)), axes.T, strict=True):
            value, other = fitted.value.copy(), vehicle
            value[indices] += sigma * axis
            for entry in entries_of(driven, replace(fitted, value=value)):
                if entry.key.partition(".")[0] in tables:
                    other = with_entry(other, entry)
            vehicles.append(other)
    return vehicles
