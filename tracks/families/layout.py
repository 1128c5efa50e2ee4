"""Functions that the track families share: interpolation over difficulty, gates, obstacles.

A family is a rule that draws a track; it returns a `Layout`. A stretch is the part of a track
between two successive gates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tracks.geometry.gates import square_gates, with_frames
from tracks.geometry.obstacles import Obstacles, PerStretch, Site, keep_clear, scatter
from tracks.geometry.scene import Gates, Scene

GATE_COUNT = 8
"""Number of gates of a generated track."""
MIN_HEIGHT_M, MID_HEIGHT_M, MAX_HEIGHT_M = 0.8, 1.4, 2.0
"""Lowest, mean and highest height of a gate's centre in the baseline (Yu et al. 2025) [m]."""
MAX_YAW_NOISE = np.deg2rad(30.0)
"""Largest yaw noise of a gate at d = 1 [rad]."""


class Layout(NamedTuple):
    """The result of a family: a track without family, level and seed."""

    scene: Scene
    """Gates and obstacles."""
    start_pos_w: np.ndarray
    """(3,) the drone's centre at time 0 [m]."""
    start_yaw: float
    """Heading at the start about world z [rad]."""
    names: tuple[str, ...]
    """Names of the solids, as in `Track.names`."""


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
    """Return the baseline's square gates, whose sizes and yaw noise depend on the difficulty.

    Args:
        rng: random generator.
        d: difficulty in [0, 1).
        center_w: (G, 3) centres of the gates [m]; heights are clipped to the baseline's range.
        heading: (G,) flight directions without noise [rad].
        max_frame_width_m: largest width of the frames' bars [m]; the smallest is 0.15 m.
    """
    n = len(center_w)
    yaw = heading + rng.uniform(-1, 1, n) * MAX_YAW_NOISE * d
    side = ramp(1.2, 0.8, d) + rng.uniform(-0.05, 0.05, n)
    width = rng.uniform(0.15, max_frame_width_m, n)
    center_w = center_w.copy()
    center_w[:, 2] = np.clip(center_w[:, 2], MIN_HEIGHT_M, MAX_HEIGHT_M)
    return square_gates(center_w, yaw, side, width, np.full(n, ramp(0.03, 0.06, d)))


def flight_order(gates: Gates, first: int) -> Gates:
    """Return the gates of a closed track, renumbered so that gate `first` becomes gate 0."""
    return Gates(*(np.roll(field, -first, axis=0) for field in gates))


def pick_first_gate(rng: np.random.Generator, center_w: np.ndarray, min_length_m: float) -> int:
    """Return the number of a random gate, before which the stretch is long enough for a start.

    If no stretch is long enough, return the gate after the longest one. `center_w` (G, 3) are gate
    centres of a closed track in flight order [m]. A start needs a stretch of `min_length_m` [m].
    """
    length = np.linalg.norm(center_w - np.roll(center_w, 1, axis=0), axis=-1)
    fits = np.flatnonzero(length >= min_length_m)
    return int(rng.choice(fits)) if len(fits) else int(length.argmax())


def counts_per_stretch(
    rng: np.random.Generator, d: float, stretches: int, scale: float = 1.0
) -> PerStretch:
    """Return the baseline's numbers of obstacles for each stretch.

    The numbers are equal on all stretches, except those of ground objects, which are random. The
    difficulty d is in [0, 1). The `scale` multiplies the counts before truncation (radius / 8 on
    the circle).
    """

    def same(easy: float, hard: float) -> np.ndarray:
        return np.full(stretches, int(ramp(easy, hard, d) * scale))

    ground = (rng.integers(1, 5, stretches) * scale).astype(int)
    return PerStretch(same(1, 4), same(1, 4), same(1, 2), ground)


def build(gates: Gates, start_pos_w: np.ndarray, obstacles: Obstacles) -> Layout:
    """Return the layout of gates, start and obstacles; the start faces gate 0."""
    boxes, frame_names = with_frames(gates, obstacles.boxes)
    scene = Scene(
        gates,
        boxes,
        obstacles.cylinders,
        obstacles.capsules,
        obstacles.spheres,
        np.zeros((0, 3, 3)),
    )
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
    """Place random obstacles at a distance from gates and start, and return the layout.

    G gates are in flight order. `start_pos_w` (3,) is the drone's centre at time 0 [m]. `site`
    draws horizontal positions on given stretches.
    """
    obstacles = scatter(rng, per_stretch, site, keep_clear(gates, start_pos_w))
    return build(gates, start_pos_w, obstacles)
