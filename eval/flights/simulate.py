"""Fly commanded trajectories in MuJoCo, and make logs of the flights with sensor noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from eval.effects.log_faults import apply_log_faults
from eval.flights.follow import Recording, Step, follow, reference_of
from eval.flights.trajectory import Reference, Trajectory
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Command, Motion, Plant, Wrench, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.rotation import to_world

FULL_V = 16.5
"""Battery voltage at the start of a flight [V]."""
FALL_V_PER_S = 0.02
"""Rate at which the voltage falls as the battery discharges [V/s]."""
SAG_V = 0.35
"""Additional voltage drop at twice the power of a hover [V]."""

INTEGRATOR = "euler"
"""MuJoCo's integrator in the suite's models; a command acts for whole steps."""


class Extra(Protocol):
    """Physics that no effect of the catalogue describes, for N flights at once."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command that acts instead of `command`; called once a step."""
        ...

    def wrench(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> Wrench:
        """Return a force and torque (N, 3) to add to `wrench`; called once a step."""
        ...


def fly(
    nominal: Vehicle,
    truth: Vehicle,
    trajectories: Sequence[Trajectory],
    rate_hz: float = 100.0,
    extra: Extra | None = None,
    rng: np.random.Generator | None = None,
    has_voltage: bool = False,
) -> list[Recording]:
    """Fly N trajectories at once, each with its own vehicle, and return their recordings.

    Args:
        nominal: the vehicle that the position controller assumes.
        truth: the vehicle that flies: the same quadrotor with the true effects.
        trajectories: the N trajectories.
        rate_hz: rate of commands and log rows; the rate loop's frequency must be a multiple of it.
        extra: physics that no effect describes; None: none.
        rng: random generator for random wind; None: no random wind.
        has_voltage: whether effects depend on the battery's voltage, as for logs that contain it.

    Raises:
        FlightFailed: where a flight tips over, hits the ground or leaves its trajectory.
        ValueError: for a rate that does not divide the rate loop's frequency.
    """
    frequency = truth.controller.frequency
    period = round(frequency / rate_hz)
    if period < 1 or abs(period * rate_hz - frequency) > 1e-6 * frequency:
        raise ValueError(
            f"rate_hz = {rate_hz:g}: must divide the rate loop's frequency, {frequency:g} Hz"
        )
    dt = 1.0 / frequency
    wanted = reference_of(trajectories, period, dt)
    plant = make_plant(truth, dt)
    noise = None
    if rng is not None and uses_noise(plant):
        steps = round(max(path.duration_s for path in trajectories) * frequency)
        noise = rng.standard_normal((steps + 1, len(trajectories), 3))
    bodies = _MujocoBodies(truth, plant, wanted, dt, extra, noise, has_voltage)
    return follow(bodies, nominal, trajectories, wanted, period, dt)


class _MujocoBodies:
    """N quadrotors in MuJoCo, each in its own simulation."""

    integrator: str | None = INTEGRATOR

    def __init__(
        self,
        truth: Vehicle,
        plant: Plant,
        wanted: Reference,
        dt: float,
        extra: Extra | None,
        noise: np.ndarray | None,
        has_voltage: bool,
    ) -> None:
        import mujoco

        from eval.quadrotor.model import compile_quadrotor

        self._plant, self._dt, self._extra, self._noise = plant, dt, extra, noise
        self._has_voltage, self._steps = has_voltage, 0
        count = wanted.yaw.shape[1]
        self._model = compile_quadrotor(mujoco.MjSpec(), truth, dt)
        self._datas = [mujoco.MjData(self._model) for _ in range(count)]
        self._step1, self._step2 = mujoco.mj_step1, mujoco.mj_step2
        for index, data in enumerate(self._datas):
            half = wanted.yaw[0, index] / 2
            data.qpos[:3] = wanted.pos_w[0, index]
            data.qpos[3:] = [np.cos(half), 0.0, 0.0, np.sin(half)]
            data.qvel[:3] = wanted.vel_w[0, index]
            self._step1(self._model, data)
        self._state = hover_state(plant, (count,), noise=None if noise is None else noise[0])
        self._hover = (self._state.rotor_speed**2).sum(-1)

    def motion(self) -> tuple[Motion, np.ndarray]:
        pose = np.array([data.qpos for data in self._datas])
        velocity = np.array([data.qvel for data in self._datas])
        rot_w = np.array([data.xmat[1] for data in self._datas]).reshape(-1, 3, 3)
        return Motion(pose[:, :3], rot_w, velocity[:, :3], velocity[:, 3:]), pose[:, 3:]

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        """Simulate one physics step; see `eval.flights.follow.Bodies`."""
        speed = self._state.rotor_speed
        power = (speed**2).sum(-1) / self._hover - 1.0
        drop = FALL_V_PER_S * time_s + SAG_V * power
        acting = command if self._extra is None else self._extra.command(command, time_s)
        self._steps += 1
        inputs = Inputs(
            acting,
            noise=None if self._noise is None else self._noise[self._steps],
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
            self._step2(self._model, data)
            self._step1(self._model, data)
        acc_b = wrench.force_b / self._plant.constants.mass
        return Step(speed, FULL_V - drop, acc_b)


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of the white noise of a log's signals; 0: the signal is not logged."""

    name: str
    """Name of the set of sensors in tables."""
    rate_hz: float
    """Rate of the log [Hz]."""
    pos: float
    """Noise of the position, each axis [m]."""
    attitude: float
    """Noise of the attitude, about each body axis [rad]."""
    gyro: float
    """Noise of the body rates, each axis [rad/s]."""
    vel: float = 0.0
    """Noise of the velocity, each axis [m/s]."""
    acc: float = 0.0
    """Noise of the specific force, each axis [m/s^2]."""
    rotor: float = 0.0
    """Noise of the speed of each rotor [rad/s]."""
    voltage: float = 0.0
    """Noise of the battery voltage [V]."""
    lost: float = 0.0
    """Share of rows without a pose; each gap has three rows."""


SENSORS: dict[str, Sensors] = {
    sensors.name: sensors
    for sensors in (
        Sensors("capture", 100.0, pos=0.001, attitude=0.0026, gyro=0.02, lost=0.005),
        Sensors("estimator", 100.0, pos=0.005, attitude=0.004, gyro=0.02, vel=0.03, acc=0.3),
        Sensors(
            "full",
            125.0,
            pos=0.002,
            attitude=0.003,
            gyro=0.02,
            vel=0.03,
            acc=0.3,
            rotor=5.0,
            voltage=0.02,
        ),
    )
}
"""Sets of sensors by name: motion capture and a gyro; a state estimator; and all signals."""


def log_of(
    recording: Recording,
    truth: Vehicle,
    sensors: Sensors,
    rng: np.random.Generator | None,
    name: str = "flight",
) -> FlightLog:
    """Return the log of a flight, with the true vehicle's log faults, then noise and gaps.

    The faults (such as a gyro bias) apply at the physics rate of the recording. The rate of
    `sensors` must be the recording's. Without `rng` the log has neither noise nor gaps.
    """
    motion = recording.motion
    true = {
        "time_s": recording.time_s,
        "pos_w": motion.pos_w,
        "quat_wxyz": recording.quat_wxyz,
        "vel_w": motion.vel_w,
        "rate_b": motion.rate_b,
        "acc_b": recording.acc_b,
    }
    logged = apply_log_faults(truth.effects, true)
    rows = slice(None, None, recording.period)
    about: dict[str, Any] = {"source": "suite blind"}
    if recording.integrator is not None:
        about |= {"integrator": recording.integrator, "step_s": recording.dt}

    def noisy(values: np.ndarray, sigma: float) -> np.ndarray:
        values = np.array(values[rows])
        return values if rng is None else values + sigma * rng.standard_normal(values.shape)

    pos_w, rate_b = noisy(logged["pos_w"], sensors.pos), noisy(logged["rate_b"], sensors.gyro)
    quat = np.array(logged["quat_wxyz"][rows])
    if rng is not None:
        # The attitude's noise is a small rotation about body axes.
        error = Rotation.from_rotvec(sensors.attitude * rng.standard_normal((len(quat), 3)))
        quat = (Rotation.from_quat(quat, scalar_first=True) * error).as_quat(scalar_first=True)
        starts_gap = rng.random(len(quat)) < sensors.lost / 3.0
        starts_gap[:2] = starts_gap[-4:] = False
        for row in np.flatnonzero(starts_gap):
            pos_w[row : row + 3] = np.nan
            quat[row : row + 3] = np.nan
    return FlightLog(
        name=name,
        time_s=recording.time_s[rows].copy(),
        pos_w=pos_w,
        quat_wxyz=quat,
        vel_w=noisy(logged["vel_w"], sensors.vel),
        rate_b=rate_b,
        thrust_cmd=recording.command.thrust[rows].copy(),
        rate_cmd_b=recording.command.rate_b[rows].copy(),
        rotor_speed=noisy(recording.rotor_speed, sensors.rotor) if sensors.rotor else None,
        acc_b=noisy(logged["acc_b"], sensors.acc) if sensors.acc else None,
        voltage=noisy(recording.voltage, sensors.voltage) if sensors.voltage else None,
        about=about,
        # Without a velocity sensor, the velocity counts as derived and is not written to a file.
        velocity_derived=not sensors.vel,
    )
