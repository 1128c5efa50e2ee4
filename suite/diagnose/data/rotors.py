"""The rotor speeds that act in a flight, from whatever its log has of them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mix
from eval.quadrotor.plant import make_plant, nominal_quadrotor
from eval.vehicles.vehicle import Vehicle, motor_speed
from suite.diagnose.data.noise import noise_like
from suite.diagnose.data.sampling import interpolate, on_every_row
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class ActingRotors(NamedTuple):
    """Rotor speeds of a log, and what they tell."""

    speed: np.ndarray
    """(N, 4) [rad/s]."""
    source: str
    """For people."""
    each: bool
    """Whether each rotor's own is known; of a collective thrust only their sum is."""
    noise: np.ndarray | None = None
    """(N, 4) a draw of noise as large as the speed's own [rad/s]; None where none was measured."""


def acting_rotors(
    log: FlightLog, vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> ActingRotors | None:
    """Return the speeds that turned in `log`, measured or as asked for; None where nothing says.

    They are those of every row, as far as no hole is in between. What was asked for is followed by
    the vehicle's lag.
    """
    noise = None
    if log.rotor_speed is not None:
        drawn = replace(log, rotor_speed=noise_like(log.rotor_speed, limits))
        noise = on_every_row(drawn, limits).rotor_speed
    log = on_every_row(log, limits)
    if log.rotor_speed is not None:
        return ActingRotors(log.rotor_speed, "measured rotor speeds", True, noise)
    if log.rotor_speed_cmd is not None:
        return ActingRotors(_lagged(log, vehicle, log.rotor_speed_cmd), "motor commands", True)
    if log.pwm is not None and vehicle.motors is not None:
        voltage = log.voltage
        if voltage is not None:
            voltage = interpolate(log.time_s, log.time_s, voltage[:, None])[:, 0]
        speed = np.asarray(motor_speed(vehicle, log.pwm, voltage))
        return ActingRotors(_lagged(log, vehicle, speed), "motor commands and battery", True)
    if log.thrust_cmd is None:
        return None
    force = vehicle.mass * np.maximum(log.thrust_cmd, 0.0)
    torque_b = np.zeros((len(force), 3)) if log.torque_cmd_b is None else log.torque_cmd_b
    nominal, _ = nominal_quadrotor(vehicle)
    each = mix(nominal.unmixer, nominal.thrust_max, force, torque_b)
    speed = np.sqrt(np.maximum(each, 0.0) / vehicle.rotors.thrust_coefficient)
    if log.torque_cmd_b is None:
        return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust", False)
    return ActingRotors(_lagged(log, vehicle, speed), "commanded thrust and torques", True)


def _lagged(log: FlightLog, vehicle: Vehicle, wanted: np.ndarray) -> np.ndarray:
    """Return the speeds that follow `wanted` (N, 4), each held until the next row.

    They do so after the vehicle's delay, by its lag.
    """
    constants = make_plant(vehicle, LONGEST_S).constants
    since = log.time_s - float(constants.delay)
    row = np.searchsorted(log.time_s, since + 1e-9, side="right") - 1
    wanted = wanted[np.maximum(row, 0)]  # with its gaps
    lag = float(constants.time_constant)
    if lag <= 0.0:
        return wanted
    left = np.exp(-np.diff(log.time_s) / lag)[:, None]
    speed = wanted.copy()
    for row in range(1, len(wanted)):
        before = np.where(np.isfinite(speed[row - 1]), speed[row - 1], wanted[row])
        asked = np.where(np.isfinite(wanted[row - 1]), wanted[row - 1], before)
        speed[row] = asked + left[row - 1] * (before - asked)
    return np.where(np.isfinite(wanted), speed, np.nan)
