"""The rigid body in free flight, stepped as MuJoCo's Euler integrator steps it."""

from __future__ import annotations

from eval.quadrotor.plant import Motion, Plant, Wrench
from tracks.geometry.rotation import cross, exp_rot, to_world
from tracks.geometry.scene import Array


def accelerations(plant: Plant, motion: Motion, wrench: Wrench) -> tuple[Array, Array]:
    """Return dv/dt in the world (..., 3) [m/s^2] and dw/dt in body axes (..., 3) [rad/s^2]."""
    constants = plant.constants
    force_w = to_world(motion.rot_w, wrench.force_b)
    momentum_b = constants.inertia * motion.rate_b
    torque_b = wrench.torque_b - cross(motion.rate_b, momentum_b)
    return force_w / constants.mass[..., None] + constants.gravity_w, torque_b / constants.inertia


def euler_step(plant: Plant, motion: Motion, wrench: Wrench) -> Motion:
    """Return the motion after `plant.dt` under a held wrench (`euler_move`)."""
    return euler_move(motion, *accelerations(plant, motion, wrench), plant.dt)


def euler_move(motion: Motion, acc_w: Array, turn_b: Array, dt: Array) -> Motion:
    """Return the motion after `dt` (..., 1) [s] under accelerations (semi-implicit Euler, order 1).

    Velocities are stepped first, and the new ones carry position and attitude: the attitude
    along the exact rotation of the new body rate.
    """
    xp = motion.rot_w.__array_namespace__()
    vel_w = motion.vel_w + dt * acc_w
    rate_b = motion.rate_b + dt * turn_b
    rot_w = xp.matmul(motion.rot_w, exp_rot(dt * rate_b))
    return Motion(motion.pos_w + dt * vel_w, rot_w, vel_w, rate_b)
