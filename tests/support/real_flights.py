"""Flights as real ones are: rotors measured, and a trim of each flight's own."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from tests.support.diagnosis_flights import fly_all
from tests.support.pendulum import Pendulum
from tests.support.vehicles import PLAIN, with_effects, with_lag

VEHICLE = with_lag(PLAIN, 0.03)
TRIM = 0.004
"""Standard deviation of each flight's own torque trim [N m]; of its centre of mass, a fifth [m]."""


def flights(
    count: int,
    seed: int = 0,
    duration_s: float = 8.0,
    speed: float = 3.0,
    trim: float = 1.0,
    hidden: Mapping[str, Any] | None = None,
    noise: float = 1.0,
    headings: Sequence[float] = (),
    load: tuple[float, float] | None = None,
    **effects: Any,
) -> list[FlightLog]:
    """Return logs of `VEHICLE` with effects, rotors measured, each with a trim of its own.

    Effects are `hidden` by name, and what is given by keyword. With `headings` [rad] the flights
    keep one each, in turn; a `load` of so many kg hangs on a line of so many metres.
    """
    effects = {**(hidden or {}), **effects}
    rng, vehicles, swings = np.random.default_rng(seed), [], []
    for _ in range(count):
        own = tuple((trim * TRIM * rng.standard_normal(3)).tolist())
        vehicles.append(with_effects(VEHICLE, **effects, torque_trim=(own,)))
        if load is not None:
            lean = tuple(rng.uniform(-0.25, 0.25, 2).tolist())
            swings.append(Pendulum(*load, VEHICLE.mass, lean))
    kept = [headings[number % len(headings)] for number in range(count)] if headings else None
    seeds = range(100 * seed, 100 * seed + count)
    logs = fly_all(
        vehicles, seeds, duration_s, speed, noise, motors=True, extras=swings, headings=kept
    )
    return [replace(log, about={}) for log in logs]
