"""Flights for the diagnosis: flown in MuJoCo by a plain trajectory tracker, logged with noise."""

import mujoco
import numpy as np

from eval.effects.log_faults import apply_log_faults
from eval.logs.flight_log import FlightLog
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Command, Motion, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from tracks.geometry.rotation import quat_to_rot

NOISE = {"pos": 0.002, "att": 0.004, "vel": 0.02, "rate": 0.02, "motor": 4.0, "acc": 0.15}
EVERY = 5
"""Physics steps a row."""


def reference(rng, speed):
    """A closed curve of three sines an axis: position, velocity, acceleration at a time."""
    size = np.array([[3.0, 0.8, 0.3], [2.5, 0.8, 0.3], [0.5, 0.25, 0.1]])
    rate = speed / 4.0 * np.array([[1.0, 1.9, 3.1], [0.8, 1.7, 2.9], [1.1, 2.0, 3.3]])
    rate = rate * rng.uniform(0.85, 1.15, (3, 3))
    phase = rng.uniform(0, 2 * np.pi, (3, 3))

    def at(t):
        angle = rate * t + phase
        pos = (size * np.sin(angle)).sum(1) + [0, 0, 1.6]
        vel = (size * rate * np.cos(angle)).sum(1)
        return pos, vel, -(size * rate**2 * np.sin(angle)).sum(1)

    return at


def track(at, yaw, t, motion):
    """A command that follows the curve: desired force, attitude error, body rates."""
    pos, vel, acc = at(t)
    wanted = acc + 4.0 * (pos - motion.pos_w) + 3.0 * (vel - motion.vel_w) + [0, 0, 9.81]
    wanted[2] = max(wanted[2], 3.0)
    size = np.linalg.norm(wanted)
    if size > 24.0:
        wanted *= 24.0 / size
    up = wanted / np.linalg.norm(wanted)
    thrust = max(0.0, wanted @ motion.rot_w[:, 2])
    nose = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    left = np.cross(up, nose)
    left /= np.linalg.norm(left)
    rot = np.stack([np.cross(left, up), left, up], axis=1)
    error = motion.rot_w.T @ rot
    vee = 0.5 * np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0],
                          error[1, 0] - error[0, 1]])  # fmt: skip
    return Command(np.asarray(thrust), np.clip([8.0, 8.0, 4.0] * vee, -6, 6))


def fly(
    vehicle,
    seed,
    duration_s=10.0,
    speed=5.0,
    noise=1.0,
    motors=False,
    acc=False,
    extra=None,
    heading=None,
):
    """Return the log of one flight of the true `vehicle`.

    `extra(motion, t)` gives an acceleration in the world that no effect of the catalogue makes;
    with a `heading` [rad] the vehicle keeps it.
    """
    rng = np.random.default_rng(seed)
    dt = 1.0 / vehicle.controller.frequency
    model = compile_quadrotor(mujoco.MjSpec(), vehicle, dt)
    data = mujoco.MjData(model)
    at, yaw_rate = reference(rng, speed), rng.uniform(-0.8, 0.8)
    plant = make_plant(vehicle, dt)
    draw = uses_noise(plant)
    state = hover_state(plant, (), noise=rng.standard_normal(3) if draw else None)
    data.qpos[:3], data.qvel[:3] = at(0.0)[:2]
    rows, command, force = [], Command(np.zeros(()), np.zeros(3)), np.zeros(3)
    for k in range(round(duration_s / dt) + 1):
        rot = quat_to_rot(data.qpos[3:].copy())
        motion = Motion(data.qpos[:3].copy(), rot, data.qvel[:3].copy(), data.qvel[3:].copy())
        if k % EVERY == 0:
            yaw = yaw_rate * k * dt if heading is None else heading
            command = track(at, yaw, k * dt, motion)
            rows.append(np.concatenate([[k * dt], data.qpos, data.qvel, [command.thrust],
                                        command.rate_b, state.rotor_speed, force]))  # fmt: skip
        inputs = Inputs(command, noise=rng.standard_normal(3) if draw else None)
        state, wrench = plant_step(plant, state, motion, inputs, k * dt)
        push = np.zeros(3) if extra is None else extra(motion, k * dt)
        force = wrench.force_b / plant.constants.mass + rot.T @ push
        data.qfrc_applied[:3] = rot @ wrench.force_b + push * plant.constants.mass
        data.qfrc_applied[3:] = wrench.torque_b
        mujoco.mj_step(model, data)
    table = np.array(rows)
    columns = {
        "time_s": table[:, 0], "pos_w": table[:, 1:4], "quat_wxyz": table[:, 4:8],
        "vel_w": table[:, 8:11], "rate_b": table[:, 11:14],
        "acc_b": table[:, 22:25] if acc else None,
    }  # fmt: skip
    columns = apply_log_faults(vehicle.effects, columns)

    def with_noise(values, name):
        return values + noise * NOISE[name] * rng.standard_normal(values.shape)

    small = noise * NOISE["att"] * rng.standard_normal((len(table), 3)) / 2
    q = columns["quat_wxyz"]
    turned = q + np.stack([
        -(q[:, 1:] * small).sum(1),
        q[:, 0] * small[:, 0] + q[:, 2] * small[:, 2] - q[:, 3] * small[:, 1],
        q[:, 0] * small[:, 1] + q[:, 3] * small[:, 0] - q[:, 1] * small[:, 2],
        q[:, 0] * small[:, 2] + q[:, 1] * small[:, 1] - q[:, 2] * small[:, 0],
    ], axis=1)  # fmt: skip
    return FlightLog(
        f"flight_{seed}",
        columns["time_s"],
        with_noise(columns["pos_w"], "pos"),
        turned / np.linalg.norm(turned, axis=1, keepdims=True),
        with_noise(columns["vel_w"], "vel"),
        with_noise(columns["rate_b"], "rate"),
        table[:, 14],
        table[:, 15:18],
        with_noise(table[:, 18:22], "motor") if motors else None,
        acc_b=with_noise(columns["acc_b"], "acc") if acc else None,
        about={"integrator": "euler", "step_s": dt},
    )
