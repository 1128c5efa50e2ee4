"""The flight controller: body rates to torque, and torque to rotor speeds within their range."""

from __future__ import annotations

import numpy as np

from suite.blind.continuous.quadrotor import Believed

TINY = 1e-12
"""Thrusts below this are rounding [N]."""


def wanted_speeds(believed: Believed, command: np.ndarray, rate_b: np.ndarray) -> np.ndarray:
    """Return the rotor speeds (N, 4) that the loop asks for [rad/s].

    Args:
        believed: what the controller knows.
        command: (N, 4) thrust per nominal mass [m/s^2], body rates [rad/s].
        rate_b: (N, 3) as the loop measured them [rad/s].
    """
    inertia = believed.inertia
    x, y, z = inertia
    # rate x (J rate), written out for a diagonal J.
    turning = np.array([z - y, x - z, y - x]) * rate_b[:, [1, 2, 0]] * rate_b[:, [2, 0, 1]]
    torque_b = inertia * believed.rate_gain * (command[:, 1:] - rate_b) + turning
    thrust = allotted(believed, believed.mass * command[:, 0], torque_b)
    return np.sqrt(thrust / believed.thrust_coefficient)


def allotted(believed: Believed, collective: np.ndarray, torque_b: np.ndarray) -> np.ndarray:
    """Return each rotor's thrust (N, 4) for a collective (N,) [N] and a torque (N, 3) [N m].

    Where a rotor would be out of [0, f_max]: roll and pitch shrink by one factor until their spread
    is f_max, the collective goes to the nearest feasible one, yaw takes what room is left.
    """
    lift, most = believed.shares[:, 0], believed.thrust_max
    tilt = torque_b[:, :2] @ believed.shares[:, 1:3].T
    yaw = torque_b[:, 2:] * believed.shares[:, 3]
    free = collective[:, None] * lift + tilt + yaw
    beyond = np.any((free < 0.0) | (free > most), axis=1)
    if not beyond.any():
        return free
    spread = tilt.max(axis=1) - tilt.min(axis=1)
    tilt = tilt * np.minimum(1.0, most / np.maximum(spread, TINY))[:, None]
    least_c = (-tilt / lift).max(axis=1)
    most_c = ((most - tilt) / lift).min(axis=1)
    level = np.minimum(np.maximum(collective, least_c), most_c)[:, None] * lift + tilt
    room = np.where(yaw > 0.0, most - level, level)
    moving = np.abs(yaw) > TINY
    ratio = np.where(moving, np.maximum(room, 0.0) / np.where(moving, np.abs(yaw), 1.0), 1.0)
    held = level + np.minimum(ratio.min(axis=1, keepdims=True), 1.0) * yaw
    return np.where(beyond[:, None], np.clip(held, 0.0, most), free)
