"""The three track families on which policies are judged: zigzag, circular and ellipse.

Each is a function that draws a track of 8 gates with obstacles from a difficulty and a random
generator, after the baseline (Yu et al. 2025). A stretch is the part of a track between two
successive gates, along which obstacles are placed.
"""

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
    pick_first_gate,
    ramp,
)
from tracks.geometry.obstacles import straight_sites

SPACING_M = 5.0
"""Distance of neighbouring gates of zigzag and ellipse [m]."""
ZIGZAG_OFFSET_M, ELLIPSE_OFFSET_M = 3.6, 2.5
"""Largest distance of obstacles from the lines between gates, on zigzag and ellipse [m]."""
STEP = 2 * np.pi / GATE_COUNT
"""Angle between neighbouring gates of the circle [rad]."""
_CIRCLE_MARGIN_M, _ELLIPSE_MARGIN_M = 1.0, 1.5
"""Least distance of the start from the gate behind it, on the circle and on the ellipse [m]."""


def zigzag(d: float, rng: np.random.Generator) -> Layout:
    """Return a 35 m line of gates along world x, which starts above the origin.

    The gates' random deviations from the line grow along it.
    """
    t = np.arange(GATE_COUNT) / (GATE_COUNT - 1)
    max_deviation = t[:, None] * np.array([1.0, ramp(1, 4, d), ramp(0.1, 1, d)])
    center_w = max_deviation * rng.uniform(-1, 1, (GATE_COUNT, 3))
    center_w += np.array([0.0, 0.0, MID_HEIGHT_M])
    center_w[:, 0] += SPACING_M * np.arange(GATE_COUNT)
    gates = noisy_gates(rng, d, center_w, np.zeros(GATE_COUNT))
    start_pos_w = gates.center_w[0] - np.array([rng.uniform(2, 3), 0.0, 0.0])
    stretches = np.arange(GATE_COUNT - 1)
    per_stretch = counts_per_stretch(rng, d, len(stretches))
    site = straight_sites(gates, stretches, ZIGZAG_OFFSET_M)
    return furnish(rng, gates, start_pos_w, per_stretch, site)


def circular(d: float, rng: np.random.Generator) -> Layout:
    """Return a circle of 5 to 8 m radius around the origin, flown in either direction."""
    radius = rng.uniform(5, 8)
    turn = rng.choice([-1.0, 1.0])
    angle = turn * STEP * np.arange(GATE_COUNT)
    center_w = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(GATE_COUNT)], axis=-1)
    center_w[:, 2] = MID_HEIGHT_M
    center_w += ramp(0.2, 1, d) * rng.uniform(-1, 1, (GATE_COUNT, 3))
    gates = noisy_gates(rng, d, center_w, angle + turn * np.pi / 2)

    first = pick_first_gate(rng, gates.center_w, 2.0 + _CIRCLE_MARGIN_M)
    gates = flight_order(gates, first)
    back = gates.center_w[-1] - gates.center_w[0]
    length = float(np.linalg.norm(back))
    longest = min(4.0, length - _CIRCLE_MARGIN_M)
    distance = rng.uniform(min(2.0, longest), longest)
    start_pos_w = gates.center_w[0] + back * distance / length

    def site(rng: np.random.Generator, stretch: np.ndarray) -> np.ndarray:
        share = rng.random((2, len(stretch)))
        angle = turn * STEP * (first + stretch + share[0])
        distance = radius * (0.5 + share[1])
        return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    per_stretch = counts_per_stretch(rng, d, GATE_COUNT - 1, radius / 8)
    return furnish(rng, gates, start_pos_w, per_stretch, site)


def ellipse(d: float, rng: np.random.Generator) -> Layout:
    """Return an ellipse around the origin: two straights of 3 gates and a U-turn at either apex."""
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

    gates = flight_order(gates, pick_first_gate(rng, gates.center_w, 2.0 + _ELLIPSE_MARGIN_M))
    ahead = gates.center_w[0] - gates.center_w[-1]
    length = float(np.linalg.norm(ahead))
    longest = min(3.0, length - _ELLIPSE_MARGIN_M)
    distance = rng.uniform(min(2.0, longest), longest)
    start_pos_w = gates.center_w[-1] + ahead * distance / length

    stretches = np.arange(GATE_COUNT - 1)
    per_stretch = counts_per_stretch(rng, d, len(stretches))
    site = straight_sites(gates, stretches, ELLIPSE_OFFSET_M)
    return furnish(rng, gates, start_pos_w, per_stretch, site)
