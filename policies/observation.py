"""The observation: the paper's 12 numbers (Su et al. 2026, Eq. 1) or more, and a depth image."""

from __future__ import annotations

from policies.spec import DepthEncoding
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array


def state_vector(
    pos_w: Array,
    vel_w: Array,
    rot_w: Array,
    gate_w: Array,
    last_action_b: Array,
    second_w: Array | None = None,
    axis_w: Array | None = None,
) -> Array:
    """Return the numbers that a policy sees besides the image, (..., 12), (..., 15) or (..., 18).

    Args:
        pos_w: (..., 3) position [m].
        vel_w: (..., 3) velocity [m/s].
        rot_w: (..., 3, 3) body to world.
        gate_w: (..., 3) centre of the next gate [m].
        last_action_b: (..., 3) the previous action, in the body axes of its own time [m/s^2].
        second_w: (..., 3) centre of the gate after the next, or of the last gate where there is
            none after it [m]; for policies with `PolicySpec.second_gate`.
        axis_w: (..., 3) unit vector along which the next gate is flown through; for policies with
            `PolicySpec.gate_axis`.

    Returns:
        Velocity in body axes [m/s], the third row of R (world z in body axes, free of yaw), the
        next gate's centre in body axes [m], the last action [m/s^2] and, where they are given, the
        second gate's centre [m] and the next gate's direction, both in body axes.
    """
    xp = rot_w.__array_namespace__()
    vel_b, gate_b = to_local(rot_w, vel_w), to_local(rot_w, gate_w - pos_w)
    numbers = [vel_b, rot_w[..., 2, :], gate_b, last_action_b]
    if second_w is not None:
        numbers.append(to_local(rot_w, second_w - pos_w))
    if axis_w is not None:
        numbers.append(to_local(rot_w, axis_w))
    return xp.concatenate(numbers, axis=-1)


def encode_depth(encoding: DepthEncoding, depth_m: Array, range_m: float) -> Array:
    """Return planar depths [m] as the inverse depths that the network sees, of the same shape."""
    xp = depth_m.__array_namespace__()
    return encoding.scale / xp.clip(depth_m, encoding.near, range_m) - encoding.offset
