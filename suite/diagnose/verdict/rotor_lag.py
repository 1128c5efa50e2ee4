"""How late the rotors are, by what commands asked of them: views take their speeds as measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.checks.actuators import ActuatorMismatch, actuator_mismatches
from suite.diagnose.data.windows import remembers, step_s
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

LAG = "motor_lag"
"""The effect that is named."""


class RotorLag(NamedTuple):
    """A lag of the rotors that is not the vehicle's."""

    time_constant: float
    """[s]."""
    known: float
    """What the vehicle has [s]."""
    half_width: float
    """Of its 95 % interval, over flights, and half a step of the model [s]."""
    closed: float
    """Share that it closes of the squared error that the vehicle's lag leaves of rotor speeds."""
    p_value: float
    """Of the vehicle's own lag."""


def another_lag(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> RotorLag | None:
    """Return the rotors' lag where commands and measured rotor speeds say that it is another one.

    Args:
        logs: flights; those do not count that are without commands or rotor speeds, or in which the
            nominal rate loop does not explain the speeds: a firmware's filters are no lag.
        vehicle: what a simulation uses.
        limits: from where on flights tell it.
    """
    if remembers(vehicle):
        return None
    own = vehicle.effects.get(LAG)
    known = vehicle.rotors.time_constant if own is None else float(own.time_constant)
    vehicle = replace(vehicle, rotors=replace(vehicle.rotors, time_constant=known))
    told = [_asked_by_loop(log, vehicle, limits) for log in logs]
    found = [one for one in told if one is not None and _explains(one, limits)]
    if len(found) < limits.lag_least_flights:
        return None
    lags = np.array([one.time_constant for one in found])
    step = 0.5 * step_s(vehicle)
    spread = float(lags.std(ddof=1)) / np.sqrt(len(lags))
    half = float(stats.t.ppf(0.975, len(lags) - 1)) * spread + step
    away = float(abs(lags.mean() - known))
    before = sum(one.rms_own**2 for one in found)
    closed = 1.0 - sum(one.rms_fitted**2 for one in found) / max(before, 1e-12)
    if away <= half or closed < limits.lag_closed_share:
        return None
    beyond = (away - step) / max(spread, 1e-9)
    return RotorLag(
        time_constant=float(lags.mean()),
        known=known,
        half_width=half,
        closed=closed,
        p_value=float(2.0 * stats.t.sf(beyond, len(lags) - 1)),
    )


def _asked_by_loop(log: FlightLog, vehicle: Vehicle, limits: Thresholds) -> ActuatorMismatch | None:
    """Return how the rotors follow the nominal rate loop; None where the log cannot say."""
    if log.partial or log.rate_cmd_b is None or log.rotor_speed is None:
        return None
    found = actuator_mismatches([log], vehicle, limits)
    return next((one for one in found if one.asked_by == "nominal rate loop"), None)


def _explains(one: ActuatorMismatch, limits: Thresholds) -> bool:
    return one.rms_fitted**2 <= (1.0 - limits.lag_followed_share) * one.spread**2
