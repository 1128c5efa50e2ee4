"""The attitude loop: it computes thrust and body rates from a policy's wanted acceleration.

The tilt error is corrected along the shortest arc, so the thrust direction is independent of the
heading. The heading error is the remaining angle about the thrust (reduced attitude control,
Brescianini and D'Andrea 2018).
"""

from __future__ import annotations

from typing import Any

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command
from eval.vehicles.vehicle import Controller
from tracks.geometry.rotation import cross, to_local, to_world
from tracks.geometry.scene import Array

HEADING_RATE = 6.0
"""Rate of the first-order blend of the heading [1/s]."""
LEAST_FORCE = 0.1
"""Wanted specific force [m/s^2] below which its direction is undefined, and the tilt is held."""
SMALL = 1e-6
"""Length of a vector (or projection) below which its direction counts as undefined."""


def action_to_force(action_b: Array, rot_w: Array) -> Array:
    """Return the wanted specific force f_w = R u + g e_z (..., 3) in world axes [m/s^2].

    Args:
        action_b: (..., 3) wanted net acceleration in current body axes [m/s^2].
        rot_w: (..., 3, 3) body to world, at the same time.
    """
    xp = action_b.__array_namespace__()
    return to_world(rot_w, action_b) + xp.asarray([0.0, 0.0, GRAVITY])


def attitude_command(
    controller: Controller, force_w: Array, rot_w: Array, heading_w: Array
) -> Command:
    """Return the thrust and body rates that turn body z to a force, and body x to a heading.

    If the force is near zero, the tilt is held; if the heading is along the force, the heading is
    held. A body that is upside down rolls about its x axis.

    Args:
        controller: gain [1/s] and limits [rad/s] of the attitude loop.
        force_w: (..., 3) wanted specific force, world axes [m/s^2].
        rot_w: (..., 3, 3) current attitude, body to world.
        heading_w: (..., 3) wanted heading, a horizontal unit vector.
    """
    xp = force_w.__array_namespace__()
    force_b = to_local(rot_w, force_w)
    heading_b = to_local(rot_w, heading_w)
    size = xp.sqrt(xp.maximum(xp.sum(force_b**2, axis=-1, keepdims=True), LEAST_FORCE**2))
    up_b = xp.where(size > LEAST_FORCE, force_b / size, xp.asarray([0.0, 0.0, 1.0]))
    tilt = _tilt_error(xp, up_b)
    yaw = _heading_error(xp, up_b, heading_b)
    error = xp.stack([tilt[0], tilt[1], yaw], axis=-1)
    limit = xp.asarray(controller.rate_max)
    rate = xp.clip(xp.asarray(controller.attitude_gain) * error, -limit, limit)
    return Command(xp.maximum(force_b[..., 2], 0.0), rate)


def blend_heading(heading_w: Array, to_gate_w: Array, dt: float) -> Array:
    """Return the heading after it turned towards the gate for a time, at `HEADING_RATE`.

    The blend acts on the angle, so it also works for a gate directly behind. A gate directly above
    or below does not change the heading.

    Args:
        heading_w: (..., 3) current heading, a horizontal unit vector.
        to_gate_w: (..., 3) vector from the body to the gate, of any length > 0 [m].
        dt: duration of the turn [s].
    """
    xp = heading_w.__array_namespace__()
    hx, hy = heading_w[..., 0], heading_w[..., 1]
    gx, gy = to_gate_w[..., 0], to_gate_w[..., 1]
    known = gx**2 + gy**2 > SMALL**2
    ahead = xp.where(known, hx * gx + hy * gy, 1.0)
    left = xp.where(known, hx * gy - hy * gx, 0.0)
    turn = -xp.expm1(xp.asarray(-HEADING_RATE * dt)) * xp.arctan2(left, ahead)
    cos, sin = xp.cos(turn), xp.sin(turn)
    x, y = cos * hx - sin * hy, sin * hx + cos * hy
    length = xp.sqrt(x**2 + y**2)
    return xp.stack([x / length, y / length, xp.zeros_like(x)], axis=-1)


def level_heading(rot_w: Array) -> Array:
    """Return the horizontal unit vector (..., 3) along body x, which is the heading at the start.

    If body x is vertical, it is the world's x axis.
    """
    xp = rot_w.__array_namespace__()
    x, y = rot_w[..., 0, 0], rot_w[..., 1, 0]
    defined = x**2 + y**2 > SMALL**2
    x, y = xp.where(defined, x, 1.0), xp.where(defined, y, 0.0)
    length = xp.sqrt(x**2 + y**2)
    return xp.stack([x / length, y / length, xp.zeros_like(x)], axis=-1)


def _tilt_error(xp: Any, up_b: Array) -> tuple[Array, Array]:
    """Return the x and y parts of the shortest rotation vector from e3 to `up_b` [rad]."""
    sine_squared = up_b[..., 0] ** 2 + up_b[..., 1] ** 2
    tilted = sine_squared > SMALL**2
    sine = xp.sqrt(xp.where(tilted, sine_squared, 1.0))
    angle = xp.arctan2(xp.where(tilted, sine, 0.0), up_b[..., 2])
    # Upright, angle / sine is 1, with the correct gradient. Upside down the gradient is undefined,
    # and the rotation is about x. `0.0 - ...` avoids -0 for a zero error.
    upright = up_b[..., 2] > 0.0
    x = xp.where(tilted, -up_b[..., 1] * angle / sine, xp.where(upright, 0.0 - up_b[..., 1], xp.pi))
    y = xp.where(tilted, up_b[..., 0] * angle / sine, xp.where(upright, up_b[..., 0], 0.0))
    return x, y


def _heading_error(xp: Any, up_b: Array, heading_b: Array) -> Array:
    """Return the angle about `up_b` from the tilted body's x axis to the heading [rad]."""
    a, b, c = up_b[..., 0], up_b[..., 1], up_b[..., 2]
    upside_down = c < SMALL - 1.0
    share = 1.0 / xp.where(upside_down, 1.0, 1.0 + c)
    tilted_x = xp.stack([1.0 - a * a * share, -a * b * share, -a], axis=-1)
    tilted_x = xp.where(upside_down[..., None], xp.asarray([1.0, 0.0, 0.0]), tilted_x)
    ahead = xp.sum(heading_b * tilted_x, axis=-1)
    left = xp.sum(heading_b * cross(up_b, tilted_x), axis=-1)
    known = ahead**2 + left**2 > SMALL
    return xp.where(known, xp.arctan2(xp.where(known, left, 0.0), xp.where(known, ahead, 1.0)), 0.0)
