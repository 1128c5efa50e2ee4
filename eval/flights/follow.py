"""A position controller (the pilot) that flies trajectories in any simulator.

Its commands are collective thrust and body rates (CTBR).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.effects.interface import GRAVITY
from eval.flights.trajectory import Reference, Trajectory
from eval.quadrotor.attitude import attitude_command
from eval.quadrotor.plant import Command, Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.scene import Array

FURTHEST_M = 4.0
"""A flight further off its trajectory than this has failed [m]."""
LOWEST_M = 0.02
"""A flight lower than this has failed [m]."""


class Recording(NamedTuple):
    """One flight at every physics step, K of them, without noise."""

    dt: float
    """Of a physics step [s]."""
    period: int
    """Physics steps for which a command is held; one row of a log each."""
    time_s: np.ndarray
    """(K,) [s]."""
    motion: Motion
    """(K, ...) at the start of each step."""
    quat_wxyz: np.ndarray
    """(K, 4)."""
    rotor_speed: np.ndarray
    """(K, 4) at the start of each step [rad/s]."""
    command: Command
    """(K, ...) of the pilot."""
    acc_b: np.ndarray
    """(K, 3) specific force in the step that has just ended [m/s^2]."""
    voltage: np.ndarray
    """(K,) [V]."""
    acting: Command
    """(K, ...) what acted, before the vehicle's own delay: `command`, as an
    `eval.flights.simulate.Extra` changed it."""
    extra: Wrench
    """(K, 3) force and torque that an `Extra` (physics beyond the vehicle's) added."""
    integrator: str | None = None
    """`euler` if the simulator integrates by Euler steps of `dt`, as the flight shows; None if the
    flight counts as continuous in time."""


class FlightFailed(RuntimeError):
    """A simulated flight tipped over, hit the ground or left its trajectory."""


class Step(NamedTuple):
    """What N bodies had in a step that has just ended."""

    rotor_speed: np.ndarray
    """(N, 4) at its start [rad/s]."""
    voltage: np.ndarray
    """(N,) [V]."""
    acting: Command
    """(N, ...) what acted, before the vehicle's own delay."""
    extra: Wrench
    """(N, 3) as in `Recording`."""
    acc_b: np.ndarray
    """(N, 3) specific force [m/s^2]."""


class Bodies(Protocol):
    """N vehicles of a simulator, stepped together."""

    integrator: str | None
    """That of a `Recording`."""

    def motion(self) -> tuple[Motion, np.ndarray]:
        """Return how they move now, and their attitudes (N, 4) wxyz."""
        ...

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        """Go one step of physics further from `motion` at `time_s` [s], under a command each."""
        ...


def wanted_of(trajectories: Sequence[Trajectory], period: int, dt: float) -> Reference:
    """Return the set points of N trajectories at every command, (commands, N, ...)."""
    steps = round(max(way.duration_s for way in trajectories) / dt)
    clock = np.arange(0, steps, period) * dt
    ways = [way.reference(clock) for way in trajectories]
    return Reference(*(np.stack(parts, axis=1) for parts in zip(*ways, strict=True)))


def follow(
    bodies: Bodies,
    nominal: Vehicle,
    trajectories: Sequence[Trajectory],
    wanted: Reference,
    period: int,
    dt: float,
    gains: PilotGains | None = None,
) -> list[Recording]:
    """Fly `trajectories` side by side and return what happened.

    Args:
        bodies: N of them, where and as fast as the trajectories begin.
        nominal: the vehicle that the controller assumes.
        trajectories: N of them.
        wanted: their set points, by `wanted_of`.
        period: physics steps for which a command is held.
        dt: of a physics step [s].
        gains: of the pilot.

    Raises:
        FlightFailed: where a flight tips over, hits the ground or leaves its trajectory.
    """
    count = len(trajectories)
    steps = [round(way.duration_s / dt) for way in trajectories]
    gains, summed_w = gains or PilotGains(), np.zeros((count, 3))
    command = Command(np.zeros(count), np.zeros((count, 3)))
    acc_b = np.zeros((count, 3)) + [0.0, 0.0, GRAVITY]
    rows = []
    for step in range(max(steps)):
        motion, quat = bodies.motion()
        if step % period == 0:
            now = Reference(*(part[step // period] for part in wanted))
            check_flights(motion, now, np.full(count, step * dt))
            summed_w = np.clip(summed_w + period * dt * (now.pos_w - motion.pos_w), -1.0, 1.0)
            command = steer(nominal, gains, now, motion, summed_w)
        speed, voltage, acting, extra, next_acc_b = bodies.step(motion, command, step * dt)
        rows.append((motion, quat, speed, command, acc_b, voltage, acting, extra))
        acc_b = next_acc_b
    time_s = np.arange(max(steps)) * dt
    return [
        Recording(dt, period, time_s[:length], *_of(rows[:length], index))._replace(
            integrator=bodies.integrator
        )
        for index, length in enumerate(steps)
    ]


def _of(rows: Sequence[Any], index: int) -> Any:
    """Return flight `index` (K, ...) of K rows, tuples of arrays (N, ...) or of such tuples."""
    if not isinstance(rows[0], tuple):
        return np.array([row[index] for row in rows])
    parts = (_of(field, index) for field in zip(*rows, strict=True))
    kind = type(rows[0])
    return kind(*parts) if hasattr(kind, "_fields") else tuple(parts)


def check_flights(motion: Motion, wanted: Reference, time_s: np.ndarray) -> None:
    """Check at `time_s` (N,) [s] that N flights are upright, above ground and on their way.

    Raises:
        FlightFailed: where one has tipped over, hit the ground or left its trajectory.
    """
    off = np.sqrt(((motion.pos_w - wanted.pos_w) ** 2).sum(-1))
    # Written so that a state that is no number fails too.
    upright, high = motion.rot_w[:, 2, 2] > 0.0, motion.pos_w[:, 2] > LOWEST_M
    sound = (off < FURTHEST_M) & upright & high
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        raise FlightFailed(
            f"flight {bad + 1} failed at {time_s[bad]:.2f} s, {off[bad]:.1f} m off its trajectory; "
            "make the trajectory gentler or the effect weaker"
        )


@dataclass(frozen=True)
class PilotGains:
    """Gains of the pilot's position loop; attitude and rate loops have the vehicle file's gains."""

    position: float = 5.0
    """Acceleration per position error [1/s^2]."""
    velocity: float = 3.5
    """Acceleration per velocity error [1/s]."""
    integral: float = 2.0
    """Acceleration per summed position error [1/s^3]."""
    correction: float = 8.0
    """Largest correction of each component of the acceleration [m/s^2]."""


def corrected(
    gains: PilotGains,
    acc_w: Array,
    pos_error_w: Array,
    vel_error_w: Array,
    summed_w: Array | float = 0.0,
) -> Array:
    """Return the acceleration (..., 3) [m/s^2] that also brings a vehicle back to its path.

    Args:
        gains: of the position loop.
        acc_w: (..., 3) acceleration of the path [m/s^2].
        pos_error_w: (..., 3) path minus vehicle, position [m].
        vel_error_w: (..., 3) path minus vehicle, velocity [m/s].
        summed_w: (..., 3) integral of `pos_error_w` over time [m s].
    """
    xp = acc_w.__array_namespace__()
    correction = (
        gains.position * pos_error_w + gains.velocity * vel_error_w + gains.integral * summed_w
    )
    return acc_w + xp.clip(correction, -gains.correction, gains.correction)


def steer(
    vehicle: Vehicle, gains: PilotGains, wanted: Reference, motion: Motion, summed_w: np.ndarray
) -> Command:
    """Return the command that follows `wanted`; the pilot knows the nominal vehicle only.

    Args:
        vehicle: its controller's gains and limits are used.
        gains: of the position loop.
        wanted: of N flights at this moment.
        motion: (N, ...) true states.
        summed_w: (N, 3) integral of the position error over time [m s].
    """
    pos_error_w, vel_error_w = wanted.pos_w - motion.pos_w, wanted.vel_w - motion.vel_w
    acc_w = corrected(gains, wanted.acc_w, pos_error_w, vel_error_w, summed_w)
    force_w = acc_w + np.array([0.0, 0.0, GRAVITY])
    # Tilt of at most 70 degrees: a commanded free fall would turn the vehicle over.
    flat = np.sqrt((force_w[:, :2] ** 2).sum(-1))
    force_w[:, 2] = np.maximum(force_w[:, 2], np.maximum(0.36 * flat, 1.0))
    heading_w = np.stack(
        [np.cos(wanted.yaw), np.sin(wanted.yaw), np.zeros_like(wanted.yaw)], axis=-1
    )
    return attitude_command(vehicle.controller, force_w, motion.rot_w, heading_w)
