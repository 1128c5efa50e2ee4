"""Zigzag: a 35 m line of 8 gates, 5 m apart, with growing deviations (Yu et al. 2025)."""

from __future__ import annotations

import numpy as np

from tracks.families.layout import (
    GATE_COUNT,
    MID_HEIGHT_M,
    Layout,
    counts_per_stretch,
    furnish,
    noisy_gates,
    ramp,
)
from tracks.geometry.obstacles import straight_sites

SPACING_M = 5.0
OBSTACLE_OFFSET_M = 3.6


def make(d: float, rng: np.random.Generator) -> Layout:
    """Return a zigzag of difficulty `d` along world x, its first gate above the origin."""
    t = np.arange(GATE_COUNT) / (GATE_COUNT - 1)
    reach = t[:, None] * np.array([1.0, ramp(1, 4, d), ramp(0.1, 1, d)])
    center_w = reach * rng.uniform(-1, 1, (GATE_COUNT, 3))
    center_w += np.array([0.0, 0.0, MID_HEIGHT_M])
    center_w[:, 0] += SPACING_M * np.arange(GATE_COUNT)
    gates = noisy_gates(rng, d, center_w, np.zeros(GATE_COUNT))
    start_pos_w = gates.center_w[0] - np.array([rng.uniform(2, 3), 0.0, 0.0])
    stretches = np.arange(GATE_COUNT - 1)
    per_stretch = counts_per_stretch(rng, d, len(stretches))
    site = straight_sites(gates, stretches, OBSTACLE_OFFSET_M)
    return furnish(rng, gates, start_pos_w, per_stretch, site)
