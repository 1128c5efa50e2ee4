"""A pilot follows trajectories with whatever flies: the loop that simulators share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command, Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.pilot import Gains, steer
from suite.diagnose.plans.trajectory import Reference, Trajectory

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
    """(K, ...) as the pilot gave it."""
    acc_b: np.ndarray
    """(K, 3) specific force in the step that has just ended [m/s^2]."""
    voltage: np.ndarray
    """(K,) [V]."""
    acting: Command
    """(K, ...) what acted, before the vehicle's own delay; differs from `command` by an `Extra`."""
    extra: Wrench
    """(K, 3) what an `Extra` added."""
    integrator: str | None = None
    """How the simulator stepped where its step shows in the flight: `euler`, by `dt`."""


class FlightFailed(RuntimeError):
    """A simulated flight went where no log should: tipped over, into the ground, or away."""


class Step(NamedTuple):
    """What N bodies had in a step that has just ended."""

    rotor_speed: np.ndarray
    """(N, 4) at its start [rad/s]."""
    voltage: np.ndarray
    """(N,) [V]."""
    acting: Command
    """(N, ...) what acted, before the vehicle's own delay."""
    extra: Wrench
    """(N, 3) what an `Extra` added."""
    acc_b: np.ndarray
    """(N, 3) specific force [m/s^2]."""


class Bodies(Protocol):
    """N vehicles that a simulator steps side by side."""

    integrator: str | None
    """That of a `Recording`."""

    def motion(self) -> tuple[Motion, np.ndarray]:
        """Return how they move now, and their attitudes (N, 4) wxyz."""
        ...

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        """Go one step of physics further from `motion` at `time_s` [s], under a command each."""
        ...


def wanted_of(trajectories: Sequence[Trajectory], period: int, dt: float) -> Reference:
    """Return what N trajectories want at every command, (commands, N, ...)."""
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
    gains: Gains | None = None,
) -> list[Recording]:
    """Fly `trajectories` side by side and return what happened.

    Args:
        bodies: N of them, where and as fast as the trajectories begin.
        nominal: what the pilot believes.
        trajectories: N of them.
        wanted: what they want, by `wanted_of`.
        period: physics steps for which a command is held.
        dt: of a physics step [s].
        gains: of the pilot.

    Raises:
        FlightFailed: where a flight tips over, leaves the air or its trajectory.
    """
    count = len(trajectories)
    steps = [round(way.duration_s / dt) for way in trajectories]
    gains, summed_w = gains or Gains(), np.zeros((count, 3))
    command = Command(np.zeros(count), np.zeros((count, 3)))
    acc_b = np.zeros((count, 3)) + [0.0, 0.0, GRAVITY]
    motions, quats, commands, accs, stepped = [], [], [], [], []
    for step in range(max(steps)):
        motion, quat = bodies.motion()
        if step % period == 0:
            now = Reference(*(part[step // period] for part in wanted))
            check_flights(motion, now, np.full(count, step * dt))
            summed_w = np.clip(summed_w + period * dt * (now.pos_w - motion.pos_w), -1.0, 1.0)
            command = steer(nominal, gains, now, motion, summed_w)
        entry = bodies.step(motion, command, step * dt)
        motions.append(motion)
        quats.append(quat)
        commands.append(command)
        accs.append(acc_b)
        stepped.append(entry)
        acc_b = entry.acc_b
    whole = Recording(
        dt,
        period,
        np.arange(max(steps)) * dt,
        Motion(*map(np.array, zip(*motions, strict=True))),
        np.array(quats),
        np.array([entry.rotor_speed for entry in stepped]),
        Command(*map(np.array, zip(*commands, strict=True))),
        np.array(accs),
        np.array([entry.voltage for entry in stepped]),
        Command(*map(np.array, zip(*(entry.acting for entry in stepped), strict=True))),
        Wrench(*map(np.array, zip(*(entry.extra for entry in stepped), strict=True))),
        bodies.integrator,
    )
    return [_flight(whole, index, count) for index, count in enumerate(steps)]


def check_flights(motion: Motion, wanted: Reference, time_s: np.ndarray) -> None:
    """Check that N flights are where a log may be, at `time_s` (N,) [s].

    Raises:
        FlightFailed: where one has tipped over, left the air or its trajectory.
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


def _flight(whole: Recording, index: int, steps: int) -> Recording:
    """Return one flight of N that were recorded together, (K, N, ...)."""

    def mine(part: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(part[:steps, index])

    return whole._replace(
        time_s=whole.time_s[:steps],
        motion=Motion(*map(mine, whole.motion)),
        quat_wxyz=mine(whole.quat_wxyz),
        rotor_speed=mine(whole.rotor_speed),
        command=Command(*map(mine, whole.command)),
        acc_b=mine(whole.acc_b),
        voltage=mine(whole.voltage),
        acting=Command(*map(mine, whole.acting)),
        extra=Wrench(*map(mine, whole.extra)),
    )
