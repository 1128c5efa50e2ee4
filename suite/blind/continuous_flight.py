"""Fly trajectories of blind cases in continuous time, with an engine of its own.

The tracking controller is that of the other simulators: it only gives commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eval.flights.follow import SUM_MOST, check_flights, steer
from eval.flights.simulate import FALL_V_PER_S, FULL_V, SAG_V, Extra, Sensors
from eval.flights.trajectory import Reference, Trajectory
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from suite.blind.continuous.body import POS, QUAT, Battery
from suite.blind.continuous.engine import Flown, Rows, fly
from suite.blind.continuous.log import log_of_flight
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

    The tracking controller uses the constants of the `nominal` vehicle; the `truth` flies, with a
    rate loop at the frequency of `conditions`. `rng` draws time stamps and gusts. Steps are at most
    `step_s` long [s].

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
    # Before time 0 a trajectory is constant, except for its heading.
    first = pilot.reference(0)
    start[:, POS] = first.pos_w
    start[:, QUAT.start], start[:, QUAT.stop - 1] = np.cos(first.yaw / 2), np.sin(first.yaw / 2)
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
        self._references = [np.stack(part, axis=1) for part in zip(*references, strict=True)]
        self._integral_w = np.zeros((len(trajectories), 3))
        self._end_s = np.array([t.duration_s for t in trajectories]) + MARGIN_S

    def reference(self, row: int) -> Reference:
        """Return the set points (N, ...) at a row."""
        return Reference(*(part[row] for part in self._references))

    def __call__(self, states: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Return the logged command and the command that acts, (N, 4) each.

        They differ if the additional physics changes commands.
        """
        row = states.number
        reference, motion = self.reference(row), _motion(states)
        check_flights(motion, reference, states.time_s, states.time_s < self._end_s)
        dt = self._stamp_s[row] - self._stamp_s[max(row - 1, 0)]
        error_w = reference.pos_w - states.pos_w
        self._integral_w = self._integral_w + dt[:, None] * error_w
        self._integral_w = np.clip(self._integral_w, -SUM_MOST, SUM_MOST)
        command = steer(self._nominal, reference, motion, self._integral_w)
        if self._extra is None:
            return command.packed, command.packed
        return command.packed, self._extra.command(command, float(states.time_s[0])).packed

    def push(self, states: Rows, force_b: np.ndarray, length_s: np.ndarray) -> np.ndarray:
        """Return the force of the additional physics in a step, (N, 3) in body axes [N].

        `force_b` (N, 3) is the force of everything else [N], `length_s` (N, 1) the step's length.
        """
        assert self._extra is not None
        wrench, time_s = Wrench(force_b, np.zeros_like(force_b)), states.time_s[:, None]
        # The time has one number per flight; other simulators give one number for all.
        return self._extra.wrench(_motion(states), wrench, time_s, length_s).force_b  # pyrefly: ignore[bad-argument-type]


def _motion(states: Rows) -> Motion:
    """Return the states of the engine in the form of the tracking controller."""
    return Motion(states.pos_w, states.rot_w, states.vel_w, states.rate_b)


def logs_of(
    flown: Flown,
    trajectories: Sequence[Trajectory],
    truth: Vehicle,
    sensors: Sensors,
    conditions: Conditions,
    rng: np.random.Generator | None,
) -> tuple[FlightLog, ...]:
    """Return the logs of the flights of `trajectories`, with the noise density of `sensors`.

    `truth` is the vehicle that flew. The other arguments are those of `log_of_flight`.
    """
    about = {"source": "suite blind", "vehicle": truth.name}
    return tuple(
        log_of_flight(
            flown, index, trajectory.duration_s, truth.effects, sensors, conditions, rng,
            f"flight_{index + 1}", about,
        )
        for index, trajectory in enumerate(trajectories)
    )  # fmt: skip
