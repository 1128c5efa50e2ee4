"""Shared functions of the track families: difficulty, gate sizes, starts, assembly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tracks.geometry.gates import frame_boxes, square_gates
from tracks.geometry.obstacles import Obstacles, PerStretch, Site, keep_clear, scatter
from tracks.geometry.scene import Boxes, Gates, Scene

GATE_COUNT = 8
MIN_HEIGHT_M = 0.8
MAX_HEIGHT_M = 2.0
MID_HEIGHT_M = 1.4
MAX_YAW_NOISE = np.deg2rad(30.0)
"""Largest yaw noise of a gate at d = 1 [rad]."""


class Layout(NamedTuple):
    """The result of a family: a track without its origin."""

    scene: Scene
    start_pos_w: np.ndarray
    """(3,) [m]."""
    start_yaw: float
    """[rad]."""
    names: tuple[str, ...]
    """As in `Track.names`."""


def ramp(easy: float, hard: float, d: float) -> float:
    """Return the linear interpolation from `easy` (d = 0) to `hard` (d = 1)."""
    return easy + (hard - easy) * d


def noisy_gates(
    rng: np.random.Generator,
    d: float,
    center_w: np.ndarray,
    heading: np.ndarray,
    max_frame_width_m: float = 0.25,
) -> Gates:
    """Return the baseline's square gates at the given poses: sizes and yaw noise follow d.

    Args:
        rng: source of randomness.
        d: difficulty in [0, 1).
        center_w: (G, 3) [m]; heights are clipped to the baseline's range.
        heading: (G,) flight directions without noise [rad].
        max_frame_width_m: bars are 0.15 m to this wide.
    """
    n = len(center_w)
    yaw = heading + rng.uniform(-1, 1, n) * MAX_YAW_NOISE * d
    side = ramp(1.2, 0.8, d) + rng.uniform(-0.05, 0.05, n)
    width = rng.uniform(0.15, max_frame_width_m, n)
    center_w = center_w.copy()
    center_w[:, 2] = np.clip(center_w[:, 2], MIN_HEIGHT_M, MAX_HEIGHT_M)
    return square_gates(center_w, yaw, side, width, np.full(n, ramp(0.03, 0.06, d)))


def flight_order(gates: Gates, first: int) -> Gates:
    """Return the gates of a closed track, rotated so that gate `first` becomes gate 0."""
    return Gates(*(np.roll(field, -first, axis=0) for field in gates))


def pick_stretch(rng: np.random.Generator, center_w: np.ndarray, min_length_m: float) -> int:
    """Return a random gate with a long enough stretch before it for a start.

    If there is none, return the gate with the longest stretch.
    """
    length = np.linalg.norm(center_w - np.roll(center_w, 1, axis=0), axis=-1)
    fits = np.flatnonzero(length >= min_length_m)
    return int(rng.choice(fits)) if len(fits) else int(length.argmax())


def counts_per_stretch(
    rng: np.random.Generator, d: float, stretches: int, scale: float = 1.0
) -> PerStretch:
    """Return the baseline's numbers of obstacles, the same on every stretch but on the ground.

    Args:
        rng: source of randomness.
        d: difficulty in [0, 1).
        stretches: number of stretches with obstacles.
        scale: factor on the counts before truncation (radius / 8 on the circle).
    """

    def same(easy: float, hard: float) -> np.ndarray:
        return np.full(stretches, int(ramp(easy, hard, d) * scale))

    ground = (rng.integers(1, 5, stretches) * scale).astype(int)
    return PerStretch(same(1, 4), same(1, 4), same(1, 2), ground)


def build(gates: Gates, start_pos_w: np.ndarray, obstacles: Obstacles) -> Layout:
    """Return the layout of gates, start and obstacles; the start faces gate 0."""
    frames = frame_boxes(gates)
    boxes = Boxes(*(np.concatenate(pair) for pair in zip(frames, obstacles.boxes, strict=True)))
    scene = Scene(
        gates,
        boxes,
        obstacles.cylinders,
        obstacles.capsules,
        obstacles.spheres,
        np.zeros((0, 3, 3)),
    )
    bars = gates.opening_g.shape[-2]
    frame_names = (f"gate {i} frame" for i in range(len(gates.center_w)) for _ in range(bars))
    ahead = gates.center_w[0] - start_pos_w
    return Layout(
        scene, start_pos_w, float(np.arctan2(ahead[1], ahead[0])), (*frame_names, *obstacles.names)
    )


def furnish(
    rng: np.random.Generator,
    gates: Gates,
    start_pos_w: np.ndarray,
    per_stretch: PerStretch,
    site: Site,
) -> Layout:
    """Place obstacles clear of gates and start, and return the layout."""
    obstacles = scatter(rng, per_stretch, site, keep_clear(gates, start_pos_w))
    return build(gates, start_pos_w, obstacles)
