"""Measured rotor speeds against those that the commands ask for: the actuators apart from the air.

Flight controllers have integrators and filters that the nominal rate loop has not, so that a
difference between commanded and measured rotor speeds is no missing physics of the air. Here the
nominal rate loop and mixer are asked, row by row at the measured rates, for the rotor speeds of the
logged commands, and the nominal lag follows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from eval.flight_log import FlightLog
from eval.mixer import mixer_matrix
from eval.plant import Command, make_plant, wanted_speed
from eval.vehicle import Vehicle
from suite.diagnose.windows import step_s

HOLE_S = 0.1
"""Where rows are further apart the rotors are started anew [s]."""
WARM_S = 0.2
"""What is left out after each start, for the lag [s]."""
LONGEST_S = 0.1
"""Largest lag and delay that are fitted [s]."""


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
    """Before it [s]."""
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


class _Stretch(NamedTuple):
    """Rows without a hole, on the vehicle's steps."""

    asked: np.ndarray
    """(S, 4) rotor speeds that are asked for in each step [rad/s]."""
    row: np.ndarray
    """(N,) step at whose start each measured row was taken."""
    measured: np.ndarray
    """(N, 4) [rad/s]."""


def actuators_apart(logs: Sequence[FlightLog], vehicle: Vehicle) -> list[Apart]:
    """Return how measured rotor speeds differ from what commands and logged motor commands ask.

    Args:
        logs: flights; those without measured rotor speeds do not count.
        vehicle: nominal values; of its effects those of the rotors do not count.

    Returns:
        None, one or two of them: what the logs allow.
    """
    found = []
    for asked_by, ask in (("nominal rate loop", _by_rate_loop), ("logged motor commands", _logged)):
        stretches = [part for log in logs for part in _stretches(log, vehicle, ask)]
        if stretches:
            found.append(_compare(asked_by, stretches, vehicle))
    return found


def _by_rate_loop(log: FlightLog, vehicle: Vehicle, at: np.ndarray) -> np.ndarray | None:
    if log.thrust_cmd is None or log.rate_cmd_b is None:
        return None
    command = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
    held = _held(command, log.time_s, at)
    rates = np.stack([_line(at, log.time_s, r) for r in log.rate_b.T], axis=-1)
    plant = make_plant(vehicle, step_s(vehicle), {})
    return np.asarray(wanted_speed(plant, Command(held[:, 0], held[:, 1:]), rates))


def _logged(log: FlightLog, vehicle: Vehicle, at: np.ndarray) -> np.ndarray | None:
    if log.rotor_speed_cmd is None:
        return None
    return _held(log.rotor_speed_cmd, log.time_s, at)


def _stretches(log: FlightLog, vehicle: Vehicle, ask: Any) -> list[_Stretch]:
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
        asked = ask(log, vehicle, at)
        if asked is None or not np.isfinite(asked).all():
            continue
        row = np.round(time / dt).astype(int)
        late = (row * dt >= WARM_S) & (row <= len(at))
        found.append(_Stretch(asked, row[late], log.rotor_speed[part[late]]))
    return found


def _compare(asked_by: str, stretches: Sequence[_Stretch], vehicle: Vehicle) -> Apart:
    dt, lag = step_s(vehicle), vehicle.rotors.time_constant
    measured = np.concatenate([part.measured for part in stretches])

    def followed(time_constant: float, delay: float) -> np.ndarray:
        return np.concatenate([_follow(part, dt, time_constant, delay) for part in stretches])

    def scales(asked: np.ndarray) -> np.ndarray:
        return (asked * measured).sum(0) / np.maximum((asked**2).sum(0), 1e-9)

    def cost(at: np.ndarray) -> float:
        asked = followed(*np.clip(at, 0.0, LONGEST_S))
        return float(((measured - scales(asked) * asked) ** 2).mean())

    nominal = followed(lag, 0.0)
    # A coarse grid first: lag and delay trade for each other, and the valley is bent.
    starts = [(tau, late) for tau in (0.0, 0.02, 0.05) for late in (0.0, 0.02)]
    begin = min(starts, key=lambda at: cost(np.array(at)))
    simplex = np.array([begin, (begin[0] + 0.01, begin[1]), (begin[0], begin[1] + 0.01)])
    options = {"initial_simplex": simplex, "xatol": 2e-4, "fatol": 1e-3, "maxiter": 80}
    best = minimize(cost, begin, method="Nelder-Mead", options=options)
    time_constant, delay = (float(v) for v in np.clip(best.x, 0.0, LONGEST_S))
    fitted = followed(time_constant, delay)
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


def _follow(part: _Stretch, dt: float, time_constant: float, delay: float) -> np.ndarray:
    """Return the rotor speeds (N, 4) at the rows after the delay and the lag."""
    steps = delay / dt
    index = np.maximum(np.arange(len(part.asked)) - steps, 0.0)
    low = np.floor(index).astype(int)
    share = (index - low)[:, None]
    late = (1.0 - share) * part.asked[low] + share * part.asked[np.minimum(low + 1, len(low) - 1)]
    left = np.exp(-dt / time_constant) if time_constant > 1e-6 else 0.0
    follows = np.asarray(lfilter([1.0 - left], [1.0, -left], late, axis=0, zi=left * late[:1])[0])
    # follows[k] is the speed at the end of step k, which is the start of step k + 1.
    speed = np.concatenate([late[:1], follows])
    return speed[part.row]


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
