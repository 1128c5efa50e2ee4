"""The rigid body in free flight, stepped as MuJoCo's Euler integrator steps it."""

from __future__ import annotations

from typing import Any

from eval.plant import Motion, Plant, Wrench, accelerations
from eval.rotation import exp_rot

Array = Any


def euler_step(plant: Plant, motion: Motion, wrench: Wrench) -> Motion:
    """Return the motion after `plant.dt` under a held wrench (semi-implicit Euler, order 1).

    Velocities are stepped first, and the new ones carry position and attitude: the attitude
    along the exact rotation of the new body rate.
    """
    xp = motion.rot_w.__array_namespace__()
    acc_w, turn_b = accelerations(plant, motion, wrench)
    vel_w = motion.vel_w + plant.dt * acc_w
    rate_b = motion.rate_b + plant.dt * turn_b
    rot_w = xp.matmul(motion.rot_w, exp_rot(plant.dt * rate_b))
    return Motion(motion.pos_w + plant.dt * vel_w, rot_w, vel_w, rate_b)
