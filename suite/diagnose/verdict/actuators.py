"""Measured rotor speeds against commanded ones: controller and motors, apart from aerodynamics.

Flight controllers have integrators and filters that the nominal rate loop lacks, so a difference
between commanded and measured rotor speeds is not missing aerodynamics. Here the nominal rate loop,
mixer and lag compute the rotor speeds of the logged commands at the measured rates. The same
comparison decides what drives the model, and whether the rotors have another lag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from eval.logs.flight_log import FlightLog
from eval.quadrotor.continuous import INTEGRATORS
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.plant import Command, Plant, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.sampling import follow_lag, hold, interpolate, on_every_row
from suite.diagnose.data.windows import remembers, step_s
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class ActuatorMismatch(NamedTuple):
    """How measured rotor speeds differ from the commanded ones."""

    commanded_by: str
    """"nominal rate loop" or "logged motor commands"."""
    rms: float
    """Of the difference with the vehicle file's lag [rad/s]."""
    spread: float
    """Standard deviation of the measured speeds about each rotor's mean [rad/s]."""
    time_constant: float
    """Of the lag that fits best [s]."""
    delay: float
    """Of the commands, before it [s]."""
    scale: tuple[float, ...]
    """Measured over commanded, by rotor, with that lag and delay."""
    rms_fitted: float
    """Of the residual with that lag and delay [rad/s]."""
    rms_own: float
    """The same with the vehicle file's lag and the delay that fits best with it [rad/s]."""
    thrust: tuple[float, float]
    """Mean and spread of measured minus commanded collective thrust, over nominal mass [m/s^2]."""
    turn: tuple[tuple[float, float], ...]
    """The same of the angular acceleration about x, y, z [rad/s^2]."""

    @property
    def followed(self) -> float:
        """Share of the speeds' variance that the nominal loop and lag explain [1]."""
        return 1.0 - (self.rms / max(self.spread, 1e-9)) ** 2


Demand = Callable[[float], np.ndarray]
"""Delay of the commands [s] -> (S, 4) rotor speeds that are commanded in each step [rad/s]."""


class _Stretch(NamedTuple):
    """Rows without a hole, on the vehicle's steps."""

    demand: Demand
    row: np.ndarray
    """(N,) step at whose start each measured row was taken."""
    measured: np.ndarray
    """(N, 4) [rad/s]."""


def actuator_mismatches(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> list[ActuatorMismatch]:
    """Return how measured rotor speeds differ from commands and logged motor commands.

    Logs without measured rotor speeds do not count, nor do the effects of `vehicle`. What the logs
    allow is one or both of them, or neither.
    """
    plant = make_plant(vehicle, step_s(vehicle), {})
    found = []
    for commanded_by, demand_of in (
        ("nominal rate loop", partial(rate_loop_demand, plant=plant)),
        ("logged motor commands", _logged_demand),
    ):
        stretches: list[_Stretch] = []
        for log in logs:
            rows = sum(len(part.row) for part in stretches)
            if rows * step_s(vehicle) < limits.actuator_flight_s:
                stretches += _stretches(log, vehicle, demand_of, limits)
        if stretches:
            found.append(_mismatch(commanded_by, stretches, vehicle, limits))
    return found


def rate_loop_demand(log: FlightLog, at_s: np.ndarray, plant: Plant) -> Demand | None:
    """Return the speeds by the rate loop of `plant` at the measured rates and at times `at_s` (S,).

    None where the log has no commands.
    """
    if log.thrust_cmd is None or log.rate_cmd_b is None:
        return None
    command = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
    rates = interpolate(at_s, log.time_s, log.rate_b)

    def demand(delay: float) -> np.ndarray:
        # The loop uses the current rates; only the command is delayed.
        late = hold(at_s - delay, log.time_s, command)
        return np.asarray(wanted_speed(plant, Command(late[:, 0], late[:, 1:]), rates))

    return demand


def _logged_demand(log: FlightLog, at_s: np.ndarray) -> Demand | None:
    command = log.rotor_speed_cmd
    if command is None:
        return None
    return lambda delay: hold(at_s - delay, log.time_s, command)


def _stretches(
    log: FlightLog,
    vehicle: Vehicle,
    demand_of: Callable[[FlightLog, np.ndarray], Demand | None],
    limits: Thresholds,
) -> list[_Stretch]:
    if log.rotor_speed is None:
        return []
    dt, found = step_s(vehicle), []
    rate_b = on_every_row(log, limits).rate_b
    good = np.isfinite(log.rotor_speed).all(axis=1) & np.isfinite(rate_b).all(axis=1)
    rows = np.flatnonzero(good)
    holes = np.flatnonzero(np.diff(log.time_s[rows]) > limits.longest_hole_s)
    for part in np.split(rows, holes + 1):
        if not len(part):
            continue
        time = log.time_s[part] - log.time_s[part[0]]
        if time[-1] < 4.0 * limits.lag_settled_s:
            continue
        at_s = log.time_s[part[0]] + dt * np.arange(int(time[-1] / dt) + 1)
        demand = demand_of(log, at_s)
        if demand is None or not np.isfinite(demand(0.0)).all():
            continue
        row = np.round(time / dt).astype(int)
        late = (row * dt >= limits.lag_settled_s) & (row <= len(at_s))
        found.append(_Stretch(demand, row[late], log.rotor_speed[part[late]]))
    return found


def _mismatch(
    commanded_by: str, stretches: Sequence[_Stretch], vehicle: Vehicle, limits: Thresholds
) -> ActuatorMismatch:
    dt, lag = step_s(vehicle), vehicle.rotors.time_constant
    measured = np.concatenate([part.measured for part in stretches])

    def followed(wanted: Sequence[np.ndarray], time_constant: float) -> np.ndarray:
        parts = zip(wanted, stretches, strict=True)
        return np.concatenate([_follow(a, part.row, dt, time_constant) for a, part in parts])

    def scales(speed: np.ndarray) -> np.ndarray:
        return (speed * measured).sum(0) / np.maximum((speed**2).sum(0), 1e-9)

    def left(wanted: Sequence[np.ndarray], time_constant: float) -> float:
        speed = followed(wanted, time_constant)
        return float(((measured - scales(speed) * speed) ** 2).mean())

    def best_lag(delay: float) -> tuple[float, float]:
        """Return the mean squared error that the best lag leaves, and the lag."""
        cost = partial(left, [part.demand(delay) for part in stretches])
        options = {"xatol": 1e-4}
        best = minimize_scalar(
            cost, bounds=(0.0, limits.longest_lag_s), method="bounded", options=options
        )
        return min((float(best.fun), float(best.x)), (cost(0.0), 0.0))

    delay, _ = _least(lambda delay: best_lag(delay)[0], limits)
    _, time_constant = best_lag(delay)
    _, own = _least(lambda delay: left([part.demand(delay) for part in stretches], lag), limits)
    nominal = followed([part.demand(0.0) for part in stretches], lag)
    fitted = followed([part.demand(delay) for part in stretches], time_constant)
    scale = scales(fitted)
    thrust, turn = wrench_difference(measured, nominal, vehicle)
    return ActuatorMismatch(
        commanded_by=commanded_by,
        rms=_rms(measured - nominal),
        spread=_rms(measured - measured.mean(axis=0)),
        time_constant=time_constant,
        delay=delay,
        scale=tuple(float(s) for s in scale),
        rms_fitted=_rms(measured - scale * fitted),
        rms_own=float(np.sqrt(own)),
        thrust=(float(thrust.mean()), float(thrust.std())),
        turn=tuple((float(t.mean()), float(t.std())) for t in turn.T),
    )


def _least(cost: Callable[[float], float], limits: Thresholds) -> tuple[float, float]:
    """Return the delay of the commands with the smallest `cost` [s], and that cost."""
    tried = np.linspace(0.0, limits.longest_delay_s, limits.delays_tried)
    place = int(np.argmin([cost(delay) for delay in tried]))
    near = (tried[max(place - 1, 0)], tried[min(place + 1, limits.delays_tried - 1)])
    options = {"xatol": 2e-4}
    refined = minimize_scalar(cost, bounds=near, method="bounded", options=options)
    best, none = float(refined.fun), cost(0.0)
    return (0.0, none) if none <= best else (float(refined.x), best)


def _follow(wanted: np.ndarray, row: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return the rotor speeds (N, 4) at the rows after the lag."""
    # The speed at the end of step k is that at the start of step k + 1.
    return np.concatenate([wanted[:1], follow_lag(wanted, dt, time_constant)])[row]


def wrench_difference(
    measured: np.ndarray, wanted: np.ndarray, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray]:
    """Return thrust over mass (N,) and angular acceleration (N, 3) of measured minus commanded."""
    rotors = vehicle.rotors
    ratio = rotors.torque_coefficient / rotors.thrust_coefficient
    mixer = mixer_matrix(np.array(rotors.position), np.array(rotors.spin), ratio)
    wrench = rotors.thrust_coefficient * (measured**2 - wanted**2) @ mixer.T
    return wrench[:, 0] / vehicle.mass, wrench[:, 1:] / np.array(vehicle.inertia)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def rotors_are_input(logs: Sequence[FlightLog], drive: str, vehicle: Vehicle) -> bool:
    """Return whether measured rotor speeds drive the model, by the logs' columns and the rate loop.

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
            f"{vehicle.name}: no log holds the state of its {vehicle.controller.kind} rate loop "
            "at the start of a stretch, so that commands cannot drive rollouts; give "
            "flights with measured rotor speeds (--drive motors), or a vehicle with a controller "
            "of kind p"
        )
    return drive == "motors" or not commands or remembers(vehicle)


def integrator_of(logs: Sequence[FlightLog], integrator: str) -> str:
    """Return how the bodies of `logs` were moved: as chosen, or as all logs have it.

    Raises:
        ValueError: for an unknown `integrator`.
    """
    if integrator in INTEGRATORS:
        return integrator
    if integrator != "auto":
        allowed = ", ".join(("auto", *INTEGRATORS))
        raise ValueError(f"integrator = {integrator!r}; allowed: {allowed}")
    used = {log.integrator for log in logs}
    return "euler" if used == {"euler"} else "continuous"


def another_controller(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> bool:
    """Return whether the measured rotor speeds are not those of the nominal rate loop.

    The loop is given the measured rates, so that nothing but the controller and the rotors is
    compared: what the air or a moved centre of mass does shows in the rates.
    """
    dt, plant = step_s(vehicle), make_plant(vehicle, step_s(vehicle))
    delay, lag = float(plant.constants.delay), float(plant.constants.time_constant)
    missed, change, count = 0.0, 0.0, 0
    for log in logs:
        demand_of = partial(rate_loop_demand, plant=plant)
        for part in _stretches(log, vehicle, demand_of, limits):
            wanted = _follow(part.demand(delay), part.row, dt, lag)
            place = (part.row * dt / limits.speed_mean_s).astype(int)
            bins, number = np.unique(place, return_inverse=True)
            sums = np.zeros((len(bins), 8))
            np.add.at(sums, number, np.concatenate([part.measured, wanted], axis=1))
            own, loop = np.split(sums / np.bincount(number)[:, None], 2, axis=1)
            missed += float(((own - loop) ** 2).sum())
            change += float(((own - own.mean(axis=0)) ** 2).sum())
            count += own.size
    still = count * limits.still_speed**2
    return bool(missed > still and missed > limits.fitted_loop_share**2 * max(change, still))


LAG = "motor_lag"
"""Name of the effect."""


class RotorLag(NamedTuple):
    """A time constant of the rotors that differs from the vehicle file's."""

    time_constant: float
    """[s]."""
    known: float
    """What the vehicle has [s]."""
    half_width: float
    """Of its 95 % interval, over flights, and half a step of the model [s]."""
    closed: float
    """Share of the rotor speeds' squared error under the vehicle's lag that this lag removes."""
    p_value: float
    """Of the vehicle's own lag."""


def another_lag(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> RotorLag | None:
    """Return the rotors' lag where commands and measured rotor speeds show another one.

    Args:
        logs: flights; those do not count that are without commands or rotor speeds, or in which the
            nominal rate loop does not explain the speeds: a firmware's filters are no lag.
        vehicle: what a simulation uses.
        limits: from where on flights show it.
    """
    if remembers(vehicle):
        return None
    own = vehicle.effects.get(LAG)
    known = vehicle.rotors.time_constant if own is None else float(own.time_constant)
    vehicle = replace(vehicle, rotors=replace(vehicle.rotors, time_constant=known))
    each = [_loop_mismatch(log, vehicle, limits) for log in logs]
    found = [one for one in each if one is not None and _explains(one, limits)]
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


def _loop_mismatch(log: FlightLog, vehicle: Vehicle, limits: Thresholds) -> ActuatorMismatch | None:
    """Return how the rotors follow the nominal rate loop; None where the log does not show it."""
    if log.partial or log.rate_cmd_b is None or log.rotor_speed is None:
        return None
    found = actuator_mismatches([log], vehicle, limits)
    return next((one for one in found if one.commanded_by == "nominal rate loop"), None)


def _explains(one: ActuatorMismatch, limits: Thresholds) -> bool:
    return one.rms_fitted**2 <= (1.0 - limits.lag_followed_share) * one.spread**2
