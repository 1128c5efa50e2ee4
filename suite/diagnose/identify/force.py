"""The force on the body, and the nominal rate loop, by what was commanded and measured.

Force: thrust by what drove the motors, and drag, under the measured attitude. Where no flight has
an attitude, thrust is along what the path's acceleration and gravity make up together (differential
flatness; Mellinger and Kumar 2011), and only its size is asked for.

The loop is flown by its commands alone and compared with the gyro (output error; Ljung 1999, Sec.
4.3): measured rates in the loop's own equation would make the gyro's noise look like slower gains.
Per axis, `lag d2w/dt2 + dw/dt + K w = K rate_cmd(t - delay) + lag de/dt + e`, where `e` is what is
missed of `w x J w`, since the controller makes up for it by rotors that lag, and what moving air
turns besides. It is that of the rates without it (one step of Picard's iteration); rotor speeds are
taken to change by little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.drive import (
    MotorGuess,
    delayed,
    filled,
    lagged,
    motor_thrusts,
    rotor_thrusts,
)
from suite.diagnose.identify.fit import Fitted, Given, Rows, Unknown, fit
from suite.diagnose.identify.grid import STEP_S, FlightGrid, Windows, blocks_of, over, windows_of

WIDTH_S = 0.4
BLOCK_S = 2.0
DRIVEN = {"pwm": "pwm", "rotors": "rotor_speed"}
"""By drive, what pushes; under all others the commanded thrust."""
SLOW = 2.0
"""Without an attitude, windows faster than this are left out: a drag across the thrust would add to
its size, by 0.3 % at this speed and 0.4 1/s [m/s]."""
LEVEL = np.array([True, True, False])
"""A flight's trim of the attitude is free; along z it would be the thrust."""


def unknowns_of(
    drive: str,
    guess: MotorGuess,
    voltage: bool,
    drag: Sequence[float],
    leaning: bool = False,
    scale: float = 0.0,
) -> list[Unknown]:
    """Return the numbers of the force; their starts are those of the vehicle file.

    Args:
        drive: one of `drive.DRIVES`.
        guess: of the motors, where `drive` is pwm.
        voltage: whether the flights have one.
        drag: of the vehicle file [1/s].
        leaning: whether no flight has an attitude.
        scale: logarithm of the thrust's scale in the vehicle file.
    """
    floor = 0.004 if leaning else 0.001
    unknowns = [Unknown("thrust", scale, -2.0, 2.0, 0.25, 1e-3, floor)]
    if drive == "pwm":
        unknowns.append(Unknown("curve", guess.curve, -0.1, 1.0, 0.35, 1e-2, 0.02))
        if voltage:
            unknowns.append(Unknown("battery", guess.battery, 0.0, 4.0, 0.6, 1e-2, 0.02))
    for axis, start in list(zip("xyz", drag, strict=True))[2 if leaning else 0 :]:
        unknowns.append(Unknown(f"drag_{axis}", start, -2.0, 5.0, 0.25, 1e-2, 0.004))
    return unknowns


def fit_force(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    drive: str,
    guess: MotorGuess,
    unknowns: Sequence[Unknown],
    lag_s: float,
    delay_s: float,
    fixed: Mapping[str, float],
) -> Fitted:
    """Return the thrust's and the drag's numbers.

    Args:
        flights: on their grids, with positions; all with an attitude, or none.
        vehicle: mass, rotors.
        drive: one of `drive.DRIVES`.
        guess: of the motors, where `drive` is pwm.
        unknowns: from `unknowns_of`.
        lag_s: of the rotors [s].
        delay_s: of the commands [s].
        fixed: numbers that are not looked for.
    """
    names = [unknown.name for unknown in unknowns]
    driven = DRIVEN.get(drive, "thrust_cmd")
    prepared = [_prepared(flight, driven) for flight in flights]

    def misses(value: np.ndarray) -> list[Rows]:
        told = {**fixed, **dict(zip(names, value, strict=True))}
        drag = np.array([told.get(f"drag_{axis}", 0.0) for axis in "xyz"])
        out = []
        for flight, known in zip(flights, prepared, strict=True):
            force = force_of(flight, vehicle, drive, guess, told, lag_s, delay_s)
            pushed = known.pushed(force)
            level = LEVEL[-pushed.shape[1] :]
            out.append(Rows(known.felt - pushed + known.drag_b @ drag, known.block, level))
        return out

    return fit(misses, unknowns)


def force_of(
    flight: FlightGrid,
    vehicle: Vehicle,
    drive: str,
    guess: MotorGuess,
    told: Mapping[str, float],
    lag_s: float,
    delay_s: float,
) -> np.ndarray:
    """Return the collective thrust per mass (G,) [m/s^2] under the numbers `told`."""
    scale = float(np.exp(told.get("thrust", 0.0)))
    if drive == "pwm":
        return (
            scale
            * motor_thrusts(flight, with_told(guess, told), lag_s, delay_s).sum(axis=1)
            / vehicle.mass
        )
    if drive == "rotors":
        thrust = rotor_thrusts(flight, vehicle.rotors.thrust_coefficient)
        return scale * thrust.sum(axis=1) / vehicle.mass
    command = delayed(flight.known["thrust_cmd"], delay_s)
    return scale * lagged(np.sqrt(np.maximum(command, 0.0))[:, None], lag_s)[:, 0] ** 2


def with_told(guess: MotorGuess, told: Mapping[str, float]) -> MotorGuess:
    """Return the guess with the shape that was told; its size is the number `thrust`."""
    shape = {key: float(told[key]) for key in ("curve", "battery") if key in told}
    return guess._replace(**shape)


class _Prepared(NamedTuple):
    """What does not change from trial to trial: windows, and the measured sides."""

    windows: Windows
    up_w: np.ndarray | None
    """(G, 3) body z; None where only the force's size is asked for."""
    axes_w: np.ndarray
    """(K, 3, C) the channels' axes: those of the body in the window's middle."""
    felt: np.ndarray
    """(K, C) specific force along them [m/s^2]."""
    drag_b: np.ndarray
    """(K, C, 3) what a unit of drag along each body axis pulls along them."""
    block: np.ndarray
    """(K,) number of the window's block."""

    def pushed(self, force: np.ndarray) -> np.ndarray:
        """Return the means (K, C) of a thrust per mass (G,) along the channels."""
        if self.up_w is None:
            return over(self.windows, force[:, None])
        pushed_w = over(self.windows, self.up_w * force[:, None])
        return np.einsum("kji,kj->ki", self.axes_w, pushed_w)


def _prepared(flight: FlightGrid, driven: str) -> _Prepared:
    moved = "vel_w" if flight.has("vel_w") else "pos_w"
    attitude = ("rot_w",) if flight.has("rot_w") else ()
    windows = windows_of(flight, WIDTH_S, (moved, driven, *attitude))
    vel_w = flight.known["vel_w"] if moved == "vel_w" else _velocity(flight.known["pos_w"])
    if not attitude:
        speed = over(windows, np.linalg.norm(np.nan_to_num(vel_w), axis=1)[:, None])[:, 0]
        windows = windows._replace(first=windows.first[speed < SLOW])
    weight = windows.slope if moved == "vel_w" else windows.bend
    felt_w = over(windows, flight.known[moved], weight) + [0.0, 0.0, GRAVITY]
    block = blocks_of(flight, windows, BLOCK_S)
    if not attitude:
        size = np.linalg.norm(felt_w, axis=1, keepdims=True)
        up_w = felt_w / size
        along = (over(windows, np.nan_to_num(vel_w)) * up_w).sum(axis=1)
        drag_b = along[:, None, None] * np.array([0.0, 0.0, 1.0])
        return _Prepared(windows, None, up_w[:, :, None], size, drag_b, block)
    rot_w = flight.known["rot_w"]
    axes_w = rot_w[windows.middle]
    felt = np.einsum("kji,kj->ki", axes_w, felt_w)
    vel_b = np.einsum("gji,gj->gi", rot_w, vel_w)
    pulled_w = over(windows, rot_w * np.nan_to_num(vel_b)[:, None, :])
    drag_b = np.einsum("kji,kjd->kid", axes_w, pulled_w)
    return _Prepared(windows, rot_w[:, :, 2], axes_w, felt, drag_b, block)


def _velocity(pos_w: np.ndarray) -> np.ndarray:
    """Return the slope over 0.1 s, for the drag only."""
    from suite.diagnose.identify.grid import STEP_S

    reach = round(0.05 / STEP_S)
    out = np.full_like(pos_w, np.nan)
    out[reach:-reach] = (pos_w[2 * reach :] - pos_w[: -2 * reach]) / (2 * reach * STEP_S)
    return out


LOOP_WIDTH_S = 0.06
FREE = np.array([True, True, True])


def gains() -> list[Unknown]:
    """Return the loop's gains as logarithms of ratios to the start's."""
    return [Unknown(f"gain_{axis}", 0.0, -3.0, 3.0, 0.35, 1e-2, 0.02) for axis in "xyz"]


def couplings(vehicle: Vehicle) -> list[Unknown]:
    """Return how much two axes' rates turn the third, `(J_z - J_y) / J_x` and so on.

    They are of no use but for the others' sake: the inertia behind them may be wrong.
    """
    x, y, z = vehicle.inertia
    starts = ((z - y) / x, (x - z) / y, (y - x) / z)
    both = zip("xyz", starts, strict=True)
    return [Unknown(f"coupling_{a}", start, -1.0, 1.0, 0.2, 1e-2) for a, start in both]


def air_torques(flights: Sequence[FlightGrid]) -> list[Unknown]:
    """Return how much moving air turns the body, acceleration over speed (flapping) [1/(m s)].

    They are of no use but for the others' sake, and none where the velocity is not known.
    """
    if not all(flight.has("vel_w", "rot_w") for flight in flights):
        return []
    return [Unknown(f"air_{axis}", 0.0, -20.0, 20.0, 2.0, 1e-2) for axis in "xy"]


def fit_loop(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
    doubted: Given | None = None,
) -> Fitted:
    """Return gains, lag and delay; a constant rate of each flight is free (bias, trim).

    Args:
        flights: with rates and commanded rates.
        vehicle: gains to start from, and how often the loop looks.
        unknowns: `gains`, `couplings` and `torque.lag_and_delay`, or some of them.
        fixed: the others.
        doubted: those of `unknowns` that another fit has told.
    """
    names = [unknown.name for unknown in unknowns]
    prepared = []
    for flight in flights:
        windows = windows_of(flight, LOOP_WIDTH_S, ("rate_b", "rate_cmd_b"))
        rates = over(windows, flight.known["rate_b"])
        prepared.append((windows, rates, blocks_of(flight, windows, BLOCK_S)))

    def misses(value: np.ndarray) -> list[Rows]:
        told = {**fixed, **dict(zip(names, value, strict=True))}
        return [
            Rows(rates - over(windows, followed(flight, vehicle, told)), block, FREE)
            for flight, (windows, rates, block) in zip(flights, prepared, strict=True)
        ]

    return fit(misses, unknowns, given=doubted)


def followed(flight: FlightGrid, vehicle: Vehicle, told: Mapping[str, float]) -> np.ndarray:
    """Return the rates (G, 3) of the loop under its commands alone [rad/s]."""
    from scipy.signal import cont2discrete, lfilter, lfilter_zi

    # The loop looks at rates that are half a period old on average: exp(-half s), to second order.
    half = 0.5 / vehicle.controller.frequency
    lag = max(told["lag"], 1e-4)
    wanted = filled(delayed(flight.known["rate_cmd_b"], told["late"] - told["lag"]))
    ratio = np.exp([told.get(f"gain_{axis}", 0.0) for axis in "xyz"])
    gains = np.asarray(vehicle.controller.rate_gain) * ratio

    def answer(pushes: np.ndarray, tops: Sequence[list[float]]) -> np.ndarray:
        out = np.empty_like(pushes)
        for k, (gain, top) in enumerate(zip(gains, tops, strict=True)):
            bottom = [lag + 0.5 * gain * half**2, 1.0 - gain * half, gain]
            found: Any = cont2discrete((top, bottom), STEP_S, method="foh")
            above, below = np.ravel(found[0]), found[1]
            state = lfilter_zi(above, below) * pushes[0, k]
            out[:, k] = lfilter(above, below, pushes[:, k], zi=state)[0]
        return out

    linear = answer(wanted, [[gain] for gain in gains])
    # The controller makes up for `w x J w` by rotors that lag.
    products = linear[:, [1, 2, 0]] * linear[:, [2, 0, 1]]
    coupled = products * [told[f"coupling_{axis}"] for axis in "xyz"]
    push = lagged(coupled, told["lag"]) - coupled
    if "air_x" in told:
        vel_b = filled(np.einsum("gji,gj->gi", flight.known["rot_w"], flight.known["vel_w"]))
        push[:, 0] += told["air_x"] * vel_b[:, 1]
        push[:, 1] -= told["air_y"] * vel_b[:, 0]
    return linear + answer(push, [[lag, 1.0]] * 3)
