"""Who flies a case: MuJoCo, RotorPy, or the engine in continuous time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.blind.cases import CONTINUOUS, ROTORPY, Case
from suite.blind.continuous.timing import draw_conditions
from suite.blind.continuous_flight import (
    GRID_HZ,
    fly_continuous,
    logs_of,
    recordings_of,
    with_loop,
)
from suite.blind.oracle.strength import given_vehicle
from suite.blind.rotorpy_flight import fly_rotorpy
from suite.diagnose.plans.follow import Recording
from suite.diagnose.plans.simulate import SENSORS, Extra, fly, log_of
from suite.diagnose.plans.trajectory import Trajectory

Ways = Sequence[Trajectory]
Random = np.random.Generator


class Flights(NamedTuple):
    """A case's flights."""

    recordings: Sequence[Recording]
    """Without noise, on an even grid."""
    logs: Callable[[np.random.Generator], tuple[FlightLog, ...]]
    """What is logged of them, with noise."""


@dataclass(frozen=True)
class Simulator:
    """A simulator, set up for one case."""

    given: Vehicle
    """Given to the diagnosis."""
    judged: Vehicle
    """The same at the rate of the recordings' grid, for what works on that."""
    fly: Callable[..., Flights]
    """Flies (truth, ways, rng, extra) side by side: a vehicle on N trajectories, with what happens
    by chance in flight, and physics besides, if any."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """Under which it is flown and logged, for the answer."""


def simulator_for(case: Case, rng: np.random.Generator) -> Simulator:
    """Return who flies `case`; `rng` is for the conditions, where a simulator draws any."""
    given, sensors = given_vehicle(case.vehicle), SENSORS[case.sensors]

    def on_grid(truth: Vehicle, ways: Ways, rng: Random, extra: Extra | None = None) -> Flights:
        if case.simulator == ROTORPY:
            flown = fly_rotorpy(given, truth, ways, sensors.rate_hz)
        else:
            has_voltage = bool(sensors.voltage)
            flown = fly(given, truth, ways, sensors.rate_hz, extra, rng, has_voltage)

        def logs(rng: np.random.Generator) -> tuple[FlightLog, ...]:
            return tuple(
                log_of(flight, truth, sensors, rng, f"flight_{index + 1}")
                for index, flight in enumerate(flown)
            )

        return Flights(flown, logs)

    if case.simulator != CONTINUOUS:
        return Simulator(given, given, on_grid)

    conditions = draw_conditions(rng)
    looped = with_loop(given, conditions.loop_hz)

    def between(truth: Vehicle, ways: Ways, rng: Random, extra: Extra | None = None) -> Flights:
        flown = fly_continuous(looped, truth, ways, conditions, rng, extra)
        return Flights(
            recordings_of(flown, ways, sensors.rate_hz),
            lambda rng: logs_of(flown, ways, truth, sensors, conditions, rng),
        )

    judged = with_loop(given, GRID_HZ)
    return Simulator(looped, judged, between, asdict(conditions))
