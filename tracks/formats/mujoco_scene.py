"""Add a scene (gates, obstacles, ground) to a MuJoCo model, as geoms (solids) of its world body.

Solids have MuJoCo's default contact bits, so a drone collides with them; geoms of the world body
never collide with one another. Rays ignore contact bits and hit every solid, unless they select a
geom group. The order is that of `Track.names`, with the ground last. Each kind of solid is followed
by its padding: solids far below the ground, which make the number of geoms equal in all models.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from tracks.geometry.scene import Counts, Scene, counts, pad

GROUND = "ground"
"""Name of the ground's geom."""
PARKED = "parked"
"""Name of padding geoms."""
MESH_GROUP = 1
"""Geom group of meshes, so that rays can hit meshes only."""
_SEPARATOR = "/"
"""Text between the name of a solid and the number of its geom."""


def solid_name(geom_name: str) -> str:
    """Return the name of the solid ("gate 3 frame") of the geom `geom_name` ("gate 3 frame/2")."""
    return geom_name.split(_SEPARATOR)[0]


def add_scene(
    spec: mujoco.MjSpec,
    scene: Scene,
    names: tuple[str, ...] = (),
    mesh_sizes: tuple[int, ...] = (),
    pad_to: Counts | None = None,
) -> None:
    """Add the scene's solids and the ground plane to the world body of `spec`.

    A geom is named after its solid; the bars of a frame, which share a name, and padding get a
    running number ("gate 3 frame/2"): see `solid_name`. Scenes padded to the same numbers compile
    to models of the same sizes, as `mujoco.batch.Batch.set_models` requires.

    Args:
        spec: the model; it is changed in place.
        scene: the scene, not batched.
        names: names of the solids, as `Track.names`; if empty, solids are named by kind and number.
        mesh_sizes: numbers of triangles, as `Track.mesh_sizes`.
        pad_to: numbers of solids of each kind after padding; meshes are never padded.

    Raises:
        ValueError: where the scene has more solids of a kind than `pad_to`, or names and solids
            do not match in number.
    """
    solid_counts = counts(scene)[:4]
    if sum(mesh_sizes) != len(scene.triangles):
        raise ValueError(
            f"mesh_sizes add up to {sum(mesh_sizes)}, the scene has {len(scene.triangles)} "
            "triangles; give the number of triangles of each mesh"
        )
    if names and len(names) != sum(solid_counts) + len(mesh_sizes):
        raise ValueError(
            f"{len(names)} names for {sum(solid_counts) + len(mesh_sizes)} solids; "
            "give one name for each solid"
        )
    if pad_to is not None:
        scene = pad(scene, pad_to._replace(triangles=len(scene.triangles)))
    first, used = np.concatenate([[0], np.cumsum(solid_counts)]), Counter()

    def give_name(kind: int, number: int) -> str:
        """Return a unique geom name for a solid of a kind, or for its padding."""
        name = PARKED
        if kind == len(solid_counts) or number < solid_counts[kind]:
            name = names[first[kind] + number] if names else f"{Scene._fields[kind + 1]} {number}"
        used[name] += 1
        return name if used[name] == 1 else f"{name}{_SEPARATOR}{used[name] - 1}"

    world = spec.worldbody
    geom = mujoco.mjtGeom

    def add(kind: int, shape: Any, pos: np.ndarray, quat: np.ndarray, size: np.ndarray) -> None:
        for number in range(len(pos)):
            world.add_geom(
                name=give_name(kind, number),
                type=shape,
                pos=pos[number],
                quat=quat[number],
                size=size[number],
            )

    boxes, spheres = scene.boxes, scene.spheres
    add(0, geom.mjGEOM_BOX, boxes.center_w, _quats(boxes.rot_w), boxes.half_size)
    rods_kinds = ((scene.cylinders, geom.mjGEOM_CYLINDER), (scene.capsules, geom.mjGEOM_CAPSULE))
    for kind, (rods, shape) in enumerate(rods_kinds, start=1):
        size = np.stack([rods.radius, rods.half_length, 0 * rods.radius], axis=-1)
        add(kind, shape, rods.center_w, _axis_quats(rods.axis_w), size)
    size = np.stack([spheres.radius, 0 * spheres.radius, 0 * spheres.radius], axis=-1)
    no_rotation = np.tile([1.0, 0.0, 0.0, 0.0], (len(size), 1))
    add(3, geom.mjGEOM_SPHERE, spheres.center_w, no_rotation, size)
    _add_meshes(spec, scene.triangles, mesh_sizes, give_name)
    world.add_geom(name=GROUND, type=geom.mjGEOM_PLANE, size=[0, 0, 1])


def _add_meshes(
    spec: mujoco.MjSpec,
    triangles: np.ndarray,
    mesh_sizes: tuple[int, ...],
    give_name: Callable[[int, int], str],
) -> None:
    """Add each convex mesh as a geom of the world body."""
    first = 0
    for number, size in enumerate(mesh_sizes):
        corners = np.asarray(triangles[first : first + size], float).reshape(-1, 3)
        first += size
        name = give_name(4, number)
        # MuJoCo collides and casts rays against the convex hull, so the vertices are enough.
        vertices = np.unique(corners, axis=0)
        spec.add_mesh(name=name, uservert=vertices.ravel().tolist())
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(name=name, type=kind, meshname=name, group=MESH_GROUP)


def _quats(rot: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4) wxyz of rotations (N, 3, 3)."""
    quats = np.empty((len(rot), 4))
    for quat, matrix in zip(quats, np.asarray(rot, float).reshape(-1, 9), strict=True):
        mujoco.mju_mat2Quat(quat, matrix)
    return quats


def _axis_quats(axis: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) wxyz that rotate z to the given unit axes (N, 3)."""
    x, y, z = np.asarray(axis, float).T
    quat = np.stack([1 + z, -y, x, 0 * z], axis=-1)
    quat[z < -1 + 1e-12] = [0.0, 1.0, 0.0, 0.0]
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)
