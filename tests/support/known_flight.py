"""A smooth flight that is known exactly: z-up world, forward-left-up body."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from eval.logs.flight_log import FlightLog

GRAVITY = np.array([0.0, 0.0, 9.81])
FLIP = np.diag([1.0, -1.0, -1.0])


class Truth(NamedTuple):
    """The flight at some times, z-up world and forward-left-up body."""

    time: np.ndarray
    pos: np.ndarray
    rot: np.ndarray
    vel: np.ndarray
    rate: np.ndarray
    thrust: np.ndarray
    cmd_rate: np.ndarray
    motor: np.ndarray
    acc: np.ndarray
    voltage: np.ndarray

    @property
    def quat(self):
        """(T, 4) wxyz."""
        return Rotation.from_matrix(self.rot).as_quat(scalar_first=True)


def fly(time):
    """The flight at `time` (T,) [s]: turns about all axes, speeds to 5 m/s, one hover height."""
    time = np.asarray(time, dtype=float)
    pos, vel, acc = (_path(time, order) for order in range(3))
    rot = _attitude(time)
    h = 1e-4
    after, before = Rotation.from_matrix(_attitude(time + h)), _attitude(time - h)
    rate = (Rotation.from_matrix(before).inv() * after).as_rotvec() / (2 * h)
    thrust = np.linalg.norm(acc + GRAVITY, axis=1)
    cmd_rate = rate + 0.1 * np.sin(3 * time)[:, None] * np.array([1.0, 0.5, -0.5])
    motor = _motors(thrust, rate, time)
    felt = np.einsum("tji,tj->ti", rot, acc + GRAVITY)
    voltage = 16.0 - 0.05 * time
    return Truth(time, pos, rot, vel, rate, thrust, cmd_rate, motor, felt, voltage)


def log(end_s):
    """A flight log of it, with rows of 10 ms, that the body follows 50 ms after its commands."""
    truth = fly(np.arange(0.0, end_s, 0.01))
    return FlightLog("known", truth.time, truth.pos, truth.quat, truth.vel, truth.rate,
                     truth.thrust, fly(truth.time + 0.05).cmd_rate, truth.motor)  # fmt: skip


def _motors(thrust, rate, time):
    """The rotor speeds that turn the body so: of 0.75 kg, the hubs in the shipped order."""
    inertia, h = np.array([0.0025, 0.0021, 0.0043]), 1e-3
    after, before = (
        Rotation.from_matrix(_attitude(time + s)).inv()
        * Rotation.from_matrix(_attitude(time + s + h))
        for s in (0.0, -h)
    )
    change = (after.as_rotvec() - before.as_rotvec()) / h**2
    torque = inertia * change + np.cross(rate, inertia * rate)
    x, y = np.array([0.075, -0.075, -0.075, 0.075]), np.array([-0.1, -0.1, 0.1, 0.1])
    mixer = np.stack([np.ones(4), y, -x, np.array([-1, 1, -1, 1]) * 2.2e-8 / 1.6e-6])
    wanted = np.concatenate([0.75 * thrust[:, None], torque], axis=1)
    return np.sqrt(np.maximum(wanted @ np.linalg.inv(mixer).T, 1e-3) / 1.6e-6)


def _path(time, order):
    waves = np.array([[2.5, 1.3, 0.2], [2.0, 1.9, 1.1], [0.6, 1.6, 0.5]])
    size, speed, phase = waves[:, 0], waves[:, 1], waves[:, 2]
    angle = time[:, None] * speed + phase
    value = size * speed**order * np.sin(angle + order * np.pi / 2)
    return value + (np.array([3.0, -1.0, 2.0]) if order == 0 else 0.0)


def _attitude(time):
    up = _path(time, 2) + GRAVITY
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    yaw = 0.8 * np.sin(0.9 * time) + 0.4
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def ned(vector):
    """Vectors (T, 3) from north-west-up to north-east-down, or from FLU to FRD."""
    return vector @ FLIP


def ned_quat(truth):
    """Attitudes (T, 4) wxyz from a forward-right-down body to north-east-down."""
    return Rotation.from_matrix(FLIP @ truth.rot @ FLIP).as_quat(scalar_first=True)
