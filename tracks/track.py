"""A track: a scene of gates and obstacles to race through, with its start position.

A generated track is determined by its family (the rule that draws it), its difficulty level and its
seed. A custom track is read from a file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tracks.geometry.scene import Boxes, Gates, Scene


@dataclass(frozen=True)
class Track:
    """A race track with its start; its gates are in flight order, from gate 0."""

    family: str
    """Name of the family that drew the track, or name of a custom track."""
    level: int
    """Difficulty level, 0 (easy) to 9 (hard); 0 for a custom track."""
    seed: int
    """Seed within the family and level; 0 for a custom track."""
    difficulty: float
    """d = (level + u) / 10, with u from 0 to 1 drawn from the seed; 0 for a custom track."""
    scene: Scene
    """Gates and solids in the world frame, numpy arrays, float64, not batched."""
    start_pos_w: np.ndarray
    """(3,) the drone's centre at time 0 [m]."""
    start_yaw: float
    """Heading at the start, about world z; 0 is along world x [rad]."""
    names: tuple[str, ...]
    """Names of the solids (gate frames and obstacles), in the order boxes, cylinders, capsules,
    spheres, meshes. The bars of a gate's frame share a name ("gate 3 frame"); every other name is
    unique."""
    mesh_sizes: tuple[int, ...] = ()
    """Number of triangles of each convex mesh; `scene.triangles` holds them mesh after mesh."""


def first_gates(track: Track, count: int) -> Track:
    """Return `track` with its first `count` gates and all obstacles.

    Raises:
        ValueError: unless `count` is from 1 to the number of gates.
    """
    gates = track.scene.gates
    total, bars = gates.opening_g.shape[:2]
    if not 1 <= count <= total:
        raise ValueError(f"{count} gates of a track that has {total}: give 1 to {total}")
    if count == total:
        return track
    # The first boxes are the bars of the gates' frames, gate by gate.
    kept = np.r_[: count * bars, total * bars : len(track.scene.boxes.center_w)]
    scene = track.scene._replace(
        gates=Gates(*(field[:count] for field in gates)),
        boxes=Boxes(*(field[kept] for field in track.scene.boxes)),
    )
    names = track.names[: count * bars] + track.names[total * bars :]
    return replace(track, scene=scene, names=names)
