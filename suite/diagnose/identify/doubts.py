"""Vehicles that the same flights allow nearly as well, for what is built on numbers in doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.data.drive import MotorGuess
from suite.diagnose.identify.entries import inertia_of, of_force, put
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.numbers import told

MOTORS = ("thrust", "curve", "battery")
INERTIA = ("inertia_x", "inertia_y")


def one_off(fitted: Fitted, names: tuple[str, ...]) -> list[Fitted]:
    """Return the fit with the numbers `names` one standard deviation off, each way independent."""
    given = fitted.give(*names)
    if not given.names:
        return []
    variance, ways = np.linalg.eigh(given.covariance)
    found = []
    for size, way in zip(np.sqrt(np.maximum(variance, 0.0)), ways.T, strict=True):
        value = fitted.value.copy()
        value[[fitted.index(name) for name in given.names]] += size * way
        found.append(replace(fitted, value=value))
    return found


def doubted(
    vehicle: Vehicle, start: Vehicle, drive: str, guess: MotorGuess, force: Fitted, torque: Fitted
) -> list[Vehicle]:
    """Return `vehicle` with its motors or its inertia off, by what force and torque leave open.

    Args:
        vehicle: as identified.
        start: what it was identified from.
        drive: what drove the flights.
        guess: the start's motors.
        force: the fit of the force.
        torque: that of the torque.
    """
    found = []
    for fit in one_off(force, MOTORS):
        other = vehicle
        for entry in of_force(start, drive, guess, fit):
            if not entry.key.startswith("effects."):
                other = put(other, entry)
        found.append(other)
    for fit in one_off(torque, INERTIA):
        found.append(replace(vehicle, inertia=tuple(inertia_of(start, told(fit)).tolist())))
    return found
