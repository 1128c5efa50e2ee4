"""Commanded trajectories flown in continuous time by an engine that shares no code with the fit.

The tracking controller is the one of the other simulators, since it only gives commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace

import numpy as np

from eval.flights.follow import PilotGains, check_flights, steer
from eval.flights.simulate import FALL_V_PER_S, FULL_V, SAG_V, Extra, Sensors
from eval.flights.trajectory import Reference, Trajectory
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from suite.blind.continuous.body import POS, QUAT, Battery
from suite.blind.continuous.engine import Flown, Rows, fly
from suite.blind.continuous.log import Noise, log_of_flight
from suite.blind.continuous.quadrotor import quadrotor_of
from suite.blind.continuous.timing import STEP_S, Conditions, jittered_stamps, schedule

ROLL_S = 0.25
"""Time before the first row and after the last one, for poses with a time offset [s]."""


def with_loop(vehicle: Vehicle, frequency: float) -> Vehicle:
    """Return `vehicle` with its rate loop at `frequency` [Hz]."""
    return replace(vehicle, controller=replace(vehicle.controller, frequency=frequency))


def fly_continuous(
    nominal: Vehicle,
    truth: Vehicle,
    trajectories: Sequence[Trajectory],
    conditions: Conditions,
    rng: np.random.Generator,
    extra: Extra | None = None,
    step_s: float = STEP_S,
) -> Flown:
    """Fly `trajectories` side by side.

    Args:
        nominal: vehicle of the tracking controller.
        truth: flown vehicle; its loop has the frequency of `conditions`.
        trajectories: N of them.
        conditions: rates and jitter.
        rng: of stamps and gusts.
        extra: additional physics.
        step_s: longest step [s].

    Raises:
        FlightFailed: if a flight tips over, touches the ground or leaves its trajectory.
        ValueError: for an effect without an equation in the engine.
    """
    quadrotor = quadrotor_of(with_loop(truth, conditions.loop_hz))
    last = max(way.duration_s for way in trajectories)
    stamp_s = jittered_stamps(
        rng, len(trajectories), -ROLL_S, last + ROLL_S, conditions.row_hz, conditions.jitter
    )
    lag = quadrotor.time_constant
    finest = min(step_s, lag / 5.0) if lag > 0.0 else step_s
    plan = schedule(stamp_s, 1.0 / conditions.loop_hz, quadrotor.delay, max(finest, 0.02 * step_s))
    pilot = _Pilot(nominal, trajectories, stamp_s, extra)
    start = np.zeros((len(trajectories), 13))
    for index, way in enumerate(trajectories):
        # Before time 0 a trajectory is constant, except for its heading.
        first = way.reference(stamp_s[:1, index])
        half = 0.5 * float(first.yaw[0])
        start[index, POS] = first.pos_w[0]
        start[index, QUAT] = [np.cos(half), 0.0, 0.0, np.sin(half)]
    battery = Battery(FULL_V, FALL_V_PER_S, SAG_V)
    push = None if extra is None else pilot.push
    return fly(quadrotor, plan, start, pilot, rng, battery, push)


class _Pilot:
    """Tracks the trajectories of N flights, row by row."""

    def __init__(
        self, nominal: Vehicle, ways: Sequence[Trajectory], stamp_s: np.ndarray, extra: Extra | None
    ) -> None:
        self._nominal, self._stamp_s, self._extra = nominal, stamp_s, extra
        each = [way.reference(stamp_s[:, index]) for index, way in enumerate(ways)]
        self._wanted = Reference(*(np.stack(parts, axis=1) for parts in zip(*each, strict=True)))
        self._summed_w = np.zeros((len(ways), 3))

    def __call__(self, seen: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Return the logged command and the command that acts, (N, 4) each."""
        row = seen.number
        now = Reference(*(part[row] for part in self._wanted))
        motion = Motion(seen.pos_w, seen.rot_w, seen.vel_w, seen.rate_b)
        check_flights(motion, now, seen.time_s)
        since = self._stamp_s[row] - self._stamp_s[max(row - 1, 0)]
        off = now.pos_w - seen.pos_w
        self._summed_w = np.clip(self._summed_w + since[:, None] * off, -1.0, 1.0)
        given = steer(self._nominal, PilotGains(), now, motion, self._summed_w)
        acting = given
        if self._extra is not None:
            acting = self._extra.command(given, float(seen.time_s[0]))
        return given.packed, acting.packed

    def push(self, seen: Rows, force_b: np.ndarray, length_s: np.ndarray) -> np.ndarray:
        """Return the force of the additional physics in a step (N, 3) [N]."""
        assert self._extra is not None
        motion = Motion(seen.pos_w, seen.rot_w, seen.vel_w, seen.rate_b)
        wrench = Wrench(force_b, np.zeros_like(force_b))
        time_s = seen.time_s[:, None]
        # One number per flight, unlike in other simulators.
        return self._extra.wrench(motion, wrench, time_s, length_s).force_b  # pyright: ignore[reportArgumentType]


def logs_of(
    flown: Flown,
    trajectories: Sequence[Trajectory],
    truth: Vehicle,
    sensors: Sensors,
    conditions: Conditions,
    rng: np.random.Generator | None,
) -> tuple[FlightLog, ...]:
    """Return the flights' logs with the noise density of `sensors`, or without if `rng` is None."""
    noise, about = Noise(*astuple(sensors)[1:]), {"source": "suite blind", "vehicle": truth.name}
    return tuple(
        log_of_flight(
            flown, index, way.duration_s, truth.effects, noise, conditions, rng,
            f"flight_{index + 1}", about,
        )
        for index, way in enumerate(trajectories)
    )  # fmt: skip
