"""A position controller, called the pilot, that flies trajectories in any simulator.

Its commands are collective thrust and body rates (CTBR). A simulator is used through the protocol
`Bodies`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.effects.interface import GRAVITY
from eval.flights.trajectory import Reference, Trajectory
from eval.quadrotor.attitude import attitude_command
from eval.quadrotor.plant import Command, Motion
from eval.vehicles.vehicle import Vehicle

FURTHEST_M = 4.0
"""Distance from its trajectory at which a flight has failed [m]."""
LOWEST_M = 0.02
"""Height below which a flight has failed [m]."""
PER_POSITION, PER_VELOCITY, PER_SUM = 5.0, 3.5, 2.0
"""Gains of the position loop: acceleration per error of the position [1/s^2] and of the velocity
[1/s], and per integral of the position error [1/s^3]. Attitude and rate loops have the vehicle
file's gains."""
CORRECTION_MOST = 8.0
"""Largest correction of each component of the acceleration [m/s^2]."""
SUM_MOST = 1.0
"""Limit of each component of the integral of the position error [m s]."""
LIFT_PER_FLAT, LIFT_LEAST = 0.36, 1.0
"""Limits of the vertical part of the wanted specific force: it is at least `LIFT_PER_FLAT` times
the horizontal part, which limits the tilt to 70 deg, and at least `LIFT_LEAST` [m/s^2]."""


class Recording(NamedTuple):
    """One flight at each of K physics steps, without noise."""

    dt: float
    """Length of a physics step [s]."""
    period: int
    """Number of physics steps for which a command is held; a log has one row for each command."""
    time_s: np.ndarray
    """(K,) time since the start [s]."""
    motion: Motion
    """(K, ...) rigid-body state at the start of each step."""
    quat_wxyz: np.ndarray
    """(K, 4) attitude at the start of each step."""
    rotor_speed: np.ndarray
    """(K, 4) rotor speeds at the start of each step [rad/s]."""
    command: Command
    """(K, ...) the pilot's commands."""
    acc_b: np.ndarray
    """(K, 3) specific force in the previous step [m/s^2]."""
    voltage: np.ndarray
    """(K,) battery voltage [V]."""
    integrator: str | None = None
    """`euler` if the simulator integrates by Euler steps of `dt`; None if the flight counts as
    continuous in time."""


class FlightFailed(RuntimeError):
    """A simulated flight tipped over, hit the ground or left its trajectory."""


class Step(NamedTuple):
    """Quantities of N vehicles in the last physics step."""

    rotor_speed: np.ndarray
    """(N, 4) rotor speeds at the start of the step [rad/s]."""
    voltage: np.ndarray
    """(N,) battery voltage [V]."""
    acc_b: np.ndarray
    """(N, 3) specific force [m/s^2]."""


class Bodies(Protocol):
    """N vehicles in a simulator, stepped together."""

    integrator: str | None
    """Integrator of the simulator, as in `Recording.integrator`."""

    def motion(self) -> tuple[Motion, np.ndarray]:
        """Return the current rigid-body states (N, ...) and attitudes (N, 4) wxyz."""
        ...

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        """Simulate one physics step from `motion` at `time_s` [s] under commands (N, ...)."""
        ...


def reference_of(trajectories: Sequence[Trajectory], period: int, dt: float) -> Reference:
    """Return the set points of N trajectories at every command, (commands, N, ...).

    `period` is the number of physics steps between commands, `dt` the length of a step [s].
    """
    steps = round(max(path.duration_s for path in trajectories) / dt)
    time_s = np.arange(0, steps, period) * dt
    references = [path.reference(time_s) for path in trajectories]
    return Reference(*(np.stack(parts, axis=1) for parts in zip(*references, strict=True)))


def follow(
    bodies: Bodies,
    nominal: Vehicle,
    trajectories: Sequence[Trajectory],
    wanted: Reference,
    period: int,
    dt: float,
) -> list[Recording]:
    """Fly N trajectories at once, each with its own vehicle, and return their recordings.

    Args:
        bodies: N vehicles at the start positions and velocities of the trajectories.
        nominal: the vehicle that the controller assumes.
        trajectories: the N trajectories.
        wanted: their set points, from `reference_of`.
        period: physics steps for which a command is held.
        dt: length of a physics step [s].

    Raises:
        FlightFailed: where a flight tips over, hits the ground or leaves its trajectory.
    """
    count = len(trajectories)
    steps = [round(path.duration_s / dt) for path in trajectories]
    summed_w = np.zeros((count, 3))
    command = Command(np.zeros(count), np.zeros((count, 3)))
    acc_b = np.zeros((count, 3)) + [0.0, 0.0, GRAVITY]
    rows = []
    for step in range(max(steps)):
        motion, quat = bodies.motion()
        if step % period == 0:
            # Set points of this moment.
            now = Reference(*(part[step // period] for part in wanted))
            check_flights(motion, now, np.full(count, step * dt), step < np.array(steps))
            summed_w = summed_w + period * dt * (now.pos_w - motion.pos_w)
            summed_w = np.clip(summed_w, -SUM_MOST, SUM_MOST)
            command = steer(nominal, now, motion, summed_w)
        speed, voltage, next_acc_b = bodies.step(motion, command, step * dt)
        rows.append((motion, quat, speed, command, acc_b, voltage))
        acc_b = next_acc_b
    time_s = np.arange(max(steps)) * dt
    return [
        Recording(dt, period, time_s[:length], *_flight_of(rows[:length], index))._replace(
            integrator=bodies.integrator
        )
        for index, length in enumerate(steps)
    ]


def _flight_of(rows: Sequence[Any], index: int) -> Any:
    """Return the arrays (K, ...) of flight `index` from K rows of N flights.

    Each row is a tuple of arrays (N, ...), or of such tuples; the result has the same structure.
    """
    if not isinstance(rows[0], tuple):
        return np.array([row[index] for row in rows])
    parts = (_flight_of(field, index) for field in zip(*rows, strict=True))
    row_type = type(rows[0])
    return row_type(*parts) if hasattr(row_type, "_fields") else tuple(parts)


def check_flights(
    motion: Motion, wanted: Reference, time_s: np.ndarray, flying: np.ndarray
) -> None:
    """Check that N flights are upright, above the ground and near their trajectories.

    `motion` and `wanted` are (N, ...), the current times `time_s` (N,) [s]. Only flights that are
    still `flying` (N,) are checked.

    Raises:
        FlightFailed: where a flight has tipped over, hit the ground or left its trajectory.
    """
    distance = np.sqrt(((motion.pos_w - wanted.pos_w) ** 2).sum(-1))
    # With these comparisons, a state of NaN fails too.
    upright, above_ground = motion.rot_w[:, 2, 2] > 0.0, motion.pos_w[:, 2] > LOWEST_M
    failed = ~((distance < FURTHEST_M) & upright & above_ground) & flying
    if failed.any():
        first = int(np.flatnonzero(failed)[0])
        raise FlightFailed(
            f"flight {first + 1} failed at {time_s[first]:.2f} s, {distance[first]:.1f} m off its "
            "trajectory; make the trajectory gentler or the effect weaker"
        )


def steer(vehicle: Vehicle, wanted: Reference, motion: Motion, summed_w: np.ndarray) -> Command:
    """Return the command that follows `wanted`, computed for the nominal vehicle.

    `wanted` and the true states `motion` are (N, ...). `summed_w` (N, 3) is the integral of the
    position error over time [m s].
    """
    correction_w = PER_POSITION * (wanted.pos_w - motion.pos_w)
    correction_w = correction_w + PER_VELOCITY * (wanted.vel_w - motion.vel_w)
    correction_w = np.clip(correction_w + PER_SUM * summed_w, -CORRECTION_MOST, CORRECTION_MOST)
    force_w = wanted.acc_w + correction_w + np.array([0.0, 0.0, GRAVITY])
    # The tilt is limited, because a commanded free fall would turn the vehicle over.
    level = np.sqrt((force_w[:, :2] ** 2).sum(-1))
    force_w[:, 2] = np.maximum(force_w[:, 2], np.maximum(LIFT_PER_FLAT * level, LIFT_LEAST))
    heading_w = np.stack(
        [np.cos(wanted.yaw), np.sin(wanted.yaw), np.zeros_like(wanted.yaw)], axis=-1
    )
    return attitude_command(vehicle.controller, force_w, motion.rot_w, heading_w)
