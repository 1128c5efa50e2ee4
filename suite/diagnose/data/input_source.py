"""How flights came about: what drives them, commands or measured rotor speeds; whose steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.quadrotor.continuous import INTEGRATORS
from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.actuators import rate_loop_demand
from suite.diagnose.data.resample import follow_lag
from suite.diagnose.data.windows import remembers, step_s
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def rotors_are_input(logs: Sequence[FlightLog], drive: str, vehicle: Vehicle) -> bool:
    """Return whether measured rotor speeds are the input, as far as columns and rate loop decide.

    Raises:
        ValueError: for an unknown `drive`, or one that the logs or the rate loop do not allow.
    """
    commands = all(log.thrust_cmd is not None and log.rate_cmd_b is not None for log in logs)
    motors = all(log.rotor_speed is not None for log in logs)
    if drive not in ("auto", "commands", "motors"):
        raise ValueError(f"drive = {drive!r}; allowed: auto, commands, motors")
    if not commands and not motors:
        raise ValueError("some flights have commands only and some rotor speeds only: sort them")
    if (drive == "commands" and not commands) or (drive == "motors" and not motors):
        raise ValueError(f"drive = {drive!r}, but not every flight has them")
    if remembers(vehicle) and (drive == "commands" or not motors):
        raise ValueError(
            f"{vehicle.name}: no log says what its {vehicle.controller.kind} rate loop remembers "
            "where a stretch of a flight begins, so that commands cannot drive rollouts; give "
            "flights with measured rotor speeds (--drive motors), or a vehicle with a controller "
            "of kind p"
        )
    return drive == "motors" or not commands or remembers(vehicle)


def integrator_of(logs: Sequence[FlightLog], integrator: str) -> str:
    """Return how the bodies of `logs` were moved: as was asked for, or as all their makers say.

    Raises:
        ValueError: for an unknown `integrator`.
    """
    if integrator in INTEGRATORS:
        return integrator
    if integrator != "auto":
        allowed = ", ".join(("auto", *INTEGRATORS))
        raise ValueError(f"integrator = {integrator!r}; allowed: {allowed}")
    told = {log.integrator for log in logs}
    return "euler" if told == {"euler"} else "continuous"


def another_controller(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> bool:
    """Return whether the measured rotor speeds are not those that the nominal rate loop asks for.

    The loop is given the measured rates, so that nothing but the controller and the rotors is
    compared: what the air or a moved centre of mass does shows in the rates.
    """
    missed, change, count = 0.0, 0.0, 0
    for log in logs:
        error, own = _mean_speeds(log, vehicle, limits)
        missed, change, count = missed + (error**2).sum(), change + (own**2).sum(), count + own.size
    still = count * limits.still_speed**2
    return bool(missed > still and missed > limits.fitted_loop_share**2 * max(change, still))


def _mean_speeds(
    log: FlightLog, vehicle: Vehicle, limits: Thresholds
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far means of the speeds (B, 4) are from the loop's, and from their own mean."""
    nothing = np.zeros((0, 4)), np.zeros((0, 4))
    dt, passed = step_s(vehicle), log.time_s - log.time_s[0]
    time = np.arange(log.time_s[0], log.time_s[-1], dt)
    plant = make_plant(vehicle, dt)
    demand = rate_loop_demand(log, plant, time)
    if log.rotor_speed is None or demand is None:
        return nothing
    good = np.isfinite(log.rotor_speed).all(axis=1) & (passed > limits.loop_settled_s)
    if not good.any():
        return nothing
    wanted = demand(float(plant.constants.delay))
    if not np.isfinite(wanted).all():
        return nothing
    loop = follow_lag(wanted, dt, float(plant.constants.time_constant))
    asked = np.stack([np.interp(log.time_s, time, column) for column in loop.T], axis=-1)
    place = (passed / limits.speed_mean_s).astype(int)
    bins, inverse = np.unique(place[good], return_inverse=True)
    means = np.zeros((2, len(bins), 4))
    for mean, values in zip(means, (log.rotor_speed[good], asked[good]), strict=True):
        np.add.at(mean, inverse, values)
    measured, asked = means / np.bincount(inverse, minlength=len(bins))[:, None]
    return measured - asked, measured - measured.mean(axis=0)
