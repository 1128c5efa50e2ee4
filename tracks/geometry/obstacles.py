"""Place random obstacles on a track: plates, small solids, pillars and objects on the ground.

Sizes are the baseline's (Yu et al. 2025). A stretch is the part of a track between two successive
gates. Kinds of solids (box, cylinder, ...) are distributed evenly over a track, by permutation
instead of independent draws, which bounds the number of each kind.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tracks.geometry.rotation import quat_to_rot, yaw_rotation
from tracks.geometry.scene import Boxes, Gates, Rods, Spheres

BOX, CYLINDER, CAPSULE, SPHERE = range(4)
"""Numbers of the kinds of solids."""
KIND_NAMES = ("box", "cylinder", "capsule", "sphere")
"""Names of the kinds of solids, in the order of their numbers."""
GATE_DISTANCE_M = 1.5
"""Least horizontal distance of an obstacle's centre from a gate's centre [m]."""
CORRIDOR_HALF_LENGTH_M = 1.5
"""Distance before and behind a gate over which its axis is kept free [m]."""
CORRIDOR_CLEARANCE_M = 0.4
"""Least horizontal distance between an obstacle and a gate's axis [m]."""
START_CLEARANCE_M = 0.6
"""Least horizontal distance between an obstacle and the line from the start to gate 0 [m]."""
_TRIES = 24
"""Number of positions that are drawn for an obstacle before it is left out."""

Site = Callable[[np.random.Generator, np.ndarray], np.ndarray]
"""A function that draws horizontal positions (n, 2) [m] of n obstacles on given stretches (n,)."""


class PerStretch(NamedTuple):
    """Numbers of obstacles on each stretch, (S,) integers each."""

    plates: np.ndarray
    """Square plates in the air at any orientation."""
    small: np.ndarray
    """Small boxes, cylinders, capsules and spheres in the air."""
    pillars: np.ndarray
    """Standing cylinders and boxes."""
    ground: np.ndarray
    """Small solids lying on the ground."""


class KeepClear(NamedTuple):
    """Horizontal lines that obstacles must avoid, and the gates' centres."""

    begin: np.ndarray
    """(K, 2) first ends of the lines [m]."""
    end: np.ndarray
    """(K, 2) other ends of the lines [m]."""
    clearance_m: np.ndarray
    """(K,) least distances between a line and an obstacle's surface [m]."""
    center: np.ndarray
    """(G, 2) gate centres [m]."""


class Obstacles(NamedTuple):
    """Solids of each kind and their names."""

    boxes: Boxes
    cylinders: Rods
    capsules: Rods
    spheres: Spheres
    names: tuple[str, ...]
    """Names of the solids in the order boxes, cylinders, capsules, spheres."""


def keep_clear(gates: Gates, start_pos_w: np.ndarray) -> KeepClear:
    """Return the lines to keep free: each gate's axis, and the line from the start to gate 0.

    `start_pos_w` (3,) is the position of the start [m].
    """
    center = gates.center_w[:, :2]
    reach = CORRIDOR_HALF_LENGTH_M * gates.rot_w[:, :2, 0]
    clearance = np.full(len(center) + 1, CORRIDOR_CLEARANCE_M)
    clearance[-1] = START_CLEARANCE_M
    return KeepClear(
        np.concatenate([center - reach, start_pos_w[None, :2]]),
        np.concatenate([center + reach, center[:1]]),
        clearance,
        center,
    )


def segment_distance(point: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distances (...) from points to line segments of D dimensions [m].

    Args:
        point: (..., D) the points [m].
        begin: (..., D) first ends of the segments [m], broadcast against `point`.
        end: (..., D) other ends of the segments [m], broadcast against `point`.
    """
    along = end - begin
    share = np.sum((point - begin) * along, -1) / np.maximum(np.sum(along * along, -1), 1e-12)
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.sqrt(np.sum((point - nearest) ** 2, -1))


def straight_sites(gates: Gates, first: np.ndarray, offset_m: float) -> Site:
    """Return a `Site` that draws positions within `offset_m` of the lines between gates.

    Gates are in flight order; the last is followed by gate 0. Stretches begin at the gates `first`
    (S,). `offset_m` is horizontal [m].
    """
    begin = gates.center_w[first, :2]
    along = gates.center_w[(first + 1) % len(gates.center_w), :2] - begin
    side = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1)[:, None]

    def site(rng: np.random.Generator, stretch: np.ndarray) -> np.ndarray:
        share = rng.random((len(stretch), 2))
        offset = offset_m * (2 * share[:, 1:] - 1)
        return begin[stretch] + share[:, :1] * along[stretch] + offset * side[stretch]

    return site


def scatter(
    rng: np.random.Generator, per_stretch: PerStretch, site: Site, clear: KeepClear
) -> Obstacles:
    """Return random obstacles that keep the lines of `clear` free.

    An obstacle for which no free position is found is left out.
    """
    numbers = [int(n.sum()) for n in per_stretch]
    plates, small, pillars, ground = numbers
    total = sum(numbers)
    stretch = np.concatenate([np.repeat(np.arange(len(n)), n) for n in per_stretch])
    kind = np.concatenate(
        [
            np.full(plates, BOX),
            rng.permutation(np.arange(small) % 4),
            rng.permutation(np.arange(pillars) % 2),
            rng.permutation(np.arange(ground) % 4),
        ]
    )
    in_air = np.arange(total) < plates + small
    on_ground = ~in_air
    is_pillar = on_ground & (np.arange(total) < plates + small + pillars)

    # `size` is a box's half sizes; for the other kinds (radius, unused, half length).
    size = rng.uniform(0.1, 0.3, (total, 3))
    is_box = kind == BOX
    size[is_box] = rng.uniform(0.05, 0.25, (int(is_box.sum()), 3))
    size[:plates, :2] = rng.uniform(0.2, 0.5, (plates, 1))
    size[:plates, 2] = rng.uniform(0.02, 0.04, plates)
    size[is_pillar, :2] = rng.uniform(0.1, 0.5, (pillars, 1))
    size[is_pillar, 2] = rng.uniform(0.5, 1.5, pillars)

    rot_w = yaw_rotation(rng.uniform(-np.pi, np.pi, total))
    rot_w[in_air] = _random_rotations(rng, plates + small)
    # A capsule on the ground lies: its axis (the third column) becomes horizontal.
    lying = (kind == CAPSULE) & on_ground
    rot_w[lying] = rot_w[lying][:, :, [1, 2, 0]]

    height = rng.uniform(0.5, 3.0, total)
    rests_on_radius = (kind == SPHERE) | (kind == CAPSULE)
    height[on_ground] = np.where(rests_on_radius, size[:, 0], size[:, 2])[on_ground]

    xy, placed = _place(rng, stretch, _horizontal_radius(kind, size, is_pillar), site, clear)
    center_w = np.concatenate([xy, height[:, None]], axis=-1)
    labels = _labels(numbers, kind)
    # Indices of the placed boxes (b), cylinders (c), capsules (p) and spheres (s).
    b, c, p, s = (np.flatnonzero(placed & (kind == each)) for each in range(4))
    return Obstacles(
        Boxes(center_w[b], rot_w[b], size[b]),
        Rods(center_w[c], rot_w[c][:, :, 2], size[c, 0], size[c, 2]),
        Rods(center_w[p], rot_w[p][:, :, 2], size[p, 0], size[p, 2]),
        Spheres(center_w[s], size[s, 0]),
        tuple(labels[i] for i in np.concatenate([b, c, p, s])),
    )


def _labels(numbers: list[int], kind: np.ndarray) -> list[str]:
    """Return the obstacles' names, such as "small sphere 2", from their numbers and kinds."""
    plates, small, pillars, ground = numbers
    names = [KIND_NAMES[k] for k in kind[plates:]]
    return [
        *(f"plate {i}" for i in range(plates)),
        *(f"small {name} {i}" for i, name in enumerate(names[:small])),
        *(f"pillar {i}" for i in range(pillars)),
        *(f"ground {name} {i}" for i, name in enumerate(names[small + pillars :])),
    ]


def _horizontal_radius(kind: np.ndarray, size: np.ndarray, is_pillar: np.ndarray) -> np.ndarray:
    """Return each obstacle's largest horizontal extent from its centre, (n,) [m]."""
    across = np.where(kind == BOX, np.hypot(size[:, 0], size[:, 1]), size[:, 0])
    bounding = np.hypot(across, size[:, 2])
    bounding = np.where(kind == CAPSULE, size[:, 0] + size[:, 2], bounding)
    bounding = np.where(kind == SPHERE, size[:, 0], bounding)
    return np.where(is_pillar, across, bounding)


def _place(
    rng: np.random.Generator, stretch: np.ndarray, radius: np.ndarray, site: Site, clear: KeepClear
) -> tuple[np.ndarray, np.ndarray]:
    """Return horizontal positions (n, 2) [m], and whether a free one was found (n,)."""
    xy = np.zeros((len(stretch), 2))
    pending = np.arange(len(stretch))
    for _ in range(_TRIES):
        if not len(pending):
            break
        xy[pending] = site(rng, stretch[pending])
        point = xy[pending, None]
        distance = segment_distance(point, clear.begin, clear.end)
        blocks_line = np.any(distance < clear.clearance_m + radius[pending, None], axis=-1)
        squared = np.sum((point - clear.center) ** 2, axis=-1)
        pending = pending[blocks_line | np.any(squared < GATE_DISTANCE_M**2, axis=-1)]
    placed = np.ones(len(stretch), bool)
    placed[pending] = False
    return xy, placed


def _random_rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return `n` uniformly distributed rotations, (n, 3, 3), from normal quaternions."""
    quat = rng.normal(size=(n, 4))
    return quat_to_rot(quat / np.linalg.norm(quat, axis=-1, keepdims=True))
