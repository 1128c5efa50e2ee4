"""The attitude loop: computes thrust and body rates from a policy's wanted acceleration.

The tilt error is corrected along the shortest arc, so that the thrust direction is independent of
the heading; the heading error is the remaining angle about the thrust (the reduced attitude of
Brescianini and D'Andrea 2018).
"""

from __future__ import annotations

from typing import Any, Protocol

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command
from tracks.geometry.rotation import cross, to_local, to_world
from tracks.geometry.scene import Array

HEADING_RATE = 6.0
"""Rate of the first-order blend of the heading [1/s]."""
LEAST_FORCE = 0.1
"""Below this wanted specific force its direction is undefined and the tilt is held [m/s^2]."""
SMALL = 1e-6


class AttitudeLoop(Protocol):
    """Gains and limits of an attitude loop: a vehicle file's, or (..., 3) arrays."""

    @property
    def attitude_gain(self) -> Any:
        """Body rate per attitude error [1/s]."""
        ...

    @property
    def rate_max(self) -> Any:
        """Commanded body rates are clipped to this [rad/s]."""
        ...


def action_to_force(action_b: Array, rot_w: Array) -> Array:
    """Return the wanted specific force f_w = R u + g e_z (..., 3) [m/s^2], world.

    Args:
        action_b: (..., 3) wanted net acceleration in current body axes [m/s^2].
        rot_w: (..., 3, 3) body to world, at the same time.
    """
    xp = action_b.__array_namespace__()
    return to_world(rot_w, action_b) + xp.asarray([0.0, 0.0, GRAVITY])


def attitude_command(
    controller: AttitudeLoop, force_w: Array, rot_w: Array, heading_w: Array
) -> Command:
    """Return the command (CTBR) that turns body z to `force_w` and body x to `heading_w`.

    A force near zero holds the tilt; a heading along the force holds the heading; a body that is
    upside down rolls over its x axis.

    Args:
        controller: gains and limits.
        force_w: (..., 3) wanted specific force [m/s^2].
        rot_w: (..., 3, 3) body to world, now.
        heading_w: (..., 3) unit vector, horizontal.
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
    """Return the heading after it turned towards the gate for `dt` (first order, 6 1/s).

    The blend acts on the angle, so that it also works for a gate right behind. A gate straight
    above or below does not change the heading.

    Args:
        heading_w: (..., 3) unit vector, horizontal.
        to_gate_w: (..., 3) from the body to the gate, any length > 0 [m].
        dt: [s].
    """
    xp = heading_w.__array_namespace__()
    hx, hy = heading_w[..., 0], heading_w[..., 1]
    gx, gy = to_gate_w[..., 0], to_gate_w[..., 1]
    known = gx**2 + gy**2 > SMALL**2
    ahead, aside = xp.where(known, hx * gx + hy * gy, 1.0), xp.where(known, hx * gy - hy * gx, 0.0)
    turn = -xp.expm1(xp.asarray(-HEADING_RATE * dt)) * xp.arctan2(aside, ahead)
    cos, sin = xp.cos(turn), xp.sin(turn)
    x, y = cos * hx - sin * hy, sin * hx + cos * hy
    length = xp.sqrt(x**2 + y**2)
    return xp.stack([x / length, y / length, xp.zeros_like(x)], axis=-1)


def level_heading(rot_w: Array) -> Array:
    """Return the horizontal unit vector (..., 3) along body x: the heading at the start.

    Where body x is vertical it is the world's x axis.
    """
    xp = rot_w.__array_namespace__()
    x, y = rot_w[..., 0, 0], rot_w[..., 1, 0]
    flat = x**2 + y**2 > SMALL**2
    x, y = xp.where(flat, x, 1.0), xp.where(flat, y, 0.0)
    length = xp.sqrt(x**2 + y**2)
    return xp.stack([x / length, y / length, xp.zeros_like(x)], axis=-1)


def _tilt_error(xp: Any, up_b: Array) -> tuple[Array, Array]:
    """Return the x and y parts of the shortest rotation vector that takes e3 to `up_b` [rad]."""
    across = up_b[..., 0] ** 2 + up_b[..., 1] ** 2
    tilted = across > SMALL**2
    sine = xp.sqrt(xp.where(tilted, across, 1.0))
    angle = xp.arctan2(xp.where(tilted, sine, 0.0), up_b[..., 2])
    # Upright the ratio of angle and sine is 1, so its slope is that of the tilt. Upside down the
    # slope is undefined, and the rotation is about x. `0.0 - ...` avoids -0 for a zero error.
    upright = up_b[..., 2] > 0.0
    x = xp.where(tilted, -up_b[..., 1] * angle / sine, xp.where(upright, 0.0 - up_b[..., 1], xp.pi))
    y = xp.where(tilted, up_b[..., 0] * angle / sine, xp.where(upright, up_b[..., 0], 0.0))
    return x, y


def _heading_error(xp: Any, up_b: Array, heading_b: Array) -> Array:
    """Return the angle about `up_b` from the body's x axis, once tilted, to the heading [rad]."""
    a, b, c = up_b[..., 0], up_b[..., 1], up_b[..., 2]
    upside_down = c < SMALL - 1.0
    share = 1.0 / xp.where(upside_down, 1.0, 1.0 + c)
    tilted_x = xp.stack([1.0 - a * a * share, -a * b * share, -a], axis=-1)
    tilted_x = xp.where(upside_down[..., None], xp.asarray([1.0, 0.0, 0.0]), tilted_x)
    ahead = xp.sum(heading_b * tilted_x, axis=-1)
    aside = xp.sum(heading_b * cross(up_b, tilted_x), axis=-1)
    known = ahead**2 + aside**2 > SMALL
    return xp.where(
        known, xp.arctan2(xp.where(known, aside, 0.0), xp.where(known, ahead, 1.0)), 0.0
    )
