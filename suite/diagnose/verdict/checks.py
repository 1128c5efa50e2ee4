"""What stands beside the names: logs and their consistency, the actuators, a black box.

The attitude's turn over 60 ms must be the gyro's mean over the same time. What is left goes with
nothing (a bias of the gyro) or with the gyro's change (the pose is late: clocks apart). The
velocity must be the path's slope. Left alone these faults imitate physics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.logs.velocity import velocity_from_position
from suite.diagnose.data.sampling import on_every_row
from suite.diagnose.estimate.gauss_newton import Z95
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import ActuatorMismatch, actuator_mismatches
from suite.diagnose.verdict.black_box import BlackBoxComparisons
from suite.diagnose.verdict.diagnosis import Diagnosis
from tracks.geometry.rotation import quat_to_rot


@dataclass(frozen=True)
class Checks:
    """All that a report shows besides the search."""

    facts: list[LogFacts]
    kinematics: Kinematics | None
    actuators: list[ActuatorMismatch]
    black_box: BlackBoxComparisons | None = None
    """Only where it was asked for: it takes minutes."""


def run_checks(diagnosis: Diagnosis) -> Checks:
    """Return what stands beside the names of `diagnosis`, but for the black box."""
    limits, logs = diagnosis.limits, diagnosis.logs
    return Checks(
        facts=[facts_of(log) for log in logs],
        kinematics=check_kinematics(logs, limits),
        actuators=actuator_mismatches(logs, diagnosis.nominal, limits),
    )


class Kinematics(NamedTuple):
    """What pose and gyro say about each other."""

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
    """Return what pose and gyro of `logs` say about each other; None where too little is there."""
    parts = [part for log in logs if (part := _comparisons(log, limits)) is not None]
    if not parts:
        return None
    # Columns: the bias of each axis, then the offset, which acts on all three.
    square, pulls = np.zeros((4, 4)), []
    for apart, change, block in parts:
        for b in np.unique(block):
            rows = block == b
            design = _design(change[rows])
            square += design.T @ design
            pulls.append((design, apart[rows].ravel()))
    inverse = np.linalg.pinv(square)
    best = inverse @ sum(design.T @ values for design, values in pulls)
    scatter = np.zeros((4, 4))
    for design, values in pulls:
        pull = design.T @ (values - design @ best)
        scatter += np.outer(pull, pull)
    freedom = max(len(pulls) - 4, 1)
    error = np.sqrt(np.diag(inverse @ scatter @ inverse) * len(pulls) / freedom)
    calm = square[3, 3] < limits.calm * sum(len(part[0]) for part in parts)
    return Kinematics(
        flights=len(parts),
        bias=best[:3],
        bias_ci=Z95 * error[:3],
        offset=0.0 if calm else float(best[3]),
        offset_ci=float("inf") if calm else float(Z95 * error[3]),
        velocity_scale=_velocity_scale(logs),
    )


def _design(change: np.ndarray) -> np.ndarray:
    """Return (3 K, 4): gyro - turn = bias + offset * change of the rates."""
    return np.concatenate([np.tile(np.eye(3), (len(change), 1)), change.reshape(-1, 1)], axis=1)


def _comparisons(
    log: FlightLog, limits: Thresholds
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return gyro less turn (K, 3), change of the rates (K, 3) [rad/s^2] and blocks (K,)."""
    log = on_every_row(log, limits)
    time, rate = log.time_s, log.rate_b
    count = max(1, round(limits.turn_span_s / float(np.median(np.diff(time)))))
    if len(time) < 4 * count:
        return None
    first = np.arange(0, len(time) - count)
    last = first + count
    span = (time[last] - time[first])[:, None]
    rot_w = quat_to_rot(log.quat_wxyz)
    turn = np.swapaxes(rot_w[first], 1, 2) @ rot_w[last]
    skew = np.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ],
        axis=1,
    )
    cos = np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.arccos(cos)[:, None]
    by_attitude = skew * 0.5 / np.sinc(angle / np.pi) / span
    step = np.diff(time)[:, None]
    area = 0.5 * step * (rate[1:] + rate[:-1])
    hole = np.concatenate([[0], np.cumsum(~np.isfinite(area).all(axis=1))])
    full = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(area), axis=0)])
    by_gyro = (full[last] - full[first]) / span
    change = (rate[last] - rate[first]) / span
    good = (
        (span[:, 0] < 1.5 * limits.turn_span_s)
        & (hole[last] == hole[first])
        & np.isfinite(by_attitude).all(axis=1)
        & np.isfinite(change).all(axis=1)
        & (angle[:, 0] < 1.5)
    )
    if good.sum() < 20:
        return None
    block = ((time[first] - time[0]) / limits.turn_block_s).astype(int)
    return (by_gyro - by_attitude)[good], change[good], block[good]


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
