"""Commanded trajectories flown in MuJoCo's C engine, without noise and without obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.quadrotor.plant import Command, Motion, Wrench, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.pilot import Gains, steer
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
    import mujoco

    from eval.quadrotor.model import compile_quadrotor

    frequency = truth.controller.frequency
    period = round(frequency / rate_hz)
    if period < 1 or abs(period * rate_hz - frequency) > 1e-6 * frequency:
        raise ValueError(
            f"rate_hz = {rate_hz:g}: must divide the rate loop's frequency, {frequency:g} Hz"
        )
    dt, count = 1.0 / frequency, len(trajectories)
    steps = round(max(way.duration_s for way in trajectories) * frequency)
    clock = np.arange(0, steps, period) * dt
    ways = [way.reference(clock) for way in trajectories]
    wanted = Reference(*(np.stack(parts, axis=1) for parts in zip(*ways, strict=True)))
    plant = make_plant(truth, dt)
    draws = None
    if rng is not None and uses_noise(plant):
        draws = rng.standard_normal((steps + 1, count, 3))
    model = compile_quadrotor(mujoco.MjSpec(), truth, dt)
    datas = [mujoco.MjData(model) for _ in trajectories]
    for index, data in enumerate(datas):
        half = wanted.yaw[0, index] / 2
        data.qpos[:3] = wanted.pos_w[0, index]
        data.qpos[3:] = [np.cos(half), 0.0, 0.0, np.sin(half)]
        data.qvel[:3] = wanted.vel_w[0, index]
        mujoco.mj_step1(model, data)
    state = hover_state(plant, (count,), noise=None if draws is None else draws[0])
    hover = (state.rotor_speed**2).sum(-1)
    gains, summed_w = gains or Gains(), np.zeros((count, 3))
    command = Command(np.zeros(count), np.zeros((count, 3)))
    still = np.zeros((count, 3))
    acc_b = still + [0.0, 0.0, 9.81]
    kept: list[Any] = []
    for step in range(steps):
        time_s = step * dt
        motion, quat = _motion(datas)
        if step % period == 0:
            now = Reference(*(part[step // period] for part in wanted))
            _check(motion, now, time_s)
            summed_w = np.clip(summed_w + period * dt * (now.pos_w - motion.pos_w), -1.0, 1.0)
            command = steer(nominal, gains, now, motion, summed_w)
        power = (state.rotor_speed**2).sum(-1) / hover - 1.0
        drop = FALL_V_PER_S * time_s + SAG_V * power
        acting = command if extra is None else extra.command(command, time_s)
        speed = state.rotor_speed
        inputs = Inputs(
            acting,
            noise=None if draws is None else draws[step + 1],
            voltage_drop=drop if has_voltage else None,
        )
        state, wrench = plant_step(plant, state, motion, inputs, np.full(count, time_s))
        added = Wrench(still, still)
        if extra is not None:
            added = extra.wrench(motion, wrench, time_s, dt)
            wrench = Wrench(wrench.force_b + added.force_b, wrench.torque_b + added.torque_b)
        kept.append((motion, quat, speed, command, acc_b, FULL_V - drop, acting, added))
        acc_b = wrench.force_b / plant.constants.mass
        force_w = to_world(motion.rot_w, wrench.force_b)
        for index, data in enumerate(datas):
            data.qfrc_applied[:3] = force_w[index]
            data.qfrc_applied[3:] = wrench.torque_b[index]
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
    return [
        _recording(kept, index, round(way.duration_s * frequency), dt, period)
        for index, way in enumerate(trajectories)
    ]


def _motion(datas: Sequence[Any]) -> tuple[Motion, np.ndarray]:
    pose = np.array([data.qpos for data in datas])
    velocity = np.array([data.qvel for data in datas])
    rot_w = np.array([data.xmat[1] for data in datas]).reshape(-1, 3, 3)
    return Motion(pose[:, :3], rot_w, velocity[:, :3], velocity[:, 3:]), pose[:, 3:]


def _check(motion: Motion, wanted: Reference, time_s: float) -> None:
    off = np.sqrt(((motion.pos_w - wanted.pos_w) ** 2).sum(-1))
    # Written so that a state that is no number fails too.
    sound = (off < 4.0) & (motion.rot_w[:, 2, 2] > 0.0) & (motion.pos_w[:, 2] > 0.02)
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        raise FlightFailed(
            f"flight {bad + 1} failed at {time_s:.2f} s, {off[bad]:.1f} m off its trajectory; "
            "make the trajectory gentler or the effect weaker"
        )


def _recording(kept: list[Any], index: int, steps: int, dt: float, period: int) -> Recording:
    def column(pick: Any) -> np.ndarray:
        return np.array([pick(entry)[index] for entry in kept[:steps]])

    return Recording(
        dt=dt,
        period=period,
        time_s=np.arange(steps) * dt,
        motion=Motion(*(column(lambda entry, i=i: entry[0][i]) for i in range(4))),
        quat_wxyz=column(lambda entry: entry[1]),
        rotor_speed=column(lambda entry: entry[2]),
        command=Command(*(column(lambda entry, i=i: entry[3][i]) for i in range(2))),
        acc_b=column(lambda entry: entry[4]),
        voltage=column(lambda entry: entry[5]),
        acting=Command(*(column(lambda entry, i=i: entry[6][i]) for i in range(2))),
        extra=Wrench(*(column(lambda entry, i=i: entry[7][i]) for i in range(2))),
        integrator=INTEGRATOR,
    )
