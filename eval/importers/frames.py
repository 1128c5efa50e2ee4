"""Convert the coordinate frames of logs to a z-up world and a forward-left-up body.

A north-east-down world becomes north-west-up, and a forward-right-down body becomes
forward-left-up, by a rotation of 180 degrees about x: y and z change their sign. Motion capture
with y up (OptiTrack's default) becomes z up by 90 degrees about x: z_up = y, y_left = -z.

Quaternion products and rotation vectors are written out here, because scipy's `Rotation` rejects
rows without an attitude (NaN or zero), which logs contain.
"""

from __future__ import annotations

import numpy as np

HALF_TURN = np.array([1.0, -1.0, -1.0])
"""Diagonal of the rotation by 180 degrees about x, which is its own inverse."""
QUAT_HALF_TURN = np.array([1.0, 1.0, -1.0, -1.0])
"""Signs of a quaternion wxyz when world and body are both rotated by 180 degrees about x."""

_ROOT_HALF = float(np.sqrt(0.5))
_WORLD = {
    "z-up": np.array([1.0, 0.0, 0.0, 0.0]),
    "ned": np.array([0.0, 1.0, 0.0, 0.0]),
    "y-up": np.array([_ROOT_HALF, _ROOT_HALF, 0.0, 0.0]),
}
"""World frame -> quaternion wxyz from it to z-up."""
_BODY = {"flu": _WORLD["z-up"], "frd": _WORLD["ned"]}
"""Body frame -> quaternion wxyz from it to forward-left-up."""
WORLDS = tuple(_WORLD)
"""Names of the world frames that a log may have."""
BODIES = tuple(_BODY)
"""Names of the body frames that a log may have."""


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the products (..., 4) of quaternions wxyz: rotation by `second`, then by `first`."""
    w1, v1 = first[..., :1], first[..., 1:]
    w2, v2 = second[..., :1], second[..., 1:]
    vector = w1 * v2 + w2 * v1 + _cross(v1, v2)
    return np.concatenate([w1 * w2 - np.sum(v1 * v2, axis=-1, keepdims=True), vector], axis=-1)


def conjugate(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the inverses (..., 4) of unit quaternions wxyz."""
    return quat_wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quat_wxyz: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return `vector` (..., 3) rotated by unit quaternions wxyz (..., 4)."""
    w, v = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    twice_cross = 2.0 * _cross(v, vector)
    return vector + w * twice_cross + _cross(v, twice_cross)


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross products (..., 3), several times faster than `np.cross` on short arrays."""
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    x, y, z = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def world_vector(vector: np.ndarray, world: str) -> np.ndarray:
    """Return vectors (..., 3), given in the `world` frame (one of `WORLDS`), in a z-up world."""
    return rotate(np.broadcast_to(_WORLD[world], (*vector.shape[:-1], 4)), vector)


def body_vector(vector: np.ndarray, body: str) -> np.ndarray:
    """Return vectors (..., 3), given in the `body` frame (one of `BODIES`), in forward-left-up."""
    return vector * HALF_TURN if body == "frd" else vector


def attitude(quat_wxyz: np.ndarray, world: str, body: str) -> np.ndarray:
    """Convert quaternions wxyz from `body` to `world` into forward-left-up to z-up (..., 4)."""
    shape = quat_wxyz.shape
    world_to_z_up = np.broadcast_to(_WORLD[world], shape)
    flu_to_body = np.broadcast_to(conjugate(_BODY[body]), shape)
    return multiply(multiply(world_to_z_up, quat_wxyz), flu_to_body)


def from_euler(roll_pitch_yaw: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (..., 4) of roll, pitch and yaw (..., 3) [rad].

    The rotations are yaw about z, then pitch about the new y, then roll about the new x.
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", roll_pitch_yaw[..., ::-1]).as_quat(scalar_first=True)


def rotation_vector(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the shortest rotation vectors (..., 3) [rad] of unit quaternions wxyz (..., 4)."""
    shortest = np.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    sin_half = np.linalg.norm(shortest[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sin_half, shortest[..., :1])
    # angle / sin(angle / 2) tends to 2 at zero.
    nonzero = sin_half > 1e-12
    factor = np.where(nonzero, angle / np.where(nonzero, sin_half, 1.0), 2.0)
    return factor * shortest[..., 1:]


def rates_between(
    time_s: np.ndarray, quat_wxyz: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return spans [s] from each row to `count` rows later, and mean body rates (N - count, 3).

    `time_s` (N,) [s], unit quaternions (N, 4) from body to world; rates in rad/s.
    """
    span_s = time_s[count:] - time_s[:-count]
    relative = multiply(conjugate(quat_wxyz[:-count]), quat_wxyz[count:])
    return span_s, rotation_vector(relative) / span_s[:, None]
