"""Measured rotor speeds against those that the commands ask for: the actuators apart from the air.

Flight controllers have integrators and filters that the nominal rate loop has not, so that a
difference between commanded and measured rotor speeds is no missing physics of the air. Here the
nominal rate loop and mixer are asked, row by row at the measured rates, for the rotor speeds of the
logged commands, and the nominal lag follows them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import step_s

HOLE_S = 0.1
"""Where rows are further apart the rotors are started anew [s]."""
WARM_S = 0.2
"""What is left out after each start, for the lag [s]."""
LONGEST_LAG_S = 0.15
LONGEST_DELAY_S = 0.06
DELAYS = 9
"""Delays that are tried before the best is refined."""
ENOUGH_S = 60.0
"""Of flight; what is logged beyond does not count [s]."""


class Apart(NamedTuple):
    """How measured rotor speeds differ from what was asked for."""

    asked_by: str
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
    """Measured over asked, by rotor, beside that lag and delay."""
    rms_fitted: float
    """Of what they leave [rad/s]."""
    thrust: tuple[float, float]
    """Mean and spread of measured minus asked collective thrust, over nominal mass [m/s^2]."""
    turn: tuple[tuple[float, float], ...]
    """The same of the angular acceleration about x, y, z [rad/s^2]."""

    @property
    def followed(self) -> float:
        """Share of the speeds' variance that the nominal loop and lag give, 1 where all."""
        return 1.0 - (self.rms / max(self.spread, 1e-9)) ** 2


Ask = Callable[[float], np.ndarray]
"""Delay of the commands [s] -> (S, 4) rotor speeds that are asked for in each step [rad/s]."""


class _Stretch(NamedTuple):
    """Rows without a hole, on the vehicle's steps."""

    ask: Ask
    row: np.ndarray
    """(N,) step at whose start each measured row was taken."""
    measured: np.ndarray
    """(N, 4) [rad/s]."""


def actuators_apart(logs: Sequence[FlightLog], vehicle: Vehicle) -> list[Apart]:
    """Return how measured rotor speeds differ from what commands and logged motor commands ask.

    Args:
        logs: flights; those without measured rotor speeds do not count.
        vehicle: nominal values; of its effects none counts.

    Returns:
        None, one or two of them: what the logs allow.
    """
    found = []
    for asked_by, make in (
        ("nominal rate loop", _by_rate_loop),
        ("logged motor commands", _logged),
    ):
        stretches: list[_Stretch] = []
        for log in logs:
            if sum(len(part.row) for part in stretches) * step_s(vehicle) < ENOUGH_S:
                stretches += _stretches(log, vehicle, make)
        if stretches:
            found.append(_compare(asked_by, stretches, vehicle))
    return found


def _by_rate_loop(log: FlightLog, vehicle: Vehicle, at: np.ndarray) -> Ask | None:
    if log.thrust_cmd is None or log.rate_cmd_b is None:
        return None
    command = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
    rates = np.stack([_line(at, log.time_s, r) for r in log.rate_b.T], axis=-1)
    plant = make_plant(vehicle, step_s(vehicle), {})

    def ask(delay: float) -> np.ndarray:
        # The loop knows the rates of now; what is late is the command.
        late = _held(command, log.time_s, at - delay)
        return np.asarray(wanted_speed(plant, Command(late[:, 0], late[:, 1:]), rates))

    return ask


def _logged(log: FlightLog, vehicle: Vehicle, at: np.ndarray) -> Ask | None:
    command = log.rotor_speed_cmd
    if command is None:
        return None
    return lambda delay: _held(command, log.time_s, at - delay)


def _stretches(
    log: FlightLog,
    vehicle: Vehicle,
    make: Callable[[FlightLog, Vehicle, np.ndarray], Ask | None],
) -> list[_Stretch]:
    if log.rotor_speed is None:
        return []
    dt, found = step_s(vehicle), []
    good = np.isfinite(log.rotor_speed).all(axis=1) & np.isfinite(log.rate_b).all(axis=1)
    rows = np.flatnonzero(good)
    for part in np.split(rows, np.flatnonzero(np.diff(log.time_s[rows]) > HOLE_S) + 1):
        if not len(part):
            continue
        time = log.time_s[part] - log.time_s[part[0]]
        if time[-1] < 4.0 * WARM_S:
            continue
        at = log.time_s[part[0]] + dt * np.arange(int(time[-1] / dt) + 1)
        ask = make(log, vehicle, at)
        if ask is None or not np.isfinite(ask(0.0)).all():
            continue
        row = np.round(time / dt).astype(int)
        late = (row * dt >= WARM_S) & (row <= len(at))
        found.append(_Stretch(ask, row[late], log.rotor_speed[part[late]]))
    return found


def _compare(asked_by: str, stretches: Sequence[_Stretch], vehicle: Vehicle) -> Apart:
    dt, lag = step_s(vehicle), vehicle.rotors.time_constant
    measured = np.concatenate([part.measured for part in stretches])

    def followed(asked: Sequence[np.ndarray], time_constant: float) -> np.ndarray:
        parts = zip(asked, stretches, strict=True)
        return np.concatenate([_follow(a, part.row, dt, time_constant) for a, part in parts])

    def scales(speed: np.ndarray) -> np.ndarray:
        return (speed * measured).sum(0) / np.maximum((speed**2).sum(0), 1e-9)

    def best_lag(delay: float) -> tuple[float, float]:
        """Return the mean squared error that the best lag leaves, and the lag."""
        asked = [part.ask(delay) for part in stretches]

        def cost(time_constant: float) -> float:
            speed = followed(asked, time_constant)
            return float(((measured - scales(speed) * speed) ** 2).mean())

        options = {"xatol": 1e-4}
        best = minimize_scalar(cost, bounds=(0.0, LONGEST_LAG_S), method="bounded", options=options)
        return min((float(best.fun), float(best.x)), (cost(0.0), 0.0))

    tried = np.linspace(0.0, LONGEST_DELAY_S, DELAYS)
    place = int(np.argmin([best_lag(delay)[0] for delay in tried]))
    near = (tried[max(place - 1, 0)], tried[min(place + 1, DELAYS - 1)])
    options = {"xatol": 2e-4}
    refined = minimize_scalar(
        lambda delay: best_lag(delay)[0], bounds=near, method="bounded", options=options
    )
    delay = float(refined.x)
    if best_lag(0.0)[0] <= float(refined.fun):
        delay = 0.0
    _, time_constant = best_lag(delay)
    nominal = followed([part.ask(0.0) for part in stretches], lag)
    fitted = followed([part.ask(delay) for part in stretches], time_constant)
    scale = scales(fitted)
    thrust, turn = _wrench_difference(measured, nominal, vehicle)
    return Apart(
        asked_by=asked_by,
        rms=_rms(measured - nominal),
        spread=_rms(measured - measured.mean(axis=0)),
        time_constant=time_constant,
        delay=delay,
        scale=tuple(float(s) for s in scale),
        rms_fitted=_rms(measured - scale * fitted),
        thrust=(float(thrust.mean()), float(thrust.std())),
        turn=tuple((float(t.mean()), float(t.std())) for t in turn.T),
    )


def _follow(asked: np.ndarray, row: np.ndarray, dt: float, time_constant: float) -> np.ndarray:
    """Return the rotor speeds (N, 4) at the rows after the lag."""
    left = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    follows = np.asarray(lfilter([1.0 - left], [1.0, -left], asked, axis=0, zi=left * asked[:1])[0])
    # follows[k] is the speed at the end of step k, which is the start of step k + 1.
    return np.concatenate([asked[:1], follows])[row]


def _wrench_difference(
    measured: np.ndarray, asked: np.ndarray, vehicle: Vehicle
) -> tuple[np.ndarray, np.ndarray]:
    """Return thrust over mass (N,) and angular acceleration (N, 3) of measured minus asked."""
    rotors = vehicle.rotors
    ratio = rotors.torque_coefficient / rotors.thrust_coefficient
    mixer = mixer_matrix(np.array(rotors.position), np.array(rotors.spin), ratio)
    wrench = rotors.thrust_coefficient * (measured**2 - asked**2) @ mixer.T
    return wrench[:, 0] / vehicle.mass, wrench[:, 1:] / np.array(vehicle.inertia)


def _held(series: np.ndarray, time_s: np.ndarray, at: np.ndarray) -> np.ndarray:
    good = np.flatnonzero(np.isfinite(series).all(axis=1))
    if not len(good):
        return np.full((len(at), series.shape[1]), np.nan)
    held = np.searchsorted(time_s[good], at + 1e-7, side="right") - 1
    return series[good[np.maximum(held, 0)]]


def _line(at: np.ndarray, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    good = np.isfinite(values)
    return np.interp(at, time_s[good], values[good])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
