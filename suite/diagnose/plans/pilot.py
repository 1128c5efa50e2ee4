"""The pilot of commanded trajectories: position errors to a command (CTBR)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import attitude_command
from eval.quadrotor.plant import Command, Motion
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.trajectory import Reference
from tracks.geometry.scene import Array


@dataclass(frozen=True)
class Gains:
    """Of the loops around position; below them are the vehicle's own."""

    position: float = 5.0
    """Acceleration per position error [1/s^2]."""
    velocity: float = 3.5
    """Acceleration per velocity error [1/s]."""
    integral: float = 2.0
    """Acceleration per summed position error [1/s^3]."""
    correction: float = 8.0
    """Largest correction of each component of the acceleration [m/s^2]."""


def corrected(
    gains: Gains, acc_w: Array, off_w: Array, slow_w: Array, summed_w: Array | float = 0.0
) -> Array:
    """Return the acceleration (..., 3) [m/s^2] that also brings a vehicle back to its path.

    Args:
        gains: of the position loop.
        acc_w: (..., 3) of the path [m/s^2].
        off_w: (..., 3) by how much the path is ahead in position [m].
        slow_w: (..., 3) and in velocity [m/s].
        summed_w: (..., 3) `off_w` summed over time [m s].
    """
    xp = acc_w.__array_namespace__()
    correction = gains.position * off_w + gains.velocity * slow_w + gains.integral * summed_w
    return acc_w + xp.clip(correction, -gains.correction, gains.correction)


def steer(
    vehicle: Vehicle, gains: Gains, wanted: Reference, motion: Motion, summed_w: np.ndarray
) -> Command:
    """Return the command that follows `wanted`; the pilot knows the nominal vehicle only.

    Args:
        vehicle: its controller's gains and limits are used.
        gains: of the position loop.
        wanted: of N flights at this moment.
        motion: (N, ...) true states.
        summed_w: (N, 3) position error summed over time [m s].
    """
    off_w, slow_w = wanted.pos_w - motion.pos_w, wanted.vel_w - motion.vel_w
    acc_w = corrected(gains, wanted.acc_w, off_w, slow_w, summed_w)
    force_w = acc_w + np.array([0.0, 0.0, GRAVITY])
    # Never further over than 70 degrees: a commanded free fall would turn the vehicle over.
    flat = np.sqrt((force_w[:, :2] ** 2).sum(-1))
    force_w[:, 2] = np.maximum(force_w[:, 2], np.maximum(0.36 * flat, 1.0))
    heading_w = np.stack(
        [np.cos(wanted.yaw), np.sin(wanted.yaw), np.zeros_like(wanted.yaw)], axis=-1
    )
    return attitude_command(vehicle.controller, force_w, motion.rot_w, heading_w)
