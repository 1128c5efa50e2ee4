"""What a report shows besides the names: facts of the logs, the actuators, a black box.

Faults of the logs are not tested here: `suite check` has done so before a diagnosis, and a gyro's
bias and a clock's offset are candidates of the search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.verdict.actuators import ActuatorMismatch, actuator_mismatches
from suite.diagnose.verdict.black_box import BlackBoxComparisons
from suite.diagnose.verdict.rollout_gap import Rollouts


@dataclass(frozen=True)
class Checks:
    """All that a report shows besides the search."""

    facts: list[LogFacts]
    actuators: list[ActuatorMismatch]
    black_box: BlackBoxComparisons | None = None
    """Only where it was chosen: it takes minutes."""


def run_checks(flown: Rollouts) -> Checks:
    """Return what a report shows besides the names, but for the black box."""
    limits, logs = flown.limits, flown.logs
    return Checks(
        facts=[facts_of(log) for log in logs],
        actuators=actuator_mismatches(logs, flown.vehicle, limits),
    )


class LogFacts(NamedTuple):
    """One log, for a table."""

    name: str
    duration_s: float
    rows: int
    rate_hz: float
    """One over the median time between rows."""
    longest_hole_s: float
    missing: float
    """Share of rows in which something of the state or the command is missing."""
    top_speed: float
    """[m/s]."""
    channels: str
    """What was logged besides time, pose and rates."""


def facts_of(log: FlightLog) -> LogFacts:
    """Return what a person wants to know of a log first."""
    steps = np.diff(log.time_s)
    there = [
        ("commands", log.thrust_cmd is not None),
        ("velocity", not log.velocity_derived),
        ("rotor speeds", log.rotor_speed is not None),
        ("rotor commands", log.rotor_speed_cmd is not None),
        ("accelerometer", log.acc_b is not None),
        ("voltage", log.voltage is not None),
    ]
    speed = log.speed[np.isfinite(log.speed)]
    return LogFacts(
        name=log.name,
        duration_s=log.duration_s,
        rows=len(log.time_s),
        rate_hz=1.0 / float(np.median(steps)),
        longest_hole_s=float(steps.max()),
        missing=float(1.0 - log.whole.mean()),
        top_speed=float(speed.max()) if len(speed) else float("nan"),
        channels=", ".join(name for name, is_there in there if is_there) or "none",
    )
