"""Convex closed parts of a mesh file: what MuJoCo collides and the depth image shows alike."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tracks.input.reading import MESH_BYTES, check_file

if TYPE_CHECKING:
    import trimesh

_VOLUME_TOLERANCE = 1e-3
"""A part may miss this share of its convex hull's volume (rounding of stored corners)."""

_FLAT = 1e-9
"""Volume over that of a cube of the largest extent at which a part counts as flat."""

_SLIVER = 1e-12
"""A triangle's area over that of a square of its part's largest extent at which it is none."""


def load_convex_parts(path: Path) -> list[np.ndarray]:
    """Return the connected parts of a mesh file, each as triangles (M, 3, 3) in file units.

    Objects of an OBJ file or a scene are looked at one by one, so that they may touch. Triangles
    without an area are left out: they have no side, and a distance to them means nothing.

    Raises:
        ValueError: where the file cannot be read, or a part is open or not convex, naming both.
    """
    # Here, so that tracks without meshes do not pay for the import.
    import trimesh

    if not path.exists():
        raise ValueError(f"{path}: no such mesh file")
    check_file(path, MESH_BYTES)
    options: dict[str, Any] = {"split_objects": True} if path.suffix.lower() == ".obj" else {}
    try:
        found = trimesh.load_scene(path, **options).dump()
    except Exception as error:  # the loaders raise whatever they like on a damaged file
        raise ValueError(f"{path}: cannot be read as a mesh ({error})") from None
    meshes = [mesh for mesh in found if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes or not all(np.isfinite(mesh.vertices).all() for mesh in meshes):
        raise ValueError(f"{path}: holds no triangles or corners that are not finite")
    parts = []
    for mesh in meshes:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        parts += mesh.split(only_watertight=False, repair=False)
    for number, part in enumerate(parts):
        _check(path, number, len(parts), part)
    return [_with_area(part) for part in parts]


def _with_area(part: trimesh.Trimesh) -> np.ndarray:
    least = _SLIVER * float(part.extents.max()) ** 2
    return np.asarray(part.triangles, float)[part.area_faces > least]


def thickness(triangles: np.ndarray) -> float:
    """Return how far triangles (M, 3, 3) reach along the axis that they spread least along."""
    corners = triangles.reshape(-1, 3) - triangles.mean(axis=(0, 1))
    axes = np.linalg.eigh(corners.T @ corners)[1]
    return float(np.ptp(corners @ axes, axis=0).min())


def _check(path: Path, number: int, total: int, part: trimesh.Trimesh) -> None:
    where = f"{path}: part {number} of {total} ({len(part.faces)} triangles)"
    if not part.is_watertight:
        raise ValueError(
            f"{where} is not closed; close its surface (parts that touch "
            "need to be objects of their own in an OBJ file, or files of their own)"
        )
    try:
        hull = part.convex_hull.volume
    except Exception:  # Qhull's own, with a page of text
        hull = 0.0
    if not hull > _FLAT * float(part.extents.max()) ** 3:
        raise ValueError(f"{where} is flat; give it a thickness")
    if abs(abs(part.volume) - hull) > _VOLUME_TOLERANCE * hull:
        raise ValueError(
            f"{where} is not convex: it fills {abs(part.volume) / hull:.0%} of its convex hull, "
            "which is what MuJoCo would collide; split it into convex parts (a convex "
            "decomposition), each a connected part of its own"
        )
