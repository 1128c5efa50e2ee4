"""The data of the benchmark `diagnose`: windows (short parts) of flights of a vehicle to identify.

Both sides simulate them with the measured rotor speeds as input, since a MuJoCo model has no rate
loop.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.diagnose.data.windows import FlightWindows, cut
from suite.diagnose.estimate.parameters import ParameterSpace, make_space

REFITTED = ("mass_offset", "com_offset", "inertia_scale")
"""Effects whose parameters are fitted; six of these parameters are identifiable."""


@dataclass(frozen=True)
class Task:
    """Windows, and the parameters that are fitted to them."""

    nominal: Vehicle
    """The nominal vehicle; its parameters are the initial values of both sides."""
    space: ParameterSpace
    """All parameters of the catalogue of effects for that vehicle."""
    indices: tuple[int, ...]
    """Indices of the K fitted parameters in `space`."""
    truth: np.ndarray
    """(K,) values of these parameters for the vehicle that flew."""
    windows: FlightWindows
    """Windows of 1 s, with measured rotor speeds as the input."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each fitted parameter, as "effect.parameter component"."""
        entries = [self.space.entries[i] for i in self.indices]
        return tuple(f"{e.effect}.{e.parameter} {e.component or 0}" for e in entries)

    def array(self, field: str) -> np.ndarray:
        """Return a field of `ParameterSpace.entries` for the fitted parameters, (K,)."""
        return self.space.array(field)[list(self.indices)]


def make_task(seed: int, duration_s: float = 10.0) -> Task:
    """Return windows of five MuJoCo flights of `duration_s` [s], with other mass and inertia."""
    from eval.flights.follow import FlightFailed
    from eval.flights.simulate import SENSORS, fly, log_of
    from eval.flights.trajectory import ordinary_flights
    from suite.blind.oracle.strength import nominal_vehicle

    def attempt(number: int) -> Task:
        """Draw a vehicle, fly it and return its windows."""
        rng = np.random.default_rng([seed, number])
        truth = with_effects(nominal, _draw_effects(nominal, rng))
        flights = fly(nominal, truth, ordinary_flights(rng, duration_s), sensors.rate_hz)
        logs = [
            log_of(flight, truth, sensors, rng, f"flight {i}") for i, flight in enumerate(flights)
        ]
        windows, _ = cut(logs, nominal, rotor_input=True, integrator="euler")
        assert windows is not None
        return Task(
            nominal, space, indices, make_space(truth).array("start")[list(indices)], windows
        )

    nominal, sensors = nominal_vehicle("bare"), SENSORS["full"]
    space = make_space(nominal)
    indices = tuple(i for i, entry in enumerate(space.entries) if entry.effect in REFITTED)
    number = 0
    while True:
        with contextlib.suppress(FlightFailed):  # a few drawn vehicles are too heavy to fly
            return attempt(number)
        number += 1


def _draw_effects(nominal: Vehicle, rng: np.random.Generator) -> dict[str, Any]:
    """Draw the values of the effects: every parameter differs by its usual size, up or down."""
    neutral, values = all_values(nominal), dict[str, Any]()
    for name in REFITTED:
        fields: dict[str, Any] = {}
        for parameter in EFFECTS[name].parameters:
            size = max(parameter.size, 1)
            shift = rng.uniform(*parameter.typical, size) * rng.choice((-1.0, 1.0), size)
            # Components that no flight can identify do not change.
            shift[list(parameter.unseen)] = 0.0
            value = np.atleast_1d(np.asarray(getattr(neutral[name], parameter.name), float)) + shift
            fields[parameter.name] = tuple(value.tolist()) if parameter.size else float(value[0])
        values[name] = type(neutral[name])(**fields)
    return values
