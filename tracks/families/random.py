"""The track family `random`, on which policies are trained; it covers the three judged families.

A track is a random walk of 8 gates. Its mean turn (a bend of either sign or none, with up to two
sharp turns) produces circles, U-turns and lines; random deviations of heading and spacing produce
zigzags. Every parameter is drawn for each track; each kind of obstacle has its own density. A
stretch is the part of a track between two successive gates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tracks.families.layout import GATE_COUNT, MAX_YAW_NOISE, Layout, furnish, ramp
from tracks.geometry.gates import square_gates
from tracks.geometry.obstacles import PerStretch, segment_distance, straight_sites

MIN_SPACING_M, MAX_SPACING_M = 2.5, 7.0
"""Least and largest horizontal distance between successive gates [m]."""
PASSING_M = 1.6
"""Least horizontal distance of a stretch from the centre of any gate that is not one of its ends
[m]."""
MAX_APPROACH = np.deg2rad(95.0)
"""Largest angle between a stretch and the direction of a gate that it joins [rad]."""
MAX_HAIRPIN_APPROACH = np.deg2rad(110.0)
"""`MAX_APPROACH` on tracks with hairpins, as at the apexes of the hardest ellipses [rad]."""
MAX_TOTALS = PerStretch(*(np.array(n) for n in (23, 23, 10, 14)))
"""Largest numbers of plates, small solids, pillars and ground objects of a track."""
_WALKS = 8
"""Number of candidate walks in one draw."""
_DRAWS = 12
"""Number of draws without a free walk after which a straight track is returned."""

OFFSET_M = (2.0, 4.0)
"""Range from which a track draws the largest distance of its obstacles from the lines between gates
[m]; a smaller distance places more obstacles on the lines."""


class Walks(NamedTuple):
    """W candidate walks with the same mean turns."""

    center: np.ndarray
    """(W, G, 2) horizontal positions of the gates' centres [m]."""
    yaw: np.ndarray
    """(W, G) flight directions through the gates [rad]."""
    start: np.ndarray
    """(W, 2) horizontal position of the start [m]."""


class Mix(NamedTuple):
    """Probabilities of sharp turns, hairpins and obstacles, in addition to the difficulty."""

    sharp_share: float = 0.55
    """Probability that a track has one or two sharp turns."""
    density: tuple[float, float] = (0.0, 1.3)
    """Range of the obstacles' density, relative to the judged families."""
    bare_share: float = 0.2
    """Probability that a track has no obstacles."""
    hairpin_share: float = 0.0
    """Probability that a track has one or two hairpins; walks that pass near other gates are drawn
    again."""
    height_spread: float = 1.0
    """Factor on the range of the gates' heights."""


MIX = Mix()
"""The default probabilities."""


def make(d: float, rng: np.random.Generator, mix: Mix = MIX) -> Layout:
    """Return a random track of difficulty `d` in [0, 1]."""
    xy, yaw, start = _walk(d, rng, mix)
    n = GATE_COUNT
    side = np.clip(ramp(1.2, 0.85, d) + rng.uniform(-0.1, 0.1, n), 0.75, 1.3)
    width = rng.uniform(0.13, 0.27, n)
    depth = rng.uniform(0.03, ramp(0.05, 0.08, d), n)
    middle, spread = rng.uniform(1.0, 1.8), mix.height_spread * ramp(0.1, 1, d) * rng.random()
    height = middle + spread * rng.uniform(-1, 1, n)
    height = np.clip(height, np.maximum(0.8, side / 2 + width), 2.2)
    center_w = np.column_stack([xy, height])
    gates = square_gates(center_w, yaw, side, width, depth)
    start_height = max(0.5, height[0] + rng.uniform(-0.3, 0.3))
    start_pos_w = np.array([*start, start_height])

    stretches = np.arange(GATE_COUNT - 1)
    site = straight_sites(gates, stretches, rng.uniform(*OFFSET_M))
    return furnish(rng, gates, start_pos_w, _obstacle_counts(d, rng, len(stretches), mix), site)


def _obstacle_counts(d: float, rng: np.random.Generator, stretches: int, mix: Mix) -> PerStretch:
    """Draw numbers of obstacles: none on some tracks, more than in the baseline on others."""
    density = rng.uniform(*mix.density) if rng.random() < 1 - mix.bare_share else 0.0
    kind_factor = np.clip(rng.uniform(0.0, 2.0, 4), 0.3, 1.5)
    air, pillar, ground = ramp(1, 3.5, d), ramp(0.8, 1.3, d), 2.0
    mean = density * kind_factor * np.array([air, air, pillar, ground])
    numbers = np.floor(mean[:, None] + rng.random((4, stretches))).astype(int) * (density > 0)
    for row, largest_total in zip(numbers, MAX_TOTALS, strict=True):
        if row.sum() > largest_total:
            # Removed at random: otherwise the last stretches would always have fewer obstacles.
            row[:] = rng.multivariate_hypergeometric(row, int(largest_total))
    return PerStretch(*numbers)


def _walk(
    d: float, rng: np.random.Generator, mix: Mix
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gate centres (G, 2), yaws (G,) and the start (2,) of the first free walk.

    A walk is free if it passes far enough from other gates, see `is_free`.
    """
    # A mix without hairpins draws no number here, so that each seed keeps its track.
    hairpins = mix.hairpin_share > 0 and rng.random() < mix.hairpin_share
    for _ in range(_DRAWS):
        turn = _drift_turns(d, rng, mix.sharp_share)
        walks = _candidates(d, rng, _with_hairpins(turn, rng) if hairpins else turn)
        free = np.flatnonzero(is_free(walks, MAX_HAIRPIN_APPROACH if hairpins else MAX_APPROACH))
        if len(free):
            return walks.center[free[0]], walks.yaw[free[0]], walks.start[free[0]]
    straight = _candidates(0.0, rng, np.zeros(GATE_COUNT))
    return straight.center[0], straight.yaw[0], straight.start[0]


def _drift_turns(d: float, rng: np.random.Generator, sharp_share: float) -> np.ndarray:
    """Draw the mean turn at each gate, (G,) [rad]."""
    sign = rng.choice([-1.0, 1.0])
    bend = np.deg2rad(rng.uniform(0, 52)) if rng.random() < 0.6 else 0.0
    turn = sign * bend + rng.normal(size=GATE_COUNT) * np.deg2rad(rng.uniform(0, 12))
    if rng.random() < sharp_share:
        corners = rng.choice(GATE_COUNT - 1, rng.integers(1, 3), replace=False)
        sharp = np.deg2rad(rng.uniform(60, ramp(120, 155, d), len(corners)))
        turn[corners] = sharp * np.where(rng.random(len(corners)) < 0.8, sign, -sign)
    return turn


def _with_hairpins(turn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the turns (G,) reduced to 30 %, with one or two random hairpins [rad]."""
    turn = 0.3 * turn
    first = rng.integers(0, GATE_COUNT - 1)
    second = first + rng.integers(3, 5)
    corners = [first, second] if second < GATE_COUNT - 1 else [first]
    turn[corners] = rng.choice([-1.0, 1.0]) * np.deg2rad(rng.uniform(140, 180, len(corners)))
    return turn


def _candidates(d: float, rng: np.random.Generator, turn: np.ndarray) -> Walks:
    """Draw candidate walks with the mean turns (G,) [rad]."""
    shape = (_WALKS, GATE_COUNT)
    drift = rng.uniform(-np.pi, np.pi) + np.cumsum(turn) - turn
    deviation = rng.uniform(-1, 1, shape) * np.deg2rad(rng.uniform(0, ramp(15, 50, d)))
    heading = drift + deviation
    spacing = rng.uniform(3.3, 6.0) + rng.uniform(-1, 1, shape) * rng.uniform(0, ramp(0.5, 2, d))
    spacing = np.clip(spacing, MIN_SPACING_M, MAX_SPACING_M)
    spacing[:, 0] = rng.uniform(2, 4, _WALKS)
    step = spacing[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    point = np.cumsum(step, axis=1)
    yaw = drift + turn / 2 + rng.uniform(-1, 1, shape) * MAX_YAW_NOISE * d
    return Walks(point - point[:, :1], yaw, -point[:, 0])


def is_free(walks: Walks, max_approach: float = MAX_APPROACH) -> np.ndarray:
    """Return which walks are free, (W,) bool.

    On a free walk, every stretch keeps its distance from the gates that are not its ends, and
    passes its two gates in their flight directions.
    """
    point = np.concatenate([walks.start[:, None], walks.center], axis=1)
    step = np.diff(point, axis=1)
    normal = np.stack([np.cos(walks.yaw), np.sin(walks.yaw)], axis=-1)
    length = np.linalg.norm(step, axis=-1)
    least = np.cos(max_approach) * length
    approaches = np.all(np.sum(step * normal, -1) > least, axis=1)
    leaves = np.all(np.sum(step[:, 1:] * normal[:, :-1], -1) > least[:, 1:], axis=1)

    distance = segment_distance(walks.center[:, None], point[:, :-1, None], point[:, 1:, None])
    stretch, gate = np.arange(GATE_COUNT)[:, None], np.arange(GATE_COUNT)
    joined = (gate == stretch) | (gate == stretch - 1)
    avoids_others = np.all((distance > PASSING_M) | joined, axis=(1, 2))
    return approaches & leaves & avoids_others
