"""Commanded trajectories flown in MuJoCo's C engine, without noise and without obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from eval.quadrotor.plant import Command, Motion, Plant, Wrench, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.follow import Recording, Step, follow, wanted_of
from suite.diagnose.plans.pilot import Gains
from suite.diagnose.plans.trajectory import Reference, Trajectory
from tracks.geometry.rotation import to_world

FULL_V = 16.5
"""Of the battery at the start [V]."""
FALL_V_PER_S = 0.02
"""Of the battery's voltage while it empties [V/s]."""
SAG_V = 0.35
"""Further fall of the voltage where the rotors take twice the power of a hover [V]."""

INTEGRATOR = "euler"
"""MuJoCo's of our models; a command acts on whole steps of it."""


class Extra(Protocol):
    """Physics besides the vehicle's, acting on N flights at once."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command that acts in place of `command`, once a step."""
        ...

    def wrench(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> Wrench:
        """Return the wrench (N, 3) that is added to `wrench`, once a step."""
        ...


def fly(
    nominal: Vehicle,
    truth: Vehicle,
    trajectories: Sequence[Trajectory],
    rate_hz: float = 100.0,
    extra: Extra | None = None,
    rng: np.random.Generator | None = None,
    has_voltage: bool = False,
    gains: Gains | None = None,
) -> list[Recording]:
    """Fly `trajectories` side by side and return what happened.

    Args:
        nominal: what the pilot believes.
        truth: what is flown: the same quadrotor with the effects that are true.
        trajectories: N of them.
        rate_hz: of commands and of log rows; the rate loop's frequency must be a multiple of it.
        extra: physics besides the effects.
        rng: for random wind; none blows without it.
        has_voltage: whether effects see the battery's voltage, as they do where it is logged.
        gains: of the pilot.

    Raises:
        FlightFailed: where a flight tips over, leaves the air or its trajectory.
        ValueError: for a rate that does not divide the rate loop's frequency.
    """
    frequency = truth.controller.frequency
    period = round(frequency / rate_hz)
    if period < 1 or abs(period * rate_hz - frequency) > 1e-6 * frequency:
        raise ValueError(
            f"rate_hz = {rate_hz:g}: must divide the rate loop's frequency, {frequency:g} Hz"
        )
    dt = 1.0 / frequency
    wanted = wanted_of(trajectories, period, dt)
    plant = make_plant(truth, dt)
    draws = None
    if rng is not None and uses_noise(plant):
        steps = round(max(way.duration_s for way in trajectories) * frequency)
        draws = rng.standard_normal((steps + 1, len(trajectories), 3))
    bodies = _MujocoBodies(truth, plant, wanted, dt, extra, draws, has_voltage)
    return follow(bodies, nominal, trajectories, wanted, period, dt, gains)


class _MujocoBodies:
    """N quadrotors, each in a model of its own."""

    integrator: str | None = INTEGRATOR

    def __init__(
        self,
        truth: Vehicle,
        plant: Plant,
        wanted: Reference,
        dt: float,
        extra: Extra | None,
        draws: np.ndarray | None,
        has_voltage: bool,
    ) -> None:
        import mujoco

        from eval.quadrotor.model import compile_quadrotor

        self._plant, self._dt, self._extra, self._draws = plant, dt, extra, draws
        self._has_voltage, self._steps = has_voltage, 0
        count = wanted.yaw.shape[1]
        self._model = compile_quadrotor(mujoco.MjSpec(), truth, dt)
        self._datas = [mujoco.MjData(self._model) for _ in range(count)]
        self._first, self._second = mujoco.mj_step1, mujoco.mj_step2
        for index, data in enumerate(self._datas):
            half = wanted.yaw[0, index] / 2
            data.qpos[:3] = wanted.pos_w[0, index]
            data.qpos[3:] = [np.cos(half), 0.0, 0.0, np.sin(half)]
            data.qvel[:3] = wanted.vel_w[0, index]
            self._first(self._model, data)
        noise = None if draws is None else draws[0]
        self._state = hover_state(plant, (count,), noise=noise)
        self._hover = (self._state.rotor_speed**2).sum(-1)
        self._still = Wrench(np.zeros((count, 3)), np.zeros((count, 3)))

    def motion(self) -> tuple[Motion, np.ndarray]:
        pose = np.array([data.qpos for data in self._datas])
        velocity = np.array([data.qvel for data in self._datas])
        rot_w = np.array([data.xmat[1] for data in self._datas]).reshape(-1, 3, 3)
        return Motion(pose[:, :3], rot_w, velocity[:, :3], velocity[:, 3:]), pose[:, 3:]

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        speed, added = self._state.rotor_speed, self._still
        power = (speed**2).sum(-1) / self._hover - 1.0
        drop = FALL_V_PER_S * time_s + SAG_V * power
        acting = command if self._extra is None else self._extra.command(command, time_s)
        self._steps += 1
        inputs = Inputs(
            acting,
            noise=None if self._draws is None else self._draws[self._steps],
            voltage_drop=drop if self._has_voltage else None,
        )
        now = np.full(len(self._datas), time_s)
        self._state, wrench = plant_step(self._plant, self._state, motion, inputs, now)
        if self._extra is not None:
            added = self._extra.wrench(motion, wrench, time_s, self._dt)
            wrench = Wrench(wrench.force_b + added.force_b, wrench.torque_b + added.torque_b)
        force_w = to_world(motion.rot_w, wrench.force_b)
        for index, data in enumerate(self._datas):
            data.qfrc_applied[:3] = force_w[index]
            data.qfrc_applied[3:] = wrench.torque_b[index]
            self._second(self._model, data)
            self._first(self._model, data)
        acc_b = wrench.force_b / self._plant.constants.mass
        return Step(speed, FULL_V - drop, acting, added, acc_b)
