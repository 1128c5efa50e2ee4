"""The simulators of cases: MuJoCo, RotorPy, and the continuous-time engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from eval.flights.simulate import SENSORS, Extra, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.blind.cases import CONTINUOUS, ROTORPY, Case
from suite.blind.continuous.timing import draw_conditions
from suite.blind.continuous_flight import fly_continuous, logs_of, with_loop
from suite.blind.oracle.strength import given_vehicle
from suite.blind.rotorpy_flight import fly_rotorpy

Ways = Sequence[Trajectory]
Random = np.random.Generator
Logged = Callable[[Random | None], tuple[FlightLog, ...]]
"""(random generator of the noise) -> logs of a case's flights; None logs without noise."""


@dataclass(frozen=True)
class Simulator:
    """A simulator for one case."""

    given: Vehicle
    """The vehicle file for the diagnosis."""
    fly: Callable[..., Logged]
    """(truth, ways, rng, extra) -> flights of a vehicle on N trajectories, with random effects and
    additional physics, if any."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """Conditions of flight and log, for the answer."""


def simulator_for(case: Case, rng: np.random.Generator) -> Simulator:
    """Return the simulator of `case`; `rng` draws its conditions, if it has any."""
    given, sensors = given_vehicle(case.vehicle), SENSORS[case.sensors]

    def stepped(truth: Vehicle, ways: Ways, rng: Random, extra: Extra | None = None) -> Logged:
        if case.simulator == ROTORPY:
            flown = fly_rotorpy(given, truth, ways, sensors.rate_hz)
        else:
            has_voltage = bool(sensors.voltage)
            flown = fly(given, truth, ways, sensors.rate_hz, extra, rng, has_voltage)
        return lambda rng: tuple(
            log_of(flight, truth, sensors, rng, f"flight_{index + 1}")
            for index, flight in enumerate(flown)
        )

    if case.simulator != CONTINUOUS:
        return Simulator(given, stepped)

    conditions = draw_conditions(rng)
    looped = with_loop(given, conditions.loop_hz)

    def between(truth: Vehicle, ways: Ways, rng: Random, extra: Extra | None = None) -> Logged:
        flown = fly_continuous(looped, truth, ways, conditions, rng, extra)
        return lambda rng: logs_of(flown, ways, truth, sensors, conditions, rng)

    return Simulator(looped, between, asdict(conditions))
