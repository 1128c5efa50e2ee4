"""Circular: 8 gates on a circle of 5 to 8 m radius, flown either way (Yu et al. 2025)."""

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

STEP = 2 * np.pi / GATE_COUNT
_ROOM_BEHIND_M = 1.0


def make(d: float, rng: np.random.Generator) -> Layout:
    """Return a circular track of difficulty `d` around the origin."""
    radius = rng.uniform(5, 8)
    turn = rng.choice([-1.0, 1.0])
    angle = turn * STEP * np.arange(GATE_COUNT)
    center_w = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(GATE_COUNT)], axis=-1)
    center_w[:, 2] = MID_HEIGHT_M
    center_w += ramp(0.2, 1, d) * rng.uniform(-1, 1, (GATE_COUNT, 3))
    gates = noisy_gates(rng, d, center_w, angle + turn * np.pi / 2)

    first = pick_stretch(rng, gates.center_w, 2.0 + _ROOM_BEHIND_M)
    gates = flight_order(gates, first)
    back = gates.center_w[-1] - gates.center_w[0]
    length = float(np.linalg.norm(back))
    most = min(4.0, length - _ROOM_BEHIND_M)
    distance = rng.uniform(min(2.0, most), most)
    start_pos_w = gates.center_w[0] + back * distance / length

    def site(rng: np.random.Generator, stretch: np.ndarray) -> np.ndarray:
        share = rng.random((2, len(stretch)))
        at = turn * STEP * (first + stretch + share[0])
        reach = radius * (0.5 + share[1])
        return reach[:, None] * np.stack([np.cos(at), np.sin(at)], axis=-1)

    per_stretch = counts_per_stretch(rng, d, GATE_COUNT - 1, radius / 8)
    return furnish(rng, gates, start_pos_w, per_stretch, site)
