"""Convert a track's solids to triangle meshes (trimesh), for pictures and geometric checks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from tracks.geometry.scene import PARKED_Z, Rods
from tracks.track import Track

_SECTIONS = 24
"""Number of facets around cylinders and capsules."""


def solid_meshes(track: Track) -> list[tuple[str, trimesh.Trimesh]]:
    """Return (name, mesh) of every solid in the order of `Track.names`, in the world frame.

    Padding bars far below the ground (of openings with fewer corners than others) are left out. The
    ground, the plane z = 0, has no mesh. Round solids are approximated by inscribed polyhedra.
    """
    scene = track.scene
    offsets = np.cumsum((0, *track.mesh_sizes))
    meshes = [
        *(_box(*box) for box in zip(*scene.boxes, strict=True)),
        *_rods(scene.cylinders, _cylinder),
        *_rods(scene.capsules, _capsule),
        *(_sphere(*ball) for ball in zip(*scene.spheres, strict=True)),
        *(
            trimesh.Trimesh(**trimesh.triangles.to_kwargs(scene.triangles[begin:end]))
            for begin, end in zip(offsets, offsets[1:], strict=False)
        ),
    ]
    named = zip(track.names, meshes, strict=True)
    return [(name, mesh) for name, mesh in named if mesh.bounds[1, 2] > PARKED_Z / 2]


def _box(center_w: np.ndarray, rot_w: np.ndarray, half_size: np.ndarray) -> trimesh.Trimesh:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rot_w, center_w
    return trimesh.creation.box(extents=2 * half_size, transform=matrix)


def _sphere(center_w: np.ndarray, radius: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return mesh.apply_translation(center_w)


def _cylinder(radius: float, half_length: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=radius, height=2 * half_length, sections=_SECTIONS)


def _capsule(radius: float, half_length: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.capsule(radius=radius, height=2 * half_length, count=[_SECTIONS] * 2)
    # Centre the capsule, whatever origin the library chose.
    return mesh.apply_translation(-mesh.bounds.mean(axis=0))


def _rods(rods: Rods, make: Callable[[float, float], trimesh.Trimesh]) -> list[trimesh.Trimesh]:
    """Return the meshes of rods; `make` returns one along z from its radius and half length."""
    meshes = []
    for center_w, axis_w, radius, half_length in zip(*rods, strict=True):
        matrix = np.array(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis_w))
        matrix[:3, 3] = center_w
        meshes.append(make(radius, half_length).apply_transform(matrix))
    return meshes
