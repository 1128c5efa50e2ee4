"""Ellipse: two straights of 3 gates and a U-turn at either apex (Yu et al. 2025)."""

from __future__ import annotations

import numpy as np

from tracks.families.layout import (
    GATE_COUNT,
    MID_HEIGHT_M,
    Layout,
    counts_per_stretch,
    flight_order,
    furnish,
    noisy_gates,
    pick_stretch,
    ramp,
)
from tracks.geometry.obstacles import straight_sites

SPACING_M = 5.0
OBSTACLE_OFFSET_M = 2.5
_ROOM_AHEAD_M = 1.5


def make(d: float, rng: np.random.Generator) -> Layout:
    """Return an elliptic track of difficulty `d` around the origin, its long axis along x."""
    half_x = SPACING_M * ramp(3.14, 4.8, d) / 2
    half_y = SPACING_M * ramp(1.41, 0.8, d) / 2
    x = np.array([half_x, SPACING_M, 0.0, -SPACING_M, -half_x, -SPACING_M, 0.0, SPACING_M])
    side = np.array([0.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0, -1.0])
    y = side * half_y * np.sqrt(1 - (x / half_x) ** 2)
    turn = rng.choice([-1.0, 1.0])
    center_w = np.stack([x, turn * y, np.full(GATE_COUNT, MID_HEIGHT_M)], axis=-1)
    heading = np.arctan2(turn * x * half_y / half_x, -y * half_x / half_y)
    center_w += ramp(0.2, 1, d) * rng.uniform(-1, 1, (GATE_COUNT, 3))
    gates = noisy_gates(rng, d, center_w, heading, max_frame_width_m=0.22)

    gates = flight_order(gates, pick_stretch(rng, gates.center_w, 2.0 + _ROOM_AHEAD_M))
    ahead = gates.center_w[0] - gates.center_w[-1]
    length = float(np.linalg.norm(ahead))
    most = min(3.0, length - _ROOM_AHEAD_M)
    past = rng.uniform(min(2.0, most), most)
    start_pos_w = gates.center_w[-1] + ahead * past / length

    stretches = np.arange(GATE_COUNT - 1)
    per_stretch = counts_per_stretch(rng, d, len(stretches))
    site = straight_sites(gates, stretches, OBSTACLE_OFFSET_M)
    return furnish(rng, gates, start_pos_w, per_stretch, site)
