"""Fly trajectories of blind cases in continuous time, with an engine of its own.

A blind case is a set of flights with hidden effects, on which the diagnosis is tested. The engine
(`suite/blind/continuous/`) shares no code with the model that the diagnosis fits. The tracking
controller, which follows the trajectory, is that of the other simulators: it only gives commands.
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

MARGIN_S = 0.25
"""Time that is simulated before the first row of the log and after the last one. A log with wrong
time stamps of the pose needs it [s]."""


def with_loop_frequency(vehicle: Vehicle, frequency: float) -> Vehicle:
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
    """Fly N trajectories in parallel.

    Args:
        nominal: vehicle whose constants the tracking controller uses.
        truth: vehicle that flies; its rate loop gets the frequency of `conditions`.
        trajectories: the trajectories; each is one flight.
        conditions: rates and jitter of the time stamps.
        rng: random generator of time stamps and gusts.
        extra: additional physics; None: none.
        step_s: longest step [s].

    Raises:
        FlightFailed: if a flight tips over, touches the ground or leaves its trajectory.
        ValueError: for an effect without an equation in the engine.
    """
    quadrotor = quadrotor_of(with_loop_frequency(truth, conditions.loop_hz))
    end_s = max(trajectory.duration_s for trajectory in trajectories) + MARGIN_S
    stamp_s = jittered_stamps(
        rng, len(trajectories), -MARGIN_S, end_s, conditions.row_hz, conditions.jitter
    )
    # Steps are short enough for the lag of the rotors, but not shorter than 2 % of `step_s`.
    lag_s = quadrotor.time_constant
    lag_step_s = min(step_s, lag_s / 5.0) if lag_s > 0.0 else step_s
    longest_s = max(lag_step_s, 0.02 * step_s)
    plan = schedule(stamp_s, 1.0 / conditions.loop_hz, quadrotor.delay, longest_s)
    pilot = _Pilot(nominal, trajectories, stamp_s, extra)
    start = np.zeros((len(trajectories), 13))
    for index, trajectory in enumerate(trajectories):
        # Before time 0 a trajectory is constant, except for its heading.
        first = trajectory.reference(stamp_s[:1, index])
        half_yaw = 0.5 * float(first.yaw[0])
        start[index, POS] = first.pos_w[0]
        start[index, QUAT] = [np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)]
    battery = Battery(FULL_V, FALL_V_PER_S, SAG_V)
    push = None if extra is None else pilot.push
    return fly(quadrotor, plan, start, pilot, rng, battery, push)


class _Pilot:
    """Tracking controller of N flights, with the additional physics of their case."""

    def __init__(
        self,
        nominal: Vehicle,
        trajectories: Sequence[Trajectory],
        stamp_s: np.ndarray,
        extra: Extra | None,
    ) -> None:
        self._nominal, self._stamp_s, self._extra = nominal, stamp_s, extra
        references = [t.reference(stamp_s[:, index]) for index, t in enumerate(trajectories)]
        fields = zip(*references, strict=True)
        self._reference = Reference(*(np.stack(field, axis=1) for field in fields))
        self._integral_w = np.zeros((len(trajectories), 3))

    def __call__(self, states: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Return the logged command and the command that acts, (N, 4) each.

        They differ if the additional physics changes commands.
        """
        row = states.number
        reference = Reference(*(field[row] for field in self._reference))
        motion = Motion(states.pos_w, states.rot_w, states.vel_w, states.rate_b)
        check_flights(motion, reference, states.time_s)
        dt = self._stamp_s[row] - self._stamp_s[max(row - 1, 0)]
        error_w = reference.pos_w - states.pos_w
        self._integral_w = np.clip(self._integral_w + dt[:, None] * error_w, -1.0, 1.0)
        command = steer(self._nominal, PilotGains(), reference, motion, self._integral_w)
        acting = command
        if self._extra is not None:
            acting = self._extra.command(command, float(states.time_s[0]))
        return command.packed, acting.packed

    def push(self, states: Rows, force_b: np.ndarray, length_s: np.ndarray) -> np.ndarray:
        """Return the force of the additional physics in a step, (N, 3) in body axes [N].

        `force_b` (N, 3) is the force of everything else [N], `length_s` (N, 1) the step's length.
        """
        assert self._extra is not None
        motion = Motion(states.pos_w, states.rot_w, states.vel_w, states.rate_b)
        wrench = Wrench(force_b, np.zeros_like(force_b))
        time_s = states.time_s[:, None]
        # The time has one number per flight; other simulators give one number for all.
        return self._extra.wrench(motion, wrench, time_s, length_s).force_b  # pyright: ignore[reportArgumentType]


def logs_of(
    flown: Flown,
    trajectories: Sequence[Trajectory],
    truth: Vehicle,
    sensors: Sensors,
    conditions: Conditions,
    rng: np.random.Generator | None,
) -> tuple[FlightLog, ...]:
    """Return the logs of the flights, with the noise density of `sensors`.

    Args:
        flown: the flights.
        trajectories: trajectories of the flights, which determine the durations of the logs.
        truth: the vehicle that flew.
        sensors: logged channels and their noise.
        conditions: rates, jitter and lost rows.
        rng: random generator of the noise; None: no noise.
    """
    noise, about = Noise(*astuple(sensors)[1:]), {"source": "suite blind", "vehicle": truth.name}
    return tuple(
        log_of_flight(
            flown, index, trajectory.duration_s, truth.effects, noise, conditions, rng,
            f"flight_{index + 1}", about,
        )
        for index, trajectory in enumerate(trajectories)
    )  # fmt: skip
