"""What a report shows besides the names: logs and their consistency, the actuators, a black box.

The attitude must turn as the gyro has it, but for a bias of the gyro, and not later; the velocity
must be the path's slope. Left alone these faults imitate physics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.logs.faults.clock import delay_of
from eval.logs.flight_log import FlightLog
from eval.logs.velocity import velocity_from_position
from suite.diagnose.data.flights import turning_of
from suite.diagnose.data.sampling import on_every_row
from suite.diagnose.estimate.gauss_newton import Z95
from suite.diagnose.evidence.moments import means_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import ActuatorMismatch, actuator_mismatches
from suite.diagnose.verdict.black_box import BlackBoxComparisons
from suite.diagnose.verdict.rollout_gap import Rollouts


@dataclass(frozen=True)
class Checks:
    """All that a report shows besides the search."""

    facts: list[LogFacts]
    kinematics: Kinematics | None
    actuators: list[ActuatorMismatch]
    black_box: BlackBoxComparisons | None = None
    """Only where it was chosen: it takes minutes."""


def run_checks(flown: Rollouts) -> Checks:
    """Return what a report shows besides the names, but for the black box."""
    limits, logs = flown.limits, flown.logs
    return Checks(
        facts=[facts_of(log) for log in logs],
        kinematics=check_kinematics(logs, limits),
        actuators=actuator_mismatches(logs, flown.vehicle, limits),
    )


class Kinematics(NamedTuple):
    """How pose and gyro agree."""

    flights: int
    """That could be used."""
    bias: np.ndarray
    """(3,) gyro less the attitude's turn [rad/s]."""
    bias_ci: np.ndarray
    """(3,) half-widths of 95 % intervals."""
    offset: float
    """Time by which the pose is late against the gyro [s]."""
    offset_ci: float
    """Half-width of its 95 % interval; infinite where the rates hardly change."""
    velocity_scale: float | None
    """Logged velocity over the path's slope, 1 where they agree; None where either is missing."""


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


def check_kinematics(
    logs: Sequence[FlightLog], limits: Thresholds = THRESHOLDS
) -> Kinematics | None:
    """Return how pose and gyro of `logs` agree; None where too little is there."""
    biases, late = [], []
    for log in logs:
        whole = on_every_row(log, limits)
        off = whole.rate_b - turning_of(log.time_s, whole.quat_wxyz)
        good = np.isfinite(off).all(axis=1)
        if good.sum() < LEAST_TURNS:
            continue
        block = ((log.time_s - log.time_s[0]) / limits.turn_block_s).astype(int)
        biases.append(means_of(off[good], block[good]))
        posed, turned = (np.isfinite(v).all(axis=1) for v in (log.quat_wxyz, log.rate_b))
        found = delay_of(
            log.time_s[posed], log.quat_wxyz[posed], log.time_s[turned], log.rate_b[turned]
        )
        late += [] if found is None else [found]
    if not biases:
        return None
    bias = np.concatenate(biases)
    spread = bias.std(axis=0, ddof=1) / np.sqrt(len(bias)) if len(bias) > 1 else np.full(3, np.inf)
    weight = np.array([1.0 / max(one.error_s, 1e-6) ** 2 for one in late])
    offset = float(weight @ [one.delay_s for one in late] / weight.sum()) if late else 0.0
    error = float(1.0 / np.sqrt(weight.sum())) if late else float("inf")
    scale = _velocity_scale(logs)
    return Kinematics(len(biases), bias.mean(axis=0), Z95 * spread, offset, Z95 * error, scale)


LEAST_TURNS = 20
"""Rows with a gyro and a turn of the attitude, at least."""


def _velocity_scale(logs: Sequence[FlightLog]) -> float | None:
    both, own = 0.0, 0.0
    for log in logs:
        if log.velocity_derived:
            continue
        path = velocity_from_position(log.time_s, log.pos_w)
        good = np.isfinite(path).all(axis=1) & np.isfinite(log.vel_w).all(axis=1)
        both += float((path[good] * log.vel_w[good]).sum())
        own += float((path[good] ** 2).sum())
    return both / own if own > 1e-3 else None
