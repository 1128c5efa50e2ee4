"""A track: a scene to race through, where it came from and where the drone starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracks.scene import Scene


@dataclass(frozen=True)
class Track:
    """A race track with its start; its gates are in flight order, the first to pass being 0."""

    family: str
    """Name of the family that made it, or of the file it was read from."""
    level: int
    """Difficulty level, 0 (easy) to 9 (hard); 0 for a custom track."""
    seed: int
    """Seed within the family and level; 0 for a custom track."""
    difficulty: float
    """d = (level + U(0, 1)) / 10, drawn from the seed; 0 for a custom track."""
    scene: Scene
    """Gates and solids in the world frame, numpy arrays, float64, not batched."""
    start_pos_w: np.ndarray
    """(3,) where the drone's centre rests at time 0 [m]."""
    start_yaw: float
    """Heading at the start, about world z, 0 along world x [rad]."""
    names: tuple[str, ...]
    """One name a solid, in the order boxes, cylinders, capsules, spheres, meshes. The bars of a
    gate's frame share a name ("gate 3 frame"); every other name is unique."""
    mesh_sizes: tuple[int, ...] = ()
    """Triangles of each convex mesh; `scene.triangles` holds them one mesh after another."""
