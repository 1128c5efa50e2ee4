"""Fits gains, lag and delay of the nominal rate loop, and the rotors' lag behind their commands.

The rate loop is the controller that turns commanded body rates into rotor thrusts. The lag is the
time constant with which the rotors follow. The loop is simulated from its commands alone, and its
rates are compared with the gyro (output error; Ljung 1999, Sec. 4.3). If measured rates were an
input, noise of the gyro would lower the fitted gains. The rate w about each axis follows

    lag d2w/dt2 + dw/dt + K w = K rate_cmd(t - delay) + lag de/dt + e

with the gain K. The disturbance e (an angular acceleration) has two parts: the torque of moving
air, and the part of w x J w that the controller compensates too late, since the rotors lag. It is
computed from the rates that the loop would have without it (one step of Picard's iteration).
Changes of rotor speed are assumed small.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.body import Windows
from suite.diagnose.identify.drive import LEAST_LAG_S, after_delay_and_lag, delayed, filled, lagged
from suite.diagnose.identify.fit import NONE_KNOWN, Fitted, KnownNumbers, Rows, Unknown, fit
from suite.diagnose.identify.grid import STEP_S, FlightGrid

WINDOWS = {"rate_b": ("rate_cmd_b", 0.08), "rotor_speed": ("rotor_speed_cmd", 0.16)}
"""Measured signal -> its command, and the width of the windows over which both are averaged [s]."""


def loop_unknowns(vehicle: Vehicle, flights: Sequence[FlightGrid]) -> list[Unknown]:
    """Return the numbers of the rate loop, apart from lag and delay.

    The gains are logarithms of ratios to the start. Nuisance parameters are the factors from the
    rates about two axes to the angular acceleration of the third, and the ratios of angular
    acceleration by moving air (flapping) to velocity [1/(m s)], if all flights have a velocity and
    an attitude.
    """
    x, y, z = vehicle.inertia
    couplings = zip("xyz", ((z - y) / x, (x - z) / y, (y - x) / z), strict=True)
    air = "xy" if all(flight.has("vel_w", "rot_w") for flight in flights) else ""
    return [
        *(Unknown(f"gain_{axis}", 0.0, -3.0, 3.0, 0.35, 1e-2, 0.02) for axis in "xyz"),
        *(Unknown(f"coupling_{axis}", start, -1.0, 1.0, 0.2, 1e-2) for axis, start in couplings),
        *(Unknown(f"air_{axis}", 0.0, -20.0, 20.0, 2.0, 1e-2) for axis in air),
    ]


def fit_commanded(
    flights: Sequence[FlightGrid],
    measured: str,
    model: Callable[[FlightGrid, Mapping[str, float]], np.ndarray],
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
    known: KnownNumbers = NONE_KNOWN,
) -> Fitted:
    """Fit how a `measured` signal follows its command: body rates, or rotor speeds.

    Each channel of a flight has a free constant (bias of the gyro, trim). `model` returns the
    signal (G, C) of a flight from its commands, for the `unknowns` and the `fixed` numbers. Another
    fit has identified those that are `known`.

    Raises:
        NoWholeWindow: if no window has both the signal and its command.
    """
    commanded, width_s = WINDOWS[measured]
    windows = []
    for flight in flights:
        form, values = flight.form(width_s, (measured, commanded)), flight.signals[measured]
        means = form.mean @ np.nan_to_num(values)
        constants = np.ones(values.shape[1], dtype=bool)
        windows.append(Windows(flight, flight.rows(False), form, means, constants))

    def residuals(numbers: Mapping[str, float]) -> list[Rows]:
        return [one.residuals(model(one.flight, numbers)) for one in windows]

    return fit(residuals, unknowns, known=known, fixed=fixed)


def rotor_speeds(flight: FlightGrid, numbers: Mapping[str, float]) -> np.ndarray:
    """Return the rotor speeds (G, 4) that follow the commanded ones [rad/s]."""
    return after_delay_and_lag(flight.signals["rotor_speed_cmd"], numbers)


def loop_rates(vehicle: Vehicle, flight: FlightGrid, numbers: Mapping[str, float]) -> np.ndarray:
    """Return the body rates (G, 3) of the rate loop from its commands alone [rad/s]."""
    # The loop uses rates that are half a period old on average. This delay, exp(-half_s s) for the
    # Laplace variable s, is expanded to second order.
    half_s = 0.5 / vehicle.controller.frequency
    lag_s = max(numbers["lag"], LEAST_LAG_S)
    commanded = filled(delayed(flight.signals["rate_cmd_b"], numbers["late"] - numbers["lag"]))
    ratio = np.exp([numbers.get(f"gain_{axis}", 0.0) for axis in "xyz"])
    gains = np.asarray(vehicle.controller.rate_gain) * ratio

    def response(inputs: np.ndarray, numerators: Sequence[list[float]]) -> np.ndarray:
        """Return the closed loop's response (G, 3) to `inputs` (G, 3), linear between points."""
        rates = np.empty_like(inputs)
        for k, (gain, numerator) in enumerate(zip(gains, numerators, strict=True)):
            denominator = [lag_s + 0.5 * gain * half_s**2, 1.0 - gain * half_s, gain]
            top, bottom, steady = discrete_filter(tuple(numerator), tuple(denominator))
            rates[:, k] = lfilter(top, bottom, inputs[:, k], zi=steady * inputs[0, k])[0]
        return rates

    # First the rates without a disturbance, then the disturbance that follows from these rates.
    linear = response(commanded, [[gain] for gain in gains])
    # The controller compensates w x J w, but its rotors lag: the difference is a disturbance.
    products = linear[:, [1, 2, 0]] * linear[:, [2, 0, 1]]
    coupled = products * [numbers[f"coupling_{axis}"] for axis in "xyz"]
    disturbance = lagged(coupled, numbers["lag"]) - coupled
    # Moving air tilts the rotor disks, which rolls and pitches the body.
    if "air_x" in numbers:
        vel_b = filled(np.einsum("gji,gj->gi", flight.signals["rot_w"], flight.signals["vel_w"]))
        disturbance[:, 0] += numbers["air_x"] * vel_b[:, 1]
        disturbance[:, 1] -= numbers["air_y"] * vel_b[:, 0]
    return linear + response(disturbance, [[lag_s, 1.0]] * 3)


@lru_cache(maxsize=256)
def discrete_filter(
    numerator: tuple[float, ...], denominator: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a transfer function's filter at the grid's step: numerator, denominator and state.

    The input is linear between points, and the state is that of a constant input of 1. The filters
    are kept, as all flights share them and a fit's differences change one number at a time.
    """
    discrete: Any = cont2discrete((numerator, denominator), STEP_S, method="foh")
    top, bottom = np.ravel(discrete[0]), discrete[1]
    return top, bottom, lfilter_zi(top, bottom)
