"""Find a constant rotation between the body axes of an attitude and those of the gyro."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from eval.logs.faults.finding import Finding

NOTED_DEG, FAULT_DEG, LIMIT_DEG = 5.0, 15.0, 120.0
"""Rotation above which it is reported, above which it is a fault, and its limit [deg]. A smaller
one may be a tilt of the markers, a larger one a wrong sign, which other checks name."""
HALF, PRIOR = 0.5, 0.03
"""A rotation must lower the squared misfit of the best delay to this share. The second counts as
the share of the rates for which the axes are equal, since few axes may turn."""


def fit_rotation(turns: np.ndarray, gyros: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3, 3) from the rates `turns` (N, 3) to the gyro's, and its vector [deg].

    `gyros` are the gyro's rates (3, K, N) for K trial delays each. It is 0 where a delay alone fits
    about as well (Kabsch 1976, for every delay).
    """
    from scipy.spatial.transform import Rotation

    size = np.linalg.norm(turns, axis=1)
    kept = size <= 8.0 * np.quantile(size, 0.9)
    source = turns[kept] - turns[kept].mean(axis=0)
    source /= max(float(np.linalg.norm(source)), 1e-12)
    alone, least, best = np.inf, np.inf, np.eye(3)
    for gyro in gyros:
        target = gyro[..., kept] - gyro[..., kept].mean(axis=-1, keepdims=True)
        size = np.sqrt(np.sum(target**2, axis=(0, 2)))
        product = np.moveaxis(target, 1, 0) @ source / np.maximum(size, 1e-12)[:, None, None]
        u, _, vt = np.linalg.svd(product + PRIOR * np.eye(3))
        u[..., 2] *= np.linalg.det(u @ vt)[:, None]
        rotation = u @ vt
        alone = min(alone, 2.0 - 2.0 * float(np.trace(product, axis1=1, axis2=2).max()))
        misfit = 2.0 - 2.0 * np.sum(rotation * product, axis=(1, 2))
        k = int(np.argmin(misfit))
        if misfit[k] < least:
            least, best = float(misfit[k]), rotation[k]
    vector = np.rad2deg(Rotation.from_matrix(best).as_rotvec())
    angle = float(np.linalg.norm(vector))
    if least > HALF * alone or not NOTED_DEG < angle < LIMIT_DEG:
        return np.eye(3), np.zeros(3)
    return best, vector


def rotated_to(turns: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return the rates `turns` (N, 3) in the body axes of the rates `given` (N, 3)."""
    known = np.isfinite(turns).all(axis=1) & np.isfinite(given).all(axis=1)
    if not known.any():
        return turns
    rotation, _ = fit_rotation(turns[known], [given[known].T[:, None]])
    return turns @ rotation.T


def rotation_findings(rotation: np.ndarray) -> list[Finding]:
    """Return the finding on a rotation vector (3,) [deg] of the body axes; none if it is small."""
    angle = float(np.linalg.norm(rotation))
    if angle < NOTED_DEG:
        return []
    axis = ", ".join(f"{part / angle:+.2f}" for part in rotation)
    text = f"its body is rotated by {angle:.0f} deg about ({axis}) against the gyro"
    if angle < FAULT_DEG:
        return [Finding("note", "pose axes", text)]
    fix = "align the body in the motion capture, or the gyro, with the vehicle's axes"
    return [Finding("doubt", "pose axes", text, "body_frame", angle, 0.95, fix)]
