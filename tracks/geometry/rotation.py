"""Rotate vectors, and convert quaternions, matrices and rotation vectors (numpy and JAX).

Products are written out as sums over the last axes. A matrix product may round a row differently in
another batch size, and the outcome of a trial (one judged flight) must not depend on other trials.
"""

from __future__ import annotations

import numpy as np

from tracks.geometry.scene import Array

LONG = 1000
"""Number of products above which three are added faster one by one, to the same bits."""


def to_world(rot_w: Array, vector: Array) -> Array:
    """Return vectors (..., 3) of a body or gate frame in world axes.

    Args:
        rot_w: (..., 3, 3) body or gate to world.
        vector: (..., 3) vectors in body or gate axes.
    """
    return _summed(rot_w * vector[..., None, :], -1)


def to_local(rot_w: Array, vector_w: Array) -> Array:
    """Return world vectors (..., 3) in the axes of a body or gate.

    Args:
        rot_w: (..., 3, 3) body or gate to world.
        vector_w: (..., 3) vectors in world axes.
    """
    return _summed(rot_w * vector_w[..., :, None], -2)


def _summed(products: Array, axis: int) -> Array:
    """Return the sum of `products` over an axis of 3; numpy's own is slow on long arrays."""
    if isinstance(products, np.ndarray) and products.size > LONG:
        first, second, third = np.moveaxis(products, axis, 0)
        return first + second + third
    return products.sum(axis)


def cross(a: Array, b: Array) -> Array:
    """Return a x b (..., 3); `numpy.cross` is several times slower on small arrays."""
    ax, ay, az = (a[..., i : i + 1] for i in range(3))
    bx, by, bz = (b[..., i : i + 1] for i in range(3))
    parts = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
    # Of one numpy and one JAX array the product is one of JAX. `stack` is slower on small arrays.
    return parts[0].__array_namespace__().concatenate(parts, axis=-1)


def yaw_rotation(yaw: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) about z by the array `yaw` (...,) [rad]."""
    xp = yaw.__array_namespace__()
    cos, sin, zero = xp.cos(yaw), xp.sin(yaw), xp.zeros_like(yaw)
    rows = ((cos, -sin, zero), (sin, cos, zero), (zero, zero, zero + 1.0))
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def quat_to_rot(quat_wxyz: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    xp = quat_wxyz.__array_namespace__()
    w, x, y, z = (quat_wxyz[..., i : i + 1] for i in range(4))
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    parts = [
        1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
        2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
        2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
    ]  # fmt: skip
    return xp.concatenate(parts, axis=-1).reshape(*quat_wxyz.shape[:-1], 3, 3)


def rot_to_quat(rot: Array) -> Array:
    """Return the unit quaternions (..., 4) wxyz with w >= 0 of rotation matrices (..., 3, 3)."""
    xp = rot.__array_namespace__()
    xx, yy, zz = rot[..., 0, 0], rot[..., 1, 1], rot[..., 2, 2]
    # Four times the outer product of the quaternion with itself; its largest row is exact.
    wx, wy, wz = (
        rot[..., 2, 1] - rot[..., 1, 2],
        rot[..., 0, 2] - rot[..., 2, 0],
        rot[..., 1, 0] - rot[..., 0, 1],
    )
    xy, xz, yz = (
        rot[..., 1, 0] + rot[..., 0, 1],
        rot[..., 0, 2] + rot[..., 2, 0],
        rot[..., 2, 1] + rot[..., 1, 2],
    )
    rows = (
        (1 + xx + yy + zz, wx, wy, wz),
        (wx, 1 + xx - yy - zz, xy, xz),
        (wy, xy, 1 - xx + yy - zz, yz),
        (wz, xz, yz, 1 - xx - yy + zz),
    )
    outer = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    diagonal = xp.stack([rows[i][i] for i in range(4)], axis=-1)
    best = xp.argmax(diagonal, axis=-1)[..., None, None]
    quat = xp.take_along_axis(outer, best, axis=-2)[..., 0, :]
    quat = quat / xp.sqrt(xp.sum(quat**2, axis=-1, keepdims=True))
    return xp.where(quat[..., :1] < 0.0, -quat, quat)


def exp_rot(vector: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    xp = vector.__array_namespace__()
    squared = xp.sum(vector**2, axis=-1)[..., None, None]
    # For small angles the series is exact to rounding; the root has an infinite slope at zero.
    small = squared < 1e-8
    angle = xp.sqrt(xp.where(small, 1.0, squared))
    sine_factor = xp.where(small, 1.0 - squared / 6.0, xp.sin(angle) / angle)
    cosine_factor = xp.where(small, 0.5 - squared / 24.0, (1.0 - xp.cos(angle)) / angle**2)
    x, y, z = (vector[..., i : i + 1] for i in range(3))
    zero = xp.zeros_like(x)
    parts = [zero, -z, y, z, zero, -x, -y, x, zero]
    skew = xp.concatenate(parts, axis=-1).reshape(*vector.shape[:-1], 3, 3)
    return xp.eye(3) + sine_factor * skew + cosine_factor * xp.matmul(skew, skew)
