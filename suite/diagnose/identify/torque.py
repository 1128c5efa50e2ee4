"""The torque on the body under known motors: inertia, and the rotors' lag and delay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.identify.drive import delayed, lagged, torque_of
from suite.diagnose.identify.fit import Z95, Fitted, Given, Rows, Unknown, fit
from suite.diagnose.identify.force import BLOCK_S
from suite.diagnose.identify.grid import (
    ROTOR_NOISE,
    FlightGrid,
    Windows,
    blocks_of,
    over,
    windows_of,
)

WIDTH_S = 0.2
BAND = WIDTH_S / (2.0 * np.pi)
"""Torques are compared in windows of no mean, as changes within one: what a flight asks of the
motors slowly (trim, flapping at speed) turns nothing. Times this they are accelerations."""
SPEED_WIDTH_S = 0.16
LEVEL = np.array([False, False, False])

Thrusts = Callable[[FlightGrid, float, float, Mapping[str, float]], np.ndarray]
"""Rotor thrusts (G, 4) [N] of a flight, behind a lag and a delay [s], by the force's numbers."""
GIVEN = ("thrust", "curve", "battery")
"""The force's numbers that the torque is built on."""


def lag_and_delay(lag_s: float, delay_s: float) -> list[Unknown]:
    """Return the numbers of what lies between a command and the rotors' thrust.

    Slow flights tell how late it is in all, `late`, and not how much of that is the lag.
    """
    late = Unknown("late", lag_s + delay_s, -0.02, 0.3, 0.012, 1e-3, 0.0007)
    return [late, Unknown("lag", lag_s, 0.0, 0.3, 0.012, 1e-3, 0.0007)]


def unknowns_of(drive: str, lag_s: float, delay_s: float) -> list[Unknown]:
    """Return the numbers of the torque; all but lag and delay are logarithms of ratios.

    That of the inertia about z is over the other two's mean, which it follows where nothing tells
    it; and without known torques `yaw` is of what turns the body about z, over that inertia.
    """
    lags = lag_and_delay(lag_s, delay_s)
    axes = [Unknown(f"inertia_{a}", 0.0, -2.0, 2.0, 0.5, 1e-2, 0.015) for a in "xy"]
    room = 0.5 if drive == "torques" else 0.25
    axes.append(Unknown("inertia_z", 0.0, -1.0, 1.0, room, 1e-2, 0.015))
    if drive == "torques":
        return [*axes, *lags]
    yaw = Unknown("yaw", 0.0, -2.0, 2.0, 0.5, 1e-2, 0.015)
    return [*axes, yaw] if drive == "rotors" else [*axes, yaw, *lags]


def inertia_ratio(numbers: Mapping[str, float]) -> np.ndarray:
    """Return the logarithms (3,) of the inertia over the start's."""
    x, y, z = (numbers.get(f"inertia_{axis}", 0.0) for axis in "xyz")
    return np.array([x, y, 0.5 * (x + y) + z])


def fit_torque(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    drive: str,
    unknowns: Sequence[Unknown],
    thrusts: Thrusts | None,
    fixed: Mapping[str, float],
    held: Sequence[str] = (),
    doubted: Given | None = None,
) -> Fitted:
    """Return inertia, lag and delay by `dw/dt = J^-1 (tau - w x J w)`.

    Args:
        flights: on their grids, with body rates.
        vehicle: inertia and rotors to start from.
        drive: one of `drive.DRIVES`.
        unknowns: from `unknowns_of`.
        thrusts: of the rotors, under pwm and rotors.
        fixed: numbers that are not looked for.
        held: numbers that are left as they are, in doubt.
        doubted: numbers of the force among `fixed`, with their covariance.
    """
    doubted = doubted or Given()
    step = {"thrust": 1e-3}
    unknowns = [
        *unknowns,
        *(
            Unknown(name, fixed[name], -9.0, 9.0, 1.0, step.get(name, 1e-2))
            for name in doubted.names
        ),
    ]
    begun, names = unknowns, [unknown.name for unknown in unknowns]
    needs = {"pwm": "pwm", "rotors": "rotor_speed", "torques": "torque_cmd_b"}[drive]
    prepared = [_prepared(flight, needs) for flight in flights]
    inertia = np.asarray(vehicle.inertia)

    def misses(value: np.ndarray) -> list[Rows]:
        told = {**fixed, **dict(zip(names, value, strict=True))}
        out = []
        for flight, (windows, turned, block) in zip(flights, prepared, strict=True):
            model = _turning(flight, windows, vehicle, inertia, drive, told, thrusts)
            out.append(Rows(turned - model, block, LEVEL))
        return out

    late = [k for k, name in enumerate(names) if name == "late"]
    if late:
        best = _likeliest([unknown.start for unknown in unknowns], late[0], misses, prepared)
        unknowns = [u._replace(start=best) if u.name == "late" else u for u in unknowns]
        found = fit(misses, unknowns, held, doubted)
        return replace(found, unknowns=tuple(begun))
    if drive != "rotors":
        return fit(misses, unknowns, held, doubted)

    def shares(found: Fitted) -> np.ndarray:
        told = {**fixed, **dict(zip(names, found.value, strict=True))}
        return _shares_of_noise(
            lambda flight, windows: _turning(
                flight, windows, vehicle, inertia, drive, told, thrusts
            ),
            flights,
            [windows for windows, _, _ in prepared],
        )

    return undiluted(lambda left: fit(misses, unknowns, left, doubted), shares, held)


def undiluted(
    fitted: Callable[[Sequence[str]], Fitted],
    shares: Callable[[Fitted], np.ndarray],
    held: Sequence[str],
) -> Fitted:
    """Return a fit to measured rotor speeds without what their noise does to its slopes.

    Noise in what drives makes every slope smaller, by its share in the driving torque's variance
    (errors in variables; Fuller 1987, Sec. 1.1): the inertia seems larger, the yaw torque smaller.
    The share is known no better than to half of the correction. What stands at a limit, or is in
    more doubt than it may be, is left as it was.

    Args:
        fitted: the fit that leaves some numbers as they were.
        shares: (3,) of noise in the variance of the torque about each axis, in that fit.
        held: numbers that are left from the first.
    """
    held = list(held)
    while True:
        found = fitted(held)
        shift = np.log(np.maximum(1.0 - shares(found), TINY))
        move = {"inertia_x": shift[0], "inertia_y": shift[1], "yaw": -shift[2]}
        value, half = found.value.copy(), found.half_width.copy()
        covariance, doubted = found.covariance.copy(), []
        for k, unknown in enumerate(found.unknowns):
            if unknown.name not in move or not found.has(unknown.name):
                continue
            inside = unknown.low < value[k] < unknown.high
            value[k] += move[unknown.name]
            doubt = 0.5 * move[unknown.name]
            covariance[k, k] += doubt**2
            half[k] = np.hypot(half[k], Z95 * doubt)
            if not inside or half[k] > unknown.room:
                doubted.append(unknown.name)
        if not doubted:
            return replace(found, value=value, half_width=half, covariance=covariance)
        held += doubted


def _shares_of_noise(
    turning: Callable[[FlightGrid, Windows], np.ndarray],
    flights: Sequence[FlightGrid],
    windows: Sequence[Windows],
) -> np.ndarray:
    """Return the share (3,) of the rotor speeds' noise in the variance of `turning` (K, 3)."""
    noise, whole = np.zeros(3), np.zeros(3)
    for flight, places in zip(flights, windows, strict=True):
        speed = flight.known["rotor_speed"]
        other = {**flight.known, "rotor_speed": speed + flight.known[ROTOR_NOISE]}
        plain, noisy = turning(flight, places), turning(flight._replace(known=other), places)
        noise += ((noisy - plain) ** 2).sum(axis=0)
        whole += (plain**2).sum(axis=0)
    return np.minimum(noise / np.maximum(whole, TINY), 1.0)


def _likeliest(
    start: list[float], late: int, misses: Callable[[np.ndarray], list[Rows]], prepared: list
) -> float:
    """Return how late the model's turning is most like the measured one, whatever its size."""
    trials = np.array([start[late], *np.arange(0.0, 0.13, 0.012)])
    scores = []
    for trial in trials:
        value = np.array(start)
        value[late] = max(trial, 0.0)
        score = 0.0
        for rows, (_, turned, _) in zip(misses(value), prepared, strict=True):
            if not len(turned):
                continue
            model = turned - rows.value
            centred = model - np.median(model, axis=0), turned - np.median(turned, axis=0)
            size = np.sqrt((centred[0] ** 2).sum(axis=0) * (centred[1] ** 2).sum(axis=0))
            both = (centred[0] * centred[1]).sum(axis=0)
            score += float((both / np.maximum(size, 1e-12))[:2].sum())
        scores.append(score)
    return float(trials[int(np.argmax(scores))])


def fit_rotor_lag(flights: Sequence[FlightGrid], unknowns: Sequence[Unknown]) -> Fitted:
    """Return lag and delay of measured rotor speeds behind commanded ones."""
    names = [unknown.name for unknown in unknowns]
    prepared = []
    for flight in flights:
        windows = windows_of(flight, SPEED_WIDTH_S, ("rotor_speed", "rotor_speed_cmd"))
        measured = over(windows, flight.known["rotor_speed"])
        prepared.append((windows, measured, blocks_of(flight, windows, BLOCK_S)))
    level = np.ones(4, dtype=bool)

    def misses(value: np.ndarray) -> list[Rows]:
        told = dict(zip(names, value, strict=True))
        out = []
        for flight, (windows, measured, block) in zip(flights, prepared, strict=True):
            delay_s = told["late"] - told["lag"]
            command = delayed(flight.known["rotor_speed_cmd"], delay_s)
            out.append(Rows(measured - over(windows, lagged(command, told["lag"])), block, level))
        return out

    return fit(misses, unknowns)


def _prepared(flight: FlightGrid, driven: str) -> tuple[Windows, np.ndarray, np.ndarray]:
    windows = windows_of(flight, WIDTH_S, ("rate_b", driven))
    turned = BAND * over(windows, flight.known["rate_b"], windows.bend)
    return windows, turned, blocks_of(flight, windows, BLOCK_S)


def _turning(
    flight: FlightGrid,
    windows: Windows,
    vehicle: Vehicle,
    inertia: np.ndarray,
    drive: str,
    told: Mapping[str, float],
    thrusts: Thrusts | None,
) -> np.ndarray:
    """Return the mean angular accelerations (K, 3) over the windows [rad/s^2]."""
    rate = flight.known["rate_b"]
    true = inertia * np.exp(inertia_ratio(told))
    if drive == "torques":
        torque = lagged(
            delayed(flight.known["torque_cmd_b"], told["late"] - told["lag"]), told["lag"]
        )
    else:
        assert thrusts is not None
        # Measured rotor speeds are past their lag.
        lag_s, delay_s = (
            (0.0, 0.0) if drive == "rotors" else (told["lag"], told["late"] - told["lag"])
        )
        thrust = thrusts(flight, lag_s, delay_s, told)
        turning = np.exp(told.get("yaw", 0.0)) * true[2] / inertia[2]
        torque = torque_of(vehicle, thrust) * [1.0, 1.0, turning]
    acceleration = (torque - np.cross(rate, true * rate)) / true
    return BAND * over(windows, acceleration, windows.slope)
