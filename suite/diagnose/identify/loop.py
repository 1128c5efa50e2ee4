"""The nominal rate loop by commanded and measured rates: gains, rotor lag and delay.

The loop is flown by its commands alone and compared with the gyro (output error; Ljung 1999, Sec.
4.3): measured rates in the loop's own equation would make the gyro's noise look like slower gains.
Per axis, `lag d2w/dt2 + dw/dt + K w = K rate_cmd(t - delay)`, as the controller makes up for
`w x J w` and rotor speeds change by little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.drive import delayed, filled
from suite.diagnose.identify.fit import Fitted, Rows, Unknown, fit
from suite.diagnose.identify.force import BLOCK_S
from suite.diagnose.identify.grid import STEP_S, FlightGrid, blocks_of, over, windows_of

WIDTH_S = 0.06
FREE = np.array([True, True, True])


def gains() -> list[Unknown]:
    """Return the loop's gains as logarithms of ratios to the start's."""
    return [Unknown(f"gain_{axis}", 0.0, -3.0, 3.0, 0.35, 1e-2, 0.02) for axis in "xyz"]


def fit_loop(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    unknowns: Sequence[Unknown],
    fixed: Mapping[str, float],
) -> Fitted:
    """Return gains, lag and delay; a constant rate of each flight is free (bias, trim).

    Args:
        flights: with rates and commanded rates.
        vehicle: gains to start from, and how often the loop looks.
        unknowns: `gains` and `torque.lag_and_delay`, or some of them.
        fixed: the others.
    """
    names = [unknown.name for unknown in unknowns]
    prepared = []
    for flight in flights:
        windows = windows_of(flight, WIDTH_S, ("rate_b", "rate_cmd_b"))
        rates = over(windows, flight.known["rate_b"])
        prepared.append((windows, rates, blocks_of(flight, windows, BLOCK_S)))

    def misses(value: np.ndarray) -> list[Rows]:
        told = {**fixed, **dict(zip(names, value, strict=True))}
        return [
            Rows(rates - over(windows, followed(flight, vehicle, told)), block, FREE)
            for flight, (windows, rates, block) in zip(flights, prepared, strict=True)
        ]

    return fit(misses, unknowns)


def followed(flight: FlightGrid, vehicle: Vehicle, told: Mapping[str, float]) -> np.ndarray:
    """Return the rates (G, 3) of the loop under its commands alone [rad/s]."""
    from scipy.signal import cont2discrete, lfilter, lfilter_zi

    # The loop looks at rates that are half a period old on average; commands act at once.
    half = 0.5 / vehicle.controller.frequency
    lag = max(told["lag"], 1e-4) + half
    wanted = filled(delayed(flight.known["rate_cmd_b"], told["late"] - told["lag"] - half))
    out = np.empty_like(wanted)
    for k, axis in enumerate("xyz"):
        gain = vehicle.controller.rate_gain[k] * float(np.exp(told.get(f"gain_{axis}", 0.0)))
        found: Any = cont2discrete(([gain], [lag, 1.0, gain]), STEP_S, method="foh")
        top, bottom = np.ravel(found[0]), found[1]
        state = lfilter_zi(top, bottom) * wanted[0, k]
        out[:, k] = lfilter(top, bottom, wanted[:, k], zi=state)[0]
    return out
