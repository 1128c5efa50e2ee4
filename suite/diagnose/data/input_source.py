"""What drives the model: the recorded commands, or the measured rotor speeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import step_s

FOLLOWS = 0.5
"""Rotor speeds that the nominal rate loop predicts worse than this share of how they change are
another controller's: they are the input then."""
SMOOTH_S = 0.1
"""Speeds are compared as means over this time, in which noise does not count [s]."""
STILL_RAD_S = 10.0
"""Speeds that change by less than this, or are off by less, say nothing [rad/s]."""
SETTLED_S = 0.3
"""After the first row, until the rotors' lag has forgotten how they began [s]."""


def choose_drive(logs: Sequence[FlightLog], drive: str) -> bool:
    """Return whether measured rotor speeds drive the model, as far as the columns decide.

    Raises:
        ValueError: for an unknown `drive`, or one that the logs do not allow.
    """
    commands = all(log.thrust_cmd is not None for log in logs)
    motors = all(log.rotor_speed is not None for log in logs)
    if drive not in ("auto", "commands", "motors"):
        raise ValueError(f"drive = {drive!r}; allowed: auto, commands, motors")
    if not commands and not motors:
        raise ValueError("some flights have commands only and some rotor speeds only: sort them")
    if (drive == "commands" and not commands) or (drive == "motors" and not motors):
        raise ValueError(f"drive = {drive!r}, but not every flight has them")
    return drive == "motors" or not commands


def another_controller(logs: Sequence[FlightLog], vehicle: Vehicle) -> bool:
    """Return whether the measured rotor speeds are not those that the nominal rate loop asks for.

    The loop is given the measured rates, so that nothing but the controller and the rotors is
    compared: what the air or a moved centre of mass does shows in the rates.
    """
    apart, change, count = 0.0, 0.0, 0
    for log in logs:
        if log.rotor_speed is None or log.thrust_cmd is None:
            continue
        error, own = _compare(log, vehicle)
        apart, change, count = apart + (error**2).sum(), change + (own**2).sum(), count + own.size
    if not count:
        return False
    still = count * STILL_RAD_S**2
    return bool(apart > still and apart > FOLLOWS**2 * max(change, still))


def _compare(log: FlightLog, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Return how far means of the speeds (B, 4) are from the loop's, and from their own mean."""
    assert log.rotor_speed is not None and log.thrust_cmd is not None
    assert log.rate_cmd_b is not None
    dt = step_s(vehicle)
    plant = make_plant(vehicle, dt)
    time = np.arange(log.time_s[0], log.time_s[-1], dt)
    rates = [np.interp(time, log.time_s, _filled(column)) for column in log.rate_b.T]
    row = np.searchsorted(log.time_s, time - float(plant.constants.delay) + 1e-7, side="right") - 1
    row = np.maximum(row, 0)
    rate_cmd = np.stack([_filled(column) for column in log.rate_cmd_b.T], axis=-1)
    order = Command(_filled(log.thrust_cmd)[row], rate_cmd[row])
    wanted = wanted_speed(plant, order, np.stack(rates, axis=-1))
    left = float(np.exp(-dt / max(float(plant.constants.time_constant), 1e-9)))
    loop = lfilter([1.0 - left], [1.0, -left], wanted, axis=0, zi=left * wanted[:1])[0]
    place = ((log.time_s - log.time_s[0]) / SMOOTH_S).astype(int)
    asked = np.stack([np.interp(log.time_s, time, column) for column in loop.T], axis=-1)
    good = np.isfinite(log.rotor_speed).all(axis=1) & (log.time_s > log.time_s[0] + SETTLED_S)
    if not good.any():
        return np.zeros((0, 4)), np.zeros((0, 4))
    bins, inverse = np.unique(place[good], return_inverse=True)
    size = np.bincount(inverse, minlength=len(bins))[:, None]
    means = [np.zeros((len(bins), 4)), np.zeros((len(bins), 4))]
    for mean, values in zip(means, (log.rotor_speed[good], asked[good]), strict=True):
        np.add.at(mean, inverse, values)
        mean /= size
    return means[0] - means[1], means[0] - means[0].mean(axis=0)


def _filled(series: np.ndarray) -> np.ndarray:
    good = np.isfinite(series)
    if not good.any():
        return np.zeros_like(series)
    return np.interp(np.arange(len(series)), np.flatnonzero(good), series[good])
