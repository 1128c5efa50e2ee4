"""Select the simulator that flies a blind case: MuJoCo, RotorPy, or the continuous-time engine."""

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
from suite.blind.continuous_flight import fly_continuous, logs_of, with_loop_frequency
from suite.blind.oracle.strength import nominal_vehicle
from suite.blind.rotorpy_flight import fly_rotorpy

Trajectories = Sequence[Trajectory]
"""Trajectories of a case, one for each flight."""
Random = np.random.Generator
"""Short name of the type."""
LogFlights = Callable[[Random | None], tuple[FlightLog, ...]]
"""Function (random generator of the noise; None: no noise) -> logs of the flights of a case."""


@dataclass(frozen=True)
class Simulator:
    """A simulator for one case."""

    nominal: Vehicle
    """The vehicle file for the diagnosis."""
    fly: Callable[..., LogFlights]
    """Function that flies N trajectories and returns a function that makes their logs. Its
    arguments are the true vehicle, the trajectories, the random generator of gusts, and additional
    physics (optional)."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """Conditions of flights and logs, such as rates, which the answer records; may be empty."""


def simulator_for(case: Case, rng: np.random.Generator) -> Simulator:
    """Return the simulator of `case`.

    For the continuous-time engine `rng` draws the conditions of the flights, such as rates.
    """
    nominal, sensors = nominal_vehicle(case.vehicle), SENSORS[case.sensors]

    def fly_in_steps(
        truth: Vehicle, trajectories: Trajectories, rng: Random, extra: Extra | None = None
    ) -> LogFlights:
        """Fly in MuJoCo or RotorPy, which advance in steps of the period of the rate loop."""
        if case.simulator == ROTORPY:
            flown = fly_rotorpy(nominal, truth, trajectories, sensors.rate_hz)
        else:
            has_voltage = bool(sensors.voltage)
            flown = fly(nominal, truth, trajectories, sensors.rate_hz, extra, rng, has_voltage)
        return lambda rng: tuple(
            log_of(flight, truth, sensors, rng, f"flight_{index + 1}")
            for index, flight in enumerate(flown)
        )

    if case.simulator != CONTINUOUS:
        return Simulator(nominal, fly_in_steps)

    conditions = draw_conditions(rng)
    nominal_at_rate = with_loop_frequency(nominal, conditions.loop_hz)

    def fly_in_continuous_time(
        truth: Vehicle, trajectories: Trajectories, rng: Random, extra: Extra | None = None
    ) -> LogFlights:
        """Fly in the continuous-time engine."""
        flown = fly_continuous(nominal_at_rate, truth, trajectories, conditions, rng, extra)
        return lambda rng: logs_of(flown, trajectories, truth, sensors, conditions, rng)

    return Simulator(nominal_at_rate, fly_in_continuous_time, asdict(conditions))
