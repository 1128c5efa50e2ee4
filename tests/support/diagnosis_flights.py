"""Flights for the diagnosis: flown in MuJoCo by a plain trajectory tracker, logged with noise."""

from dataclasses import fields, replace
from functools import cache

import mujoco
import numpy as np

from eval.effects.log_faults import apply_log_faults
from eval.logs.flight_log import FlightLog
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Command, Motion, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from tests.support.vehicles import PLAIN
from tracks.geometry.rotation import quat_to_rot, to_local, to_world

NOISE = {"pos": 0.002, "att": 0.004, "vel": 0.02, "rate": 0.02, "motor": 4.0, "acc": 0.15}
ROW_HZ = 100.0
"""Rows a second, a whole number of physics steps each."""


def curve(rng, speed):
    """Return the rates [rad/s] and phases of a closed curve, three sines an axis, (3, 3) each."""
    rate = speed / 4.0 * np.array([[1.0, 1.9, 3.1], [0.8, 1.7, 2.9], [1.1, 2.0, 3.3]])
    return rate * rng.uniform(0.85, 1.15, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))


def on_curves(rate, phase, t):
    """Return position, velocity, acceleration (..., 3) on the curves (..., 3, 3) at a time."""
    size = np.array([[3.0, 0.8, 0.3], [2.5, 0.8, 0.3], [0.5, 0.25, 0.1]])
    angle = rate * t + phase
    pos = (size * np.sin(angle)).sum(-1) + [0, 0, 1.6]
    vel = (size * rate * np.cos(angle)).sum(-1)
    return pos, vel, -(size * rate**2 * np.sin(angle)).sum(-1)


def track(point, yaw, motion):
    """Commands that follow points of curves: desired force, attitude error, body rates."""
    pos, vel, acc = point
    wanted = acc + 4.0 * (pos - motion.pos_w) + 3.0 * (vel - motion.vel_w) + [0, 0, 9.81]
    wanted[..., 2] = np.maximum(wanted[..., 2], 3.0)
    size = np.linalg.norm(wanted, axis=-1, keepdims=True)
    wanted *= np.minimum(1.0, 24.0 / size)
    up = wanted / np.linalg.norm(wanted, axis=-1, keepdims=True)
    thrust = np.maximum(0.0, (wanted * motion.rot_w[..., 2]).sum(-1))
    nose = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    left = np.cross(up, nose)
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    rot = np.stack([np.cross(left, up), left, up], axis=-1)
    error = motion.rot_w.mT @ rot
    vee = 0.5 * np.stack([error[..., 2, 1] - error[..., 1, 2], error[..., 0, 2] - error[..., 2, 0],
                          error[..., 1, 0] - error[..., 0, 1]], axis=-1)  # fmt: skip
    return Command(thrust, np.clip([8.0, 8.0, 4.0] * vee, -6, 6))


def fly(vehicle, seed, *args, **options):
    """Return the log of one flight of the true `vehicle`; see `fly_all`."""
    return fly_all([vehicle], [seed], *args, **options)[0]


@cache
def without_fault():
    """Return a flight of the plain vehicle, made once: no test writes into its arrays."""
    return fly(PLAIN, 0, duration_s=8.0, motors=True)


def part_of(log, begin_s, end_s):
    """Return the rows of a log from one time to another, from 0 s on."""
    rows = (log.time_s > begin_s - 1e-6) & (log.time_s < end_s + 1e-6)
    arrays = {field.name: getattr(log, field.name) for field in fields(log)}
    cut = {name: x[rows] for name, x in arrays.items() if isinstance(x, np.ndarray)}
    return replace(log, **cut | {"time_s": cut["time_s"] - cut["time_s"][0]})


def fly_all(
    vehicles, seeds, duration_s=10.0, speed=5.0, noise=1.0, motors=False, acc=False, extras=None,
    headings=None,
):  # fmt: skip
    """Return the logs of flights side by side, one a seed.

    There is a vehicle a flight, which differ in the values of their effects alone. `extras` are
    functions (motion, t), one a flight, of an acceleration in the world that no effect of the
    catalogue makes; with `headings` [rad] the vehicles keep one each.
    """
    rngs = [np.random.default_rng(seed) for seed in seeds]
    dt = 1.0 / vehicles[0].controller.frequency
    every = round(vehicles[0].controller.frequency / ROW_HZ)
    models = [compile_quadrotor(mujoco.MjSpec(), vehicle, dt) for vehicle in vehicles]
    datas = [mujoco.MjData(model) for model in models]
    drawn = [(*curve(rng, speed), rng.uniform(-0.8, 0.8)) for rng in rngs]
    rate, phase, turning = map(np.array, zip(*drawn, strict=True))
    plant = make_plant(vehicles[0], dt, together([vehicle.effects for vehicle in vehicles]))
    draws = uses_noise(plant)
    gusts = np.array([rng.standard_normal(3) for rng in rngs]) if draws else None
    state = hover_state(plant, (len(seeds),), noise=gusts)
    for data, *start in zip(datas, *on_curves(rate, phase, 0.0)[:2], strict=True):
        data.qpos[:3], data.qvel[:3] = start
    rows, command = [], Command(np.zeros(len(seeds)), np.zeros((len(seeds), 3)))
    force, push = np.zeros((len(seeds), 3)), np.zeros((len(seeds), 3))
    for k in range(round(duration_s / dt) + 1):
        qpos, qvel = np.array([d.qpos for d in datas]), np.array([d.qvel for d in datas])
        motion = Motion(qpos[:, :3], quat_to_rot(qpos[:, 3:]), qvel[:, :3], qvel[:, 3:])
        if k % every == 0:
            yaw = turning * k * dt if headings is None else np.asarray(headings)
            command = track(on_curves(rate, phase, k * dt), yaw, motion)
            rows.append(np.column_stack([np.full(len(seeds), k * dt), qpos, qvel, command.thrust,
                                         command.rate_b, state.rotor_speed, force]))  # fmt: skip
        gusts = np.array([rng.standard_normal(3) for rng in rngs]) if draws else None
        state, wrench = plant_step(plant, state, motion, Inputs(command, noise=gusts), k * dt)
        if extras:
            each = [Motion(*parts) for parts in zip(*motion, strict=True)]
            push = np.array([extra(one, k * dt) for extra, one in zip(extras, each, strict=True)])
        mass, rot = plant.constants.mass, motion.rot_w
        force = wrench.force_b / mass[..., None] + to_local(rot, push)
        applied = np.concatenate(
            [to_world(rot, wrench.force_b) + push * mass[..., None], wrench.torque_b], axis=-1
        )
        for model, data, one in zip(models, datas, applied, strict=True):
            data.qfrc_applied[:] = one
            mujoco.mj_step(model, data)
    tables = np.array(rows)
    return [
        logged(vehicle, seed, rng, tables[:, number], dt, noise, motors, acc)
        for number, (vehicle, seed, rng) in enumerate(zip(vehicles, seeds, rngs, strict=True))
    ]


def together(effects):
    """Return effects by name of several vehicles as one's, with an axis more where they differ."""
    first, *others = effects
    assert all(list(one) == list(first) for one in others)

    def stacked(*values):
        arrays = [np.asarray(value, float) for value in values]
        same = all(np.array_equal(arrays[0], one) for one in arrays)
        return values[0] if same else np.stack(arrays)

    return {
        name: type(value)(*map(stacked, *(one[name] for one in effects)))
        for name, value in first.items()
    }


def logged(vehicle, seed, rng, table, dt, noise, motors, acc):
    """Return the rows of a flight as a log with noise."""
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
