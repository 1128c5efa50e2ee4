"""Compares measured rotor speeds with commanded ones: controller and motors without aerodynamics.

The rate loop turns commanded body rates into torques; the nominal one is the proportional loop of
the vehicle file. Flight controllers have integrators and filters that it lacks. So a difference
between commanded and measured rotor speeds does not mean that aerodynamics are missing. Here the
nominal rate loop, the mixer (torques to rotor thrusts) and the rotors' lag (a first-order delay)
compute rotor speeds from the logged commands and the measured body rates. By this comparison the
diagnosis chooses the model's input (commands or measured rotor speeds) and estimates the lag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from eval.quadrotor.continuous import INTEGRATORS
from eval.quadrotor.plant import Command, Plant, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.sampling import follow_lag, hold, interpolate, on_every_row
from suite.diagnose.data.steps import has_firmware_loop, step_s, wrench_difference
from suite.diagnose.evidence.view_means import means_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

LONGEST_LAG_S, LONGEST_DELAY_S, DELAYS_TRIED = 0.15, 0.06, 9
"""In the fit of the rotors: longest time constant and longest delay of commands [s], and number of
delays that are tried before the best is refined."""
LONGEST_S = 60.0
"""Flight time after which no more flights are compared [s]; more adds little."""
RATE_LOOP, LOGGED = "nominal rate loop", "logged motor commands"
"""What commands rotor speeds: the rate loop at the measured body rates, or the log's commands."""
LAG = "motor_lag"
"""Name of the rotor lag in the catalogue of effects."""
LEAST_P = 1e-12
"""Lower limit of a p-value, as no distribution is exact so far from its middle."""


class TestedEffect(NamedTuple):
    """An effect that a separate test named, not the search: rotor lag or random wind."""

    name: str
    values: Any
    """The effect's entry in a vehicle file."""
    parameters: Mapping[str, Any]
    """Value, unit and 95 % interval of each parameter, as in diagnosis.json."""
    gap_removed: float | None
    """Share of the gap that the effect explains."""
    p_value: float
    view: str
    """Name of the source in which it was found."""

    def is_in(self, vehicle: Vehicle) -> bool:
        """Return whether the file of `vehicle` has this effect, with values in the intervals."""
        values = vehicle.effects.get(self.name)
        spans = {name: entry["ci95"] for name, entry in self.parameters.items()}
        return values is not None and all(
            span is not None and span[0] <= getattr(values, name) <= span[1]
            for name, span in spans.items()
        )


class ActuatorMismatch(NamedTuple):
    """How measured rotor speeds differ from commanded ones; written to diagnosis.json as it is."""

    commanded_by: str
    """"nominal rate loop" or "logged motor commands"."""
    rms: float
    """RMS difference with the vehicle file's lag and delay [rad/s]."""
    spread: float
    """Standard deviation of the measured speeds about each rotor's mean [rad/s]."""
    time_constant: float
    """Time constant of the best-fitting lag [s]."""
    delay: float
    """Best-fitting delay of the commands, in addition to that lag [s]."""
    scale: tuple[float, ...]
    """Ratio of measured to commanded speed of each rotor, with that lag and delay."""
    rms_fitted: float
    """RMS difference with that lag, delay and scale [rad/s]."""
    rms_own: float
    """RMS difference with the vehicle file's lag, and its best delay and scales [rad/s]."""
    thrust: tuple[float, float]
    """Mean and standard deviation of measured minus commanded thrust over nominal mass [m/s^2]."""
    turn: tuple[tuple[float, float], ...]
    """The same of the angular acceleration about body x, y and z each [rad/s^2]."""
    followed: float
    """Share of the speeds' variance that the commands explain, with the vehicle file's lag and
    delay."""


class _Stretch(NamedTuple):
    """N rows of a flight without a hole (a long time without a value)."""

    commanded: Callable[[float], np.ndarray]
    """Delay of the commands [s] -> (S, 4) rotor speeds that are commanded in each step [rad/s]."""
    row: np.ndarray
    """(N,) number of the time step at whose start each measured row was taken."""
    measured: np.ndarray
    """(N, 4) measured rotor speeds [rad/s]."""


def actuator_mismatches(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> list[ActuatorMismatch]:
    """Compare measured rotor speeds with those by the rate loop and those by motor commands.

    Returned are the comparisons that the logs allow.
    """
    mismatches = (_mismatch(source, logs, vehicle, limits) for source in (RATE_LOOP, LOGGED))
    return [mismatch for mismatch in mismatches if mismatch is not None]


def _stretches(
    log: FlightLog, plant: Plant, commanded_by: str, limits: Thresholds
) -> list[_Stretch]:
    """Return the stretches of `log` that have measured and commanded rotor speeds."""
    command = log.command if commanded_by == RATE_LOOP else log.rotor_speed_cmd
    if log.rotor_speed is None or command is None:
        return []

    def commanded(step_time_s: np.ndarray, loop_rate_b: np.ndarray, delay_s: float) -> np.ndarray:
        delayed = hold(step_time_s - delay_s, log.time_s, command)
        if commanded_by == LOGGED:
            return delayed
        # The loop uses the current rates; only the command is delayed.
        wanted = wanted_speed(plant, Command(delayed[:, 0], delayed[:, 1:]), loop_rate_b)
        return np.asarray(wanted)

    dt, stretches = plant.dt, []
    rate_b = on_every_row(log, limits).rate_b
    complete = np.isfinite(log.rotor_speed).all(axis=1) & np.isfinite(rate_b).all(axis=1)
    complete_rows = np.flatnonzero(complete)
    holes = np.flatnonzero(np.diff(log.time_s[complete_rows]) > limits.longest_hole_s)
    for rows in np.split(complete_rows, holes + 1):
        if not len(rows):
            continue
        time_s = log.time_s[rows] - log.time_s[rows[0]]
        if time_s[-1] < 4.0 * limits.lag_settled_s:  # too short next to the time left out below
            continue
        step_time_s = log.time_s[rows[0]] + dt * np.arange(int(time_s[-1] / dt) + 1)
        loop_rate_b = interpolate(step_time_s, log.time_s, log.rate_b)
        speed_after = partial(commanded, step_time_s, loop_rate_b)
        if not np.isfinite(speed_after(0.0)).all():
            continue
        step = np.round(time_s / dt).astype(int)
        # The rotor speeds before the stretch are unknown; their effect decays first.
        settled = (step * dt >= limits.lag_settled_s) & (step <= len(step_time_s))
        stretches.append(_Stretch(speed_after, step[settled], log.rotor_speed[rows[settled]]))
    return stretches


def _mismatch(
    commanded_by: str, logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds
) -> ActuatorMismatch | None:
    """Fit lag, delay and scales, and return how rotor speeds differ; None if no log has both."""
    dt, stretches = step_s(vehicle), list[_Stretch]()
    plant = make_plant(vehicle, dt)
    own_delay, own_lag = float(plant.constants.delay), float(plant.constants.time_constant)
    for log in logs:
        if sum(int(np.ptp(one.row)) for one in stretches) * dt < LONGEST_S:
            stretches += _stretches(log, plant, commanded_by, limits)
    if not stretches:
        return None
    measured = np.concatenate([stretch.measured for stretch in stretches])

    def commanded(delay: float) -> list[np.ndarray]:
        return [stretch.commanded(delay) for stretch in stretches]

    def lagged(speeds: Sequence[np.ndarray], time_constant: float) -> np.ndarray:
        pairs = zip(speeds, stretches, strict=True)
        return np.concatenate([_at_rows(speed, s.row, dt, time_constant) for speed, s in pairs])

    def scales(speed: np.ndarray) -> np.ndarray:
        return (speed * measured).sum(0) / np.maximum((speed**2).sum(0), 1e-9)

    def squared_error(speeds: Sequence[np.ndarray], time_constant: float) -> float:
        speed = lagged(speeds, time_constant)
        return float(((measured - scales(speed) * speed) ** 2).mean())

    def best_lag(delay: float) -> tuple[float, float]:
        """Return the mean squared error with the best lag, and that lag [s]."""
        cost = partial(squared_error, commanded(delay))
        best = minimize_scalar(
            cost, bounds=(0.0, LONGEST_LAG_S), method="bounded", options={"xatol": 1e-4}
        )
        return min((float(best.fun), float(best.x)), (cost(0.0), 0.0))

    # Best delay and lag together, and the best delay for the vehicle file's lag.
    delay, _ = _best_delay(lambda delay: best_lag(delay)[0])
    _, time_constant = best_lag(delay)
    _, own_error = _best_delay(lambda delay: squared_error(commanded(delay), own_lag))
    own = lagged(commanded(own_delay), own_lag)
    fitted = lagged(commanded(delay), time_constant)
    scale = scales(fitted)
    thrust, turn = wrench_difference(measured, own, vehicle)
    rms, spread = _rms(measured - own), _rms(measured - measured.mean(axis=0))
    return ActuatorMismatch(
        commanded_by=commanded_by,
        rms=rms,
        spread=spread,
        time_constant=time_constant,
        delay=delay,
        scale=tuple(float(s) for s in scale),
        rms_fitted=_rms(measured - scale * fitted),
        rms_own=float(np.sqrt(own_error)),
        thrust=(float(thrust.mean()), float(thrust.std())),
        turn=tuple((float(t.mean()), float(t.std())) for t in turn.T),
        followed=1.0 - (rms / max(spread, 1e-9)) ** 2,
    )


def _best_delay(cost: Callable[[float], float]) -> tuple[float, float]:
    """Return the delay of the commands with the smallest `cost` [s], and that cost."""
    grid = np.linspace(0.0, LONGEST_DELAY_S, DELAYS_TRIED)
    best_index = int(np.argmin([cost(delay) for delay in grid]))
    bounds = (grid[max(best_index - 1, 0)], grid[min(best_index + 1, len(grid) - 1)])
    options = {"xatol": 2e-4}
    refinement = minimize_scalar(cost, bounds=bounds, method="bounded", options=options)
    lowest, undelayed = float(refinement.fun), cost(0.0)
    return (0.0, undelayed) if undelayed <= lowest else (float(refinement.x), lowest)


def _at_rows(
    speed: np.ndarray, step_of_row: np.ndarray, dt: float, time_constant: float
) -> np.ndarray:
    """Return rotor speeds (N, 4) behind commanded ones (S, 4) by a lag, at the steps of N rows."""
    # The speed at the end of step k is that at the start of step k + 1.
    return np.concatenate([speed[:1], follow_lag(speed, dt, time_constant)])[step_of_row]


def _rms(values: np.ndarray) -> float:
    """Return the root mean square of all `values`."""
    return float(np.sqrt((values**2).mean()))


def rotors_are_input(logs: Sequence[FlightLog], drive: str, vehicle: Vehicle) -> bool:
    """Return whether measured rotor speeds are the model's input, and not the commands.

    `drive` is the user's choice: "commands", "motors" or "auto" (commands where possible).

    Raises:
        ValueError: for an unknown `drive`, or one that the logs or the rate loop do not allow.
    """
    commands = all(log.command is not None for log in logs)
    motors = all(log.rotor_speed is not None for log in logs)
    if drive not in ("auto", "commands", "motors"):
        raise ValueError(f"drive = {drive!r}; allowed: auto, commands, motors")
    if not commands and not motors:
        raise ValueError(
            "some flights have commands only and some rotor speeds only; diagnose each kind alone"
        )
    if (drive == "commands" and not commands) or (drive == "motors" and not motors):
        raise ValueError(f"drive = {drive!r}, but not every flight has them")
    if has_firmware_loop(vehicle) and (drive == "commands" or not motors):
        raise ValueError(
            f"{vehicle.name}: no log holds the state of its {vehicle.controller.kind} rate loop "
            "at the start of a stretch, so commands cannot be the input of rollouts; give "
            "flights with measured rotor speeds (--drive motors), or a vehicle with a controller "
            "of kind p"
        )
    return drive == "motors" or not commands or has_firmware_loop(vehicle)


def integrator_of(logs: Sequence[FlightLog], integrator: str) -> str:
    """Return the integrator of the simulation that made `logs`, "continuous" or "euler".

    `integrator` is the user's choice; with "auto" it is what all logs state, else "continuous".

    Raises:
        ValueError: for an unknown `integrator`.
    """
    if integrator in INTEGRATORS:
        return integrator
    if integrator != "auto":
        allowed = ", ".join(("auto", *INTEGRATORS))
        raise ValueError(f"integrator = {integrator!r}; allowed: {allowed}")
    return "euler" if {log.integrator for log in logs} == {"euler"} else "continuous"


def flown_by_other_controller(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> bool:
    """Return whether the measured rotor speeds contradict the nominal rate loop.

    The loop is computed at the measured rates, so aerodynamics do not count as a difference.
    """
    dt, plant = step_s(vehicle), make_plant(vehicle, step_s(vehicle))
    delay, lag = float(plant.constants.delay), float(plant.constants.time_constant)
    error, variation, count = 0.0, 0.0, 0
    for log in logs:
        for stretch in _stretches(log, plant, RATE_LOOP, limits):
            commanded = _at_rows(stretch.commanded(delay), stretch.row, dt, lag)
            # Means over 0.1 s average the noise.
            bin_of_row = (stretch.row * dt / 0.1).astype(int)
            both = np.concatenate([stretch.measured, commanded], axis=1)
            measured, by_loop = np.split(means_of(both, bin_of_row), 2, axis=1)
            error += float(((measured - by_loop) ** 2).sum())
            variation += float(((measured - measured.mean(axis=0)) ** 2).sum())
            count += measured.size
    negligible = count * limits.still_speed**2
    return bool(
        error > negligible and error > limits.fitted_loop_share**2 * max(variation, negligible)
    )


def find_rotor_lag(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> TestedEffect | None:
    """Return the rotors' lag where it differs significantly from that of `vehicle`, else None.

    Flights without commands or rotor speeds are ignored, and those whose speeds the nominal rate
    loop does not explain: a firmware's filters are not a lag.
    """
    if has_firmware_loop(vehicle):
        return None
    known = float(make_plant(vehicle, step_s(vehicle)).constants.time_constant)
    by_flight = [_mismatch(RATE_LOOP, [log], vehicle, limits) for log in logs if not log.partial]
    unexplained = 1.0 - limits.lag_followed_share
    mismatches = [
        mismatch
        for mismatch in by_flight
        if mismatch is not None and mismatch.rms_fitted**2 <= unexplained * mismatch.spread**2
    ]
    if len(mismatches) < limits.lag_least_flights:
        return None
    lags = np.array([mismatch.time_constant for mismatch in mismatches])
    half_step = 0.5 * step_s(vehicle)
    standard_error = float(lags.std(ddof=1)) / np.sqrt(len(lags))
    half_width = float(stats.t.ppf(0.975, len(lags) - 1)) * standard_error + half_step
    difference = float(abs(lags.mean() - known))
    own_error = sum(mismatch.rms_own**2 for mismatch in mismatches)
    fitted_error = sum(mismatch.rms_fitted**2 for mismatch in mismatches)
    closed = 1.0 - fitted_error / max(own_error, 1e-12)
    t = (difference - half_step) / max(standard_error, 1e-9)
    p_value = max(float(2.0 * stats.t.sf(t, len(lags) - 1)), LEAST_P)
    if p_value > limits.name_p_value or closed < limits.lag_closed_share:
        return None
    lag, low = float(lags.mean()), max(float(lags.mean()) - half_width, 0.0)
    entry = {"value": lag, "unit": "s", "ci95": [low, lag + half_width], "file": known}
    parameters = {"time_constant": entry}
    return TestedEffect(LAG, EFFECTS[LAG].values(lag), parameters, closed, p_value, "commands")
