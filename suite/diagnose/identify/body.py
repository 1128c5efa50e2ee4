"""Fits of `suite identify` to the force and the torque on the body.

Force: translation, given the measured attitude. Where no flight has an attitude, thrust is along
the path's acceleration less gravity, and only its size is compared (differential flatness;
Mellinger and Kumar 2011).

Torque: rotation, given the motors, as changes within a window.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suite.diagnose.data.view import WeakForm
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.identify.drive import Driven
from suite.diagnose.identify.fit import Z95, Fitted, Known, Rows, Unknown, fit
from suite.diagnose.identify.grid import IMU_ACC, LEANING, ROTOR_NOISE, FlightGrid

WIDTH_S = 0.4
BLOCK_S = 2.0
PUSHES = {"pwm": "pwm", "rotors": "rotor_speed"}
"""By drive, the signal that gives the thrust; for all others the commanded thrust."""
TURNS = {**PUSHES, "torques": "torque_cmd_b"}
"""By drive, the signal that gives the torque."""
SLOW = 2.0
"""Without an attitude, windows faster than this are left out: a drag across the thrust would add to
its size, by 0.3 % at this speed and 0.4 1/s [m/s]."""
LEVEL = np.array([True, True, False])
"""A flight's trim of the attitude is free; along z it would be the thrust."""


def unknowns_of_force(
    driven: Driven, voltage: bool, leaning: bool = False, scale: float = 0.0
) -> list[Unknown]:
    """Return the numbers of the force; their starts are those of the vehicle file.

    Args:
        driven: the start.
        voltage: whether the flights have one.
        leaning: whether no flight has an attitude.
        scale: logarithm of the thrust's scale in the vehicle file.
    """
    floor = 0.004 if leaning else 0.001
    unknowns = [Unknown("thrust", scale, -2.0, 2.0, 0.25, 1e-3, floor)]
    if driven.drive == "pwm":
        unknowns.append(Unknown("curve", driven.curve, -0.1, 1.0, 0.35, 1e-2, 0.02))
        if voltage:
            unknowns.append(Unknown("battery", driven.battery, 0.0, 4.0, 0.6, 1e-2, 0.02))
    for axis, start in list(zip("xyz", driven.drag({}), strict=True))[2 if leaning else 0 :]:
        unknowns.append(Unknown(f"drag_{axis}", start, -2.0, 5.0, 0.25, 1e-2, 0.004))
    return unknowns


def fit_force(
    flights: Sequence[FlightGrid],
    driven: Driven,
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
) -> Fitted:
    """Return the thrust's and the drag's numbers.

    Args:
        flights: on their grids, with positions; all with an attitude, or none.
        driven: the start.
        unknowns: from `unknowns_of_force`.
        fixed: numbers that are not fitted, `lag` and `late` among them.
    """
    return fit(together([_force(flight, driven) for flight in flights], unknowns, fixed), unknowns)


Residuals = Callable[[Mapping[str, float]], Rows]
"""From all numbers to the residuals of one flight."""


def together(
    residuals: Sequence[Residuals], unknowns: Sequence[Unknown], fixed: Mapping[str, float]
) -> Callable[[np.ndarray], list[Rows]]:
    """Return the residuals of all flights by the values of `unknowns`, with the numbers `fixed`."""
    names = [unknown.name for unknown in unknowns]

    def of(value: np.ndarray) -> list[Rows]:
        numbers = {**fixed, **dict(zip(names, value, strict=True))}
        return [one(numbers) for one in residuals]

    return of


def _force(flight: FlightGrid, driven: Driven) -> Residuals:
    pushes = PUSHES.get(driven.drive, "thrust_cmd")
    moved = next(name for name in (IMU_ACC, "vel_w", "pos_w") if flight.has(name))
    leaning = not flight.has("rot_w")
    needs = (moved, pushes, LEANING if leaning else "rot_w")
    form, rows = flight.form(WIDTH_S, needs), flight.rows(turned=True)
    path = flight.form(WIDTH_S, needs, slope=True) if moved == "pos_w" else form
    if leaning:
        slow = form.mean @ np.linalg.norm(rows.vel_w, axis=1) < SLOW
        form, path = form.take(slow), path.take(slow)
    takes = path.mean if moved == IMU_ACC else path.change
    measured = takes @ np.nan_to_num(flight.known[moved])
    to_body = np.swapaxes(rows.rot_w[form.middle_row], 1, 2)
    axes = slice(2 if leaning else 0, 3)

    def residuals(numbers: Mapping[str, float]) -> Rows:
        acc_w, _ = driven.acting(flight, rows, numbers)
        away = (to_body @ (measured - form.mean @ acc_w)[..., None])[..., 0]
        return Rows(away[:, axes], block_of(form), LEVEL[axes])

    return residuals


def block_of(form: WeakForm) -> np.ndarray:
    """Return the number (M,) of the block that each bump's middle is in."""
    return (form.middle_s / BLOCK_S).astype(int)


TORQUE_WIDTH_S = 0.2
BAND = TORQUE_WIDTH_S / (2.0 * np.pi)
"""Torques are compared as changes within a window, without its mean: slow parts of the motors'
torque balance trim and flapping and rotate nothing. Times this they are accelerations."""
STILL = np.array([False, False, False])
DILUTED = ("inertia_x", "inertia_y", "yaw")
"""Numbers that noise of the rotor speeds biases, by axis."""
KNOWN = ("thrust", "curve", "battery")
"""The force's numbers that the torque is built on."""


def lag_and_delay(lag_s: float, delay_s: float) -> list[Unknown]:
    """Return the numbers of what lies between a command and the rotors' thrust.

    Slow flights identify how late it is in all, `late`, and not how much of that is the lag.
    """
    late = Unknown("late", lag_s + delay_s, -0.02, 0.3, 0.012, 1e-3, 0.0007)
    return [late, Unknown("lag", lag_s, 0.0, 0.3, 0.012, 1e-3, 0.0007)]


def unknowns_of_torque(drive: str, lag_s: float, delay_s: float) -> list[Unknown]:
    """Return the numbers of the torque; all but lag and delay are logarithms of ratios.

    That of the inertia about z is over the other two's mean, which it follows where it is not
    identifiable. Without known torques `yaw` is of what turns the body about z, over that inertia.
    """
    lags = lag_and_delay(lag_s, delay_s)
    axes = [Unknown(f"inertia_{a}", 0.0, -2.0, 2.0, 0.5, 1e-2, 0.015) for a in "xy"]
    room = 0.5 if drive == "torques" else 0.25
    axes.append(Unknown("inertia_z", 0.0, -1.0, 1.0, room, 1e-2, 0.015))
    if drive == "torques":
        return [*axes, *lags]
    yaw = Unknown("yaw", 0.0, -2.0, 2.0, 0.5, 1e-2, 0.015)
    return [*axes, yaw] if drive == "rotors" else [*axes, yaw, *lags]


def fit_torque(
    flights: Sequence[FlightGrid],
    driven: Driven,
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
    held: Sequence[str] = (),
    known: Known | None = None,
) -> Fitted:
    """Return inertia, lag and delay by `dw/dt = J^-1 (tau - w x J w)`.

    Noise in measured rotor speeds makes every slope smaller, by its share in the driving torque's
    variance (errors in variables; Fuller 1987, Sec. 1.1): the inertia would seem larger, the yaw
    torque smaller. The model is multiplied by the remaining share (the reliability ratio); half of
    the correction counts as its uncertainty. A number at a limit is left as it was.

    Args:
        flights: on their grids, with body rates.
        driven: the start.
        unknowns: from `unknowns_of_torque`.
        fixed: numbers that are not fitted, `lag` and `late` among them.
        held: numbers that are left as they are, with their uncertainty.
        known: numbers of the force among `fixed`, with their covariance.
    """
    known, steps = known or Known(), {"thrust": 1e-3}
    unknowns = [
        *unknowns,
        *(Unknown(n, fixed[n], -9.0, 9.0, 1.0, steps.get(n, 1e-2)) for n in known.names),
    ]
    begun, held = tuple(unknowns), list(held)
    forms = [
        flight.form(TORQUE_WIDTH_S, ("rate_b", TURNS[driven.drive]), slope=True)
        for flight in flights
    ]
    start = {**fixed, **{unknown.name: unknown.start for unknown in unknowns}}
    reliability = _reliability(flights, forms, driven, start)
    unsure: dict[str, float] = dict(zip(DILUTED, -0.5 * np.log(reliability), strict=True))
    unknowns = [
        u._replace(floor=float(np.hypot(u.floor, Z95 * unsure.get(u.name, 0.0)))) for u in unknowns
    ]
    parts = zip(flights, forms, strict=True)
    residuals = together([_torque(*part, driven, reliability) for part in parts], unknowns, fixed)
    if any(unknown.name == "late" for unknown in unknowns):
        best = _likeliest(unknowns, residuals, forms, flights)
        unknowns = [u._replace(start=best) if u.name == "late" else u for u in unknowns]
    while True:
        found = fit(residuals, unknowns, held, known)
        value = dict(zip((u.name for u in unknowns), found.value, strict=True))
        beyond = [
            u.name
            for u in unknowns
            if u.name in unsure and found.has(u.name) and not u.low < value[u.name] < u.high
        ]
        if not beyond:
            return replace(found, unknowns=begun)
        held += beyond


def _torque(
    flight: FlightGrid, form: WeakForm, driven: Driven, reliability: np.ndarray
) -> Residuals:
    turned, rows = _turned(flight, form), flight.rows(turned=False)

    def residuals(numbers: Mapping[str, float]) -> Rows:
        _, turn_b = driven.acting(flight, rows, numbers)
        if (reliability < 1.0).any():
            _, alone_b = driven.acting(flight, rows, numbers, powered=False)
            turn_b = alone_b + reliability * (turn_b - alone_b)
        return Rows(turned - BAND * (form.mean @ turn_b), block_of(form), STILL)

    return residuals


def _turned(flight: FlightGrid, form: WeakForm) -> np.ndarray:
    return np.asarray(BAND * (form.change @ np.nan_to_num(flight.known["rate_b"])))


def _reliability(
    flights: Sequence[FlightGrid],
    forms: Sequence[WeakForm],
    driven: Driven,
    numbers: Mapping[str, float],
) -> np.ndarray:
    """Return the share (3,) of the torque's variance that is no noise of the rotor speeds."""
    noise, whole = np.zeros(3), np.zeros(3)
    for flight, form in zip(flights, forms, strict=True):
        if driven.drive != "rotors":
            break
        rows = flight.rows(turned=False)
        speed = flight.known["rotor_speed"]
        noisy = {**flight.known, "rotor_speed": speed + flight.known[ROTOR_NOISE]}
        turned, other = (
            form.mean @ driven.acting(one, rows, numbers)[1]
            for one in (flight, flight._replace(known=noisy))
        )
        noise += ((other - turned) ** 2).sum(axis=0)
        whole += (turned**2).sum(axis=0)
    return np.maximum(1.0 - noise / np.maximum(whole, TINY), TINY)


def _likeliest(
    unknowns: Sequence[Unknown],
    residuals: Callable[[np.ndarray], list[Rows]],
    forms: Sequence[WeakForm],
    flights: Sequence[FlightGrid],
) -> float:
    """Return how late the model's turning is most like the measured one, whatever its size."""
    value = np.array([unknown.start for unknown in unknowns])
    late = [unknown.name for unknown in unknowns].index("late")
    trials = np.array([value[late], *np.arange(0.0, 0.13, 0.012)])
    measured = [_turned(*part) for part in zip(flights, forms, strict=True)]
    scores = np.zeros(len(trials))
    for k, trial in enumerate(trials):
        value[late] = max(trial, 0.0)
        for rows, turned in zip(residuals(value), measured, strict=True):
            if len(turned):
                model, turned = (one - np.median(one, 0) for one in (turned - rows.value, turned))
                size = np.sqrt((model**2).sum(axis=0) * (turned**2).sum(axis=0))
                scores[k] += ((model * turned).sum(axis=0) / np.maximum(size, 1e-12))[:2].sum()
    return float(trials[int(np.argmax(scores))])
