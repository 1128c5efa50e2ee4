"""Commanded trajectories flown in RotorPy, another simulator with equations of its own.

Pilot, rate loop and mixer are ours, since they are what the vehicle file describes; rotors, air
and rigid body are RotorPy's, with the parameters of `eval.worlds.other.rotorpy_vehicle`. One flight
is stepped after the other by RotorPy's adaptive integrator; that of the world `rotorpy` is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eval.quadrotor.plant import Command, Motion, Wrench, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from eval.worlds.other.rotorpy_vehicle import ROTORPY_EFFECTS, rotorpy_parameters
from suite.diagnose.plans.pilot import Gains, steer
from suite.diagnose.plans.simulate import FULL_V, FlightFailed, Recording
from suite.diagnose.plans.trajectory import Reference, Trajectory
from tracks.geometry.rotation import quat_to_rot


def exact_parameters(truth: Vehicle) -> dict[str, Any]:
    """Return RotorPy's parameters of a vehicle, all of whose effects it must have as they are.

    Raises:
        ValueError: for an effect that RotorPy does not have.
    """
    for name in truth.effects:
        if name not in ROTORPY_EFFECTS:
            raise ValueError(
                f"effects.{name}: RotorPy does not have it; allowed: {', '.join(ROTORPY_EFFECTS)}"
            )
    return rotorpy_parameters(truth)


def fly_rotorpy(
    nominal: Vehicle, truth: Vehicle, trajectories: Sequence[Trajectory], rate_hz: float
) -> list[Recording]:
    """Fly `trajectories` one after another in RotorPy; the arguments are those of `fly`.

    Raises:
        FlightFailed: where a flight tips over, leaves the air or its trajectory.
        ModuleNotFoundError: where RotorPy is not installed (extra `rotorpy`).
        ValueError: for an effect that RotorPy does not have.
    """
    parameters = exact_parameters(truth)
    return [_one(nominal, truth, parameters, way, rate_hz) for way in trajectories]


def _one(
    nominal: Vehicle, truth: Vehicle, parameters: dict[str, Any], way: Trajectory, rate_hz: float
) -> Recording:
    # An optional extra, which need not be installed where types are checked.
    from rotorpy.vehicles.multirotor import Multirotor  # pyright: ignore[reportMissingImports]

    frequency = nominal.controller.frequency
    dt, period = 1.0 / frequency, round(frequency / rate_hz)
    steps = round(way.duration_s * frequency)
    plant = make_plant(nominal, dt)
    hover = wanted_speed(plant, Command(np.array(9.81), np.zeros(3)), np.zeros(3))
    wanted = way.reference(np.arange(0, steps, period) * dt)
    half = wanted.yaw[0] / 2
    state = {
        "x": wanted.pos_w[0],
        "v": wanted.vel_w[0],
        "q": np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": hover,
    }
    body = Multirotor(parameters, initial_state=state, control_abstraction="cmd_motor_speeds")
    command, summed_w = Command(np.zeros(1), np.zeros((1, 3))), np.zeros((1, 3))
    acc_b, kept = np.array([0.0, 0.0, 9.81]), []
    for step in range(steps):
        quat = state["q"][[3, 0, 1, 2]]
        rot_w = quat_to_rot(quat)
        motion = Motion(state["x"], rot_w, state["v"], state["w"])
        if step % period == 0:
            now = Reference(*(part[None, step // period] for part in wanted))
            error = now.pos_w - motion.pos_w
            if not (np.linalg.norm(error) < 4.0 and rot_w[2, 2] > 0.0 and motion.pos_w[2] > 0.02):
                raise FlightFailed(
                    f"{way.kind} failed at {step * dt:.2f} s in RotorPy; make it gentler"
                )
            summed_w = np.clip(summed_w + period * dt * error, -1.0, 1.0)
            batch = Motion(*(part[None] for part in motion))
            command = steer(nominal, Gains(), now, batch, summed_w)
        kept.append((motion, quat, state["rotor_speeds"], command, acc_b))
        speeds = wanted_speed(plant, Command(*(part[0] for part in command)), motion.rate_b)
        state = body.step(state, {"cmd_motor_speeds": speeds}, dt)
        turn = quat_to_rot(state["q"][[3, 0, 1, 2]])
        force_b, _ = body.compute_body_wrench(
            state["w"], state["rotor_speeds"], turn.T @ state["v"]
        )
        acc_b = force_b / parameters["mass"]
    still = np.zeros((steps, 3))
    flown = Command(
        np.array([entry[3].thrust[0] for entry in kept]),
        np.array([entry[3].rate_b[0] for entry in kept]),
    )
    return Recording(
        dt=dt,
        period=period,
        time_s=np.arange(steps) * dt,
        motion=Motion(*(np.array([entry[0][i] for entry in kept]) for i in range(4))),
        quat_wxyz=np.array([entry[1] for entry in kept]),
        rotor_speed=np.array([entry[2] for entry in kept]),
        command=flown,
        acc_b=np.array([entry[4] for entry in kept]),
        voltage=np.full(steps, FULL_V),
        acting=flown,
        extra=Wrench(still, still),
    )
