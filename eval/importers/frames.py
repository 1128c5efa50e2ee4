"""Convert the frames of logs to a z-up world and a forward-left-up body.

A north-east-down world becomes north-west-up, and a forward-right-down body forward-left-up, by
half a turn about x: y and z change their sign. Motion capture with y up (OptiTrack's default)
becomes z up by a quarter turn about x: z_up = y, y_left = -z.

Products of quaternions and rotation vectors are written out here, because scipy's `Rotation`
refuses rows without an attitude (NaN or zero), which logs have.
"""

from __future__ import annotations

import numpy as np

HALF_TURN = np.array([1.0, -1.0, -1.0])
"""Diagonal of the half turn about x; its own inverse."""
QUAT_HALF_TURN = np.array([1.0, 1.0, -1.0, -1.0])
"""The same for a quaternion wxyz when world and body are both rotated."""

_ROOT_HALF = float(np.sqrt(0.5))
_WORLD = {
    "z-up": np.array([1.0, 0.0, 0.0, 0.0]),
    "ned": np.array([0.0, 1.0, 0.0, 0.0]),
    "y-up": np.array([_ROOT_HALF, _ROOT_HALF, 0.0, 0.0]),
}
"""World frame -> quaternion wxyz to z-up."""
_BODY = {"flu": _WORLD["z-up"], "frd": _WORLD["ned"]}
WORLDS = tuple(_WORLD)
BODIES = tuple(_BODY)


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the products (..., 4) of quaternions wxyz: rotation by `second`, then by `first`."""
    w, v = first[..., :1], first[..., 1:]
    s, u = second[..., :1], second[..., 1:]
    vector = w * u + s * v + np.cross(v, u)
    return np.concatenate([w * s - np.sum(v * u, axis=-1, keepdims=True), vector], axis=-1)


def conjugate(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the inverse rotations (..., 4)."""
    return quat_wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def turn(quat_wxyz: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return `vector` (..., 3) rotated by unit quaternions (..., 4)."""
    w, v = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    twice = 2.0 * np.cross(v, vector)
    return vector + w * twice + np.cross(v, twice)


def world_vector(vector: np.ndarray, world: str) -> np.ndarray:
    """Return vectors (..., 3) of a `world` frame in z-up."""
    return turn(np.broadcast_to(_WORLD[world], (*vector.shape[:-1], 4)), vector)


def body_vector(vector: np.ndarray, body: str) -> np.ndarray:
    """Return vectors (..., 3) of a `body` frame in forward-left-up."""
    return vector * HALF_TURN if body == "frd" else vector


def attitude(quat_wxyz: np.ndarray, world: str, body: str) -> np.ndarray:
    """Return attitudes (..., 4) from `body` to `world` as forward-left-up to z-up."""
    shape = quat_wxyz.shape
    left = np.broadcast_to(_WORLD[world], shape)
    return multiply(multiply(left, quat_wxyz), np.broadcast_to(conjugate(_BODY[body]), shape))


def from_euler(roll_pitch_yaw: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (..., 4) of roll, pitch, yaw (..., 3) [rad]: about z, y', x''."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", roll_pitch_yaw[..., ::-1]).as_quat(scalar_first=True)


def rotation_vector(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the shortest rotation vectors (..., 3) [rad] of unit quaternions."""
    short = np.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    size = np.linalg.norm(short[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(size, short[..., :1])
    factor = np.where(size > 1e-12, angle / np.where(size > 1e-12, size, 1.0), 2.0)
    return factor * short[..., 1:]
