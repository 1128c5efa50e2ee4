"""Check a track that a program drew: shapes, finite numbers, and gates that can be flown."""

from __future__ import annotations

from typing import Any

import numpy as np

from tracks.geometry.scene import counts
from tracks.track import Track

SHAPES = {
    "center_w": (3,),
    "rot_w": (3, 3),
    "axis_w": (3,),
    "half_size": (3,),
    "radius": (),
    "half_length": (),
    "opening_g": (-1, 2),
    "frame_width": (),
    "frame_depth": (),
}
"""Field of gates and solids -> shape of one entry; -1 is any number."""
SIZES = ("half_size", "radius", "half_length", "frame_width", "frame_depth")
"""Fields whose numbers are lengths above 0."""
ROUNDING = 1e-6
"""Largest error of a rotation or a unit vector, and an area that is none [m^2]."""


def check_track(track: Track) -> None:
    """Refuse a track with numbers that no simulator can use.

    Raises:
        ValueError: for an array of the wrong shape, a number that is not finite, a matrix that is
            no rotation, a size of 0, an opening that has no area, clockwise corners or a part below
            the ground, a start below the ground, or names that do not fit the solids.
    """
    scene, gates = track.scene, track.scene.gates
    for kind, part in zip(scene._fields[:5], scene[:5], strict=True):
        for field, array in part._asdict().items():
            name = f"scene.{kind}.{field}"
            _check_array(track, name, array, (len(np.atleast_1d(part[0])), *SHAPES[field]))
            if field in SIZES and (array <= 0.0).any():
                raise _refused(track, name, f"{array.min():g} m", "above 0")
            if field == "rot_w":
                error = abs(array @ np.swapaxes(array, 1, 2) - np.eye(3)).max(initial=0.0)
                if error > ROUNDING or (np.linalg.det(array) < 0.0).any():
                    raise _refused(track, name, "no rotation", "a rotation from local to world")
            if field == "axis_w" and (abs(np.linalg.norm(array, axis=1) - 1.0) > ROUNDING).any():
                raise _refused(track, name, "no unit vector", "a vector of length 1")
    _check_array(track, "scene.triangles", scene.triangles, (len(scene.triangles), 3, 3))
    _check_array(track, "start_pos_w", track.start_pos_w, (3,))
    if track.start_pos_w[2] <= 0.0:
        raise _refused(track, "start_pos_w", track.start_pos_w.tolist(), "above the ground (z > 0)")
    _check_array(track, "start_yaw", np.asarray(track.start_yaw), ())
    if not len(gates.center_w):
        raise _refused(track, "scene.gates", "empty", "at least one gate")
    y, z = np.moveaxis(gates.opening_g, -1, 0)
    area = (y * np.roll(z, -1, axis=1) - z * np.roll(y, -1, axis=1)).sum(axis=1) / 2.0
    if (area <= ROUNDING).any():
        allowed = "an area with its corners (y, z) counter-clockwise"
        raise _refused(track, "scene.gates.opening_g", f"of {area.min():g} m^2", allowed)
    height = gates.center_w[:, 2:] + (gates.opening_g @ gates.rot_w[:, 2, 1:, None])[..., 0]
    if height.min() < 0.0:
        gate = int(height.min(axis=1).argmin())
        raise _refused(track, f"gate {gate}", f"{-height.min():.2g} m below the ground", "above it")
    _check_names(track)


def _check_names(track: Track) -> None:
    """Refuse names that do not fit the solids, and boxes that do not begin with the frames."""
    gates, bars = track.scene.gates.opening_g.shape[:2]
    frames = [f"gate {gate} frame" for gate in range(gates) for _ in range(bars)]
    solids = sum(counts(track.scene)[:4]) + len(track.mesh_sizes)
    others = track.names[len(frames) :]
    if list(track.names[: len(frames)]) != frames or len(track.scene.boxes.center_w) < len(frames):
        allowed = f"names that begin with the {len(frames)} bars of the gates' frames"
        raise _refused(track, "names", "without frames", f"{allowed}; layout.build adds them")
    if len(track.names) != solids or len({*others, *frames}) != len(others) + gates:
        allowed = f"a different name for each of {solids} solids; the bars of a frame share one"
        raise _refused(track, "names", f"{len(track.names)} or not different", allowed)


def _check_array(track: Track, name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Refuse anything but a numpy array of a shape, of finite numbers."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise _refused(track, name, f"a {type(array).__name__}", "a numpy array of numbers")
    fits = [wanted in (-1, size) for wanted, size in zip(shape, array.shape, strict=False)]
    if array.ndim != len(shape) or not all(fits):
        text = str(shape).replace("-1", "V")
        raise _refused(track, name, f"of shape {array.shape}", f"of shape {text}")
    if not np.isfinite(array).all():
        raise _refused(track, name, "not finite", "finite numbers")


def _refused(track: Track, name: str, value: object, allowed: str) -> ValueError:
    where = f"track {track.family!r} (level {track.level}, seed {track.seed})"
    return ValueError(f"{where}: {name} is {value}, allowed is {allowed}")
