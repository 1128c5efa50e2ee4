"""A track written as the TOML file that `tracks.formats.custom.load_track` reads back."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tracks.common.files import replacing_file, write_text
from tracks.common.toml_text import to_toml
from tracks.geometry.rotation import rot_to_quat
from tracks.geometry.scene import Array, Scene
from tracks.track import Track


def save_track(track: Track, path: str | os.PathLike[str]) -> None:
    """Write `track` to a TOML file; convex meshes go beside it as `STEM.mesh0.obj` and so on.

    Read back it is the same track (numbers to the last bit but for rotations and meshes, those to
    1e-9), with the family as its name and level and seed 0.
    """
    path = Path(path)
    scene = track.scene
    kinds = (scene.boxes, scene.cylinders, scene.capsules, scene.spheres)
    bars = int(np.prod(scene.gates.opening_g.shape[:2]))
    ends = np.cumsum([len(kind[0]) for kind in kinds])
    split = [list(part) for part in np.split(np.array(track.names, dtype=object), ends)]
    boxes, cylinders, capsules, spheres, meshes = split
    yaw_deg = float(np.rad2deg(track.start_yaw))
    text = [
        f"# level {track.level}, seed {track.seed}",
        _line("schema", 1),
        _line("name", track.family),
        "",
        "[start]",
        _line("position", track.start_pos_w),
        _line("yaw_deg", yaw_deg),
        *_gates(scene),
        *_boxes(scene, boxes[bars:], bars),
        *_rods("cylinders", scene.cylinders, cylinders),
        *_rods("capsules", scene.capsules, capsules),
    ]
    for name, center, radius in zip(spheres, *scene.spheres, strict=True):
        text += _table("spheres", name=name, center=center, radius=radius)
    first = 0
    for number, (name, size) in enumerate(zip(meshes, track.mesh_sizes, strict=True)):
        file = f"{path.stem}.mesh{number}.obj"
        _write_obj(path.with_name(file), scene.triangles[first : first + size])
        text += _table("meshes", name=name, file=file)
        first += size
    write_text(path, "\n".join(text) + "\n")


def _gates(scene: Scene) -> Iterable[str]:
    for center, rot, opening, width, depth in zip(*scene.gates, strict=True):
        repeated = (np.diff(opening, axis=0) == 0).all(axis=-1)
        corners = opening[np.concatenate([[True], ~repeated])]
        yield from _table(
            "gates",
            center=center,
            quat_wxyz=rot_to_quat(rot),
            polygon=corners,
            frame_width=width,
            frame_depth=depth,
        )


def _boxes(scene: Scene, names: list[str], first: int) -> Iterable[str]:
    rows = (field[first:] for field in scene.boxes)
    for name, center, rot, half_size in zip(names, *rows, strict=True):
        yield from _table(
            "boxes", name=name, center=center, quat_wxyz=rot_to_quat(rot), size=2 * half_size
        )


def _rods(kind: str, rods: tuple[Array, ...], names: list[str]) -> Iterable[str]:
    for name, center, axis, radius, half in zip(names, *rods, strict=True):
        yield from _table(kind, name=name, center=center, axis=axis, radius=radius, length=2 * half)


def _table(kind: str, **values: object) -> list[str]:
    return ["", f"[[{kind}]]", *(_line(key, value) for key, value in values.items())]


def _line(key: str, value: object) -> str:
    """Return one `key = value`."""
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return to_toml({key: plain}).rstrip("\n")


def _write_obj(path: Path, triangles: np.ndarray) -> None:
    corners, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    vertices = (f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist())
    faces = (f"f {a} {b} {c}" for a, b, c in (index.reshape(-1, 3) + 1).tolist())
    with replacing_file(path) as beside:
        beside.write_text("\n".join([*vertices, *faces]) + "\n", encoding="utf-8")
