"""Gains, lag and delay of the nominal rate loop, and the lag of rotors behind their commands.

The loop is flown by its commands alone and compared with the gyro (output error; Ljung 1999, Sec.
4.3): measured rates in the loop's own equation would turn the gyro's noise into slower gains.
Per axis, `lag d2w/dt2 + dw/dt + K w = K rate_cmd(t - delay) + lag de/dt + e`, where `e` is what is
missed of `w x J w`, since the controller compensates it by rotors that lag, and the torque of
moving air. It is that of the rates without it (one step of Picard's iteration); rotor speeds are
taken to change by little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.body import Residuals, block_of, together
from suite.diagnose.identify.drive import behind, delayed, filled, lagged
from suite.diagnose.identify.fit import Fitted, Known, Rows, Unknown, fit
from suite.diagnose.identify.grid import STEP_S, FlightGrid

LOOP_WIDTH_S = 0.08
FREE = np.array([True, True, True])


def gains() -> list[Unknown]:
    """Return the loop's gains as logarithms of ratios to the start's."""
    return [Unknown(f"gain_{axis}", 0.0, -3.0, 3.0, 0.35, 1e-2, 0.02) for axis in "xyz"]


def couplings(vehicle: Vehicle) -> list[Unknown]:
    """Return how much two axes' rates turn the third, `(J_z - J_y) / J_x` and so on.

    They are nuisance parameters: the inertia behind them may be wrong.
    """
    x, y, z = vehicle.inertia
    starts = ((z - y) / x, (x - z) / y, (y - x) / z)
    both = zip("xyz", starts, strict=True)
    return [Unknown(f"coupling_{a}", start, -1.0, 1.0, 0.2, 1e-2) for a, start in both]


def air_torques(flights: Sequence[FlightGrid]) -> list[Unknown]:
    """Return how much moving air turns the body, acceleration over speed (flapping) [1/(m s)].

    They are nuisance parameters; none where the velocity is not known.
    """
    if not all(flight.has("vel_w", "rot_w") for flight in flights):
        return []
    return [Unknown(f"air_{axis}", 0.0, -20.0, 20.0, 2.0, 1e-2) for axis in "xy"]


def fit_loop(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
    known: Known | None = None,
) -> Fitted:
    """Return gains, lag and delay; a constant rate of each flight is free (bias, trim).

    Args:
        flights: with rates and commanded rates.
        vehicle: gains to start from, and the loop's frequency.
        unknowns: `gains`, `couplings` and `body.lag_and_delay`, or some of them.
        fixed: the others.
        known: those of `unknowns` that another fit has identified.
    """

    def residuals(flight: FlightGrid) -> Residuals:
        form = flight.form(LOOP_WIDTH_S, ("rate_b", "rate_cmd_b"))
        rates, block = form.mean @ np.nan_to_num(flight.known["rate_b"]), block_of(form)
        return lambda n: Rows(rates - form.mean @ followed(flight, vehicle, n), block, FREE)

    every = together([residuals(flight) for flight in flights], unknowns, fixed)
    return fit(every, unknowns, known=known)


SPEED_WIDTH_S = 0.16


def fit_rotor_lag(flights: Sequence[FlightGrid], unknowns: Sequence[Unknown]) -> Fitted:
    """Return lag and delay of measured rotor speeds behind commanded ones."""

    def residuals(flight: FlightGrid) -> Residuals:
        form = flight.form(SPEED_WIDTH_S, ("rotor_speed", "rotor_speed_cmd"))
        mean, level = form.mean, np.ones(4, dtype=bool)
        measured, block = mean @ np.nan_to_num(flight.known["rotor_speed"]), block_of(form)
        wanted = flight.known["rotor_speed_cmd"]
        return lambda n: Rows(measured - mean @ np.nan_to_num(behind(wanted, n)), block, level)

    return fit(together([residuals(flight) for flight in flights], unknowns, {}), unknowns)


def followed(flight: FlightGrid, vehicle: Vehicle, numbers: Mapping[str, float]) -> np.ndarray:
    """Return the rates (G, 3) of the loop under its commands alone [rad/s]."""
    # The loop's rates are half a period old on average: exp(-half s), to second order.
    half = 0.5 / vehicle.controller.frequency
    lag = max(numbers["lag"], 1e-4)
    wanted = filled(delayed(flight.known["rate_cmd_b"], numbers["late"] - numbers["lag"]))
    ratio = np.exp([numbers.get(f"gain_{axis}", 0.0) for axis in "xyz"])
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
    # The controller compensates `w x J w` by rotors that lag.
    products = linear[:, [1, 2, 0]] * linear[:, [2, 0, 1]]
    coupled = products * [numbers[f"coupling_{axis}"] for axis in "xyz"]
    push = lagged(coupled, numbers["lag"]) - coupled
    if "air_x" in numbers:
        vel_b = filled(np.einsum("gji,gj->gi", flight.known["rot_w"], flight.known["vel_w"]))
        push[:, 0] += numbers["air_x"] * vel_b[:, 1]
        push[:, 1] -= numbers["air_y"] * vel_b[:, 0]
    return linear + answer(push, [[lag, 1.0]] * 3)
