"""The pilot of commanded trajectories: position errors to a command (CTBR)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import attitude_command
from eval.quadrotor.plant import Command, Motion
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.trajectory import Reference


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
    correction = (
        gains.position * (wanted.pos_w - motion.pos_w)
        + gains.velocity * (wanted.vel_w - motion.vel_w)
        + gains.integral * summed_w
    )
    acc_w = wanted.acc_w + np.clip(correction, -gains.correction, gains.correction)
    force_w = acc_w + np.array([0.0, 0.0, GRAVITY])
    # Never further over than 70 degrees: a commanded free fall would turn the vehicle over.
    flat = np.sqrt((force_w[:, :2] ** 2).sum(-1))
    force_w[:, 2] = np.maximum(force_w[:, 2], np.maximum(0.36 * flat, 1.0))
    heading_w = np.stack(
        [np.cos(wanted.yaw), np.sin(wanted.yaw), np.zeros_like(wanted.yaw)], axis=-1
    )
    return attitude_command(vehicle.controller, force_w, motion.rot_w, heading_w)
