"""Split a mesh file into its closed convex parts, for MuJoCo's collisions and for depth images.

`mesh_reader.py` runs this in a separate process, because trimesh loads files to which a mesh refers
and may use any amount of memory. Materials are skipped; a glTF's buffers are read as plain files.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tracks.input.reading import MESH_BYTES, InputError, read_bytes, reason

if TYPE_CHECKING:
    import trimesh

_VOLUME_TOLERANCE = 1e-3
"""Largest difference of a part's volume from its convex hull's, as a share of the latter; it allows
for rounding of stored corners."""

_FLAT = 1e-9
"""A part counts as flat if its volume is below this share of its largest extent cubed."""

_SLIVER = 1e-12
"""A triangle is dropped if its area is below this share of the part's largest extent squared."""


class _Resolver:
    """Loads the files to which a mesh refers (a glTF's buffers), up to a total size."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder, self._remaining_bytes = folder.resolve(), most_bytes

    def get(self, name: str) -> bytes:
        """Return the contents of the file `name`, which must be below the folder of the mesh."""
        path = (self._folder / name).resolve()
        if not path.is_relative_to(self._folder):
            raise InputError(f"{path}: is not below the folder of the mesh that refers to it")
        data = read_bytes(path, self._remaining_bytes)
        self._remaining_bytes -= len(data)
        return data

    __getitem__ = get


def convex_parts(path: Path) -> list[np.ndarray]:
    """Return the connected parts of a mesh file, each as triangles (M, 3, 3) in file units.

    Objects of an OBJ file or a scene are split one by one, so they may touch. Triangles
    without an area are left out, since they have no normal. Normals point outwards.

    Raises:
        ValueError: where the file cannot be read, or a part is open or not convex, naming the file
            and the part.
        MemoryError: where reading needs more memory than this process may use.
    """
    import trimesh

    kind = path.suffix.lower()[1:]
    options: dict[str, Any] = {"split_objects": True} if kind == "obj" else {}
    if kind not in ("stl", "off"):
        options["skip_materials"] = True
    try:
        data = read_bytes(path, MESH_BYTES)
        resolver: Any = _Resolver(path.parent, MESH_BYTES - len(data))
        scene = trimesh.load_scene(io.BytesIO(data), kind, resolver, **options)
        geometries = scene.dump()
    except (InputError, MemoryError):
        raise
    except OSError as error:
        raise ValueError(f"{path}: cannot be read as a mesh ({reason(error)})") from None
    except Exception as error:  # the loaders may raise anything for a damaged file
        reason_text = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{path}: cannot be read as a mesh ({reason_text})") from None
    meshes = [mesh for mesh in geometries if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes or not all(np.isfinite(mesh.vertices).all() for mesh in meshes):
        raise ValueError(f"{path}: has no triangles, or corners that are not finite")
    parts = []
    for mesh in meshes:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        parts += mesh.split(only_watertight=False, repair=False)
    for number, part in enumerate(parts):
        _check(path, number, len(parts), part)
    return [_triangles_with_area(part) for part in parts]


def _triangles_with_area(part: trimesh.Trimesh) -> np.ndarray:
    """Return triangles (M, 3, 3), with counterclockwise corners as seen from outside."""
    least_area = _SLIVER * float(part.extents.max()) ** 2
    triangles = np.asarray(part.triangles, float)[part.area_faces > least_area]
    return triangles[:, ::-1] if part.volume < 0.0 else triangles


def thickness(triangles: np.ndarray) -> float:
    """Return the least extent of triangles (M, 3, 3) along the principal axes of their corners."""
    corners = triangles.reshape(-1, 3) - triangles.mean(axis=(0, 1))
    axes = np.linalg.eigh(corners.T @ corners)[1]
    return float(np.ptp(corners @ axes, axis=0).min())


def _check(path: Path, number: int, total: int, part: trimesh.Trimesh) -> None:
    """Refuse a part that is open, flat or not convex."""
    where = f"{path}: part {number} of {total} ({len(part.faces)} triangles)"
    if not part.is_watertight:
        raise ValueError(
            f"{where} is not closed; close its surface (parts that touch "
            "must be separate objects of an OBJ file, or separate files)"
        )
    try:  # `hull` is the volume of the convex hull
        hull = part.convex_hull.volume
    except Exception:  # Qhull's error; its message is a page long
        hull = 0.0
    if not hull > _FLAT * float(part.extents.max()) ** 3:
        raise ValueError(f"{where} is flat; give it a thickness")
    if abs(abs(part.volume) - hull) > _VOLUME_TOLERANCE * hull:
        raise ValueError(
            f"{where} is not convex: it fills {abs(part.volume) / hull:.0%} of its convex hull, "
            "which MuJoCo uses for collisions; split it into separate convex parts (a convex "
            "decomposition)"
        )
