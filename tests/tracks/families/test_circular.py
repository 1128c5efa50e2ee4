"""The circular family's layout."""

from collections.abc import Sequence

import numpy as np
import pytest

from tracks.families import LEVELS, make_track
from tracks.track import Track

SEEDS = range(12)


def tracks_of(
    family: str, levels: Sequence[int] = LEVELS, seeds: Sequence[int] = SEEDS
) -> list[Track]:
    return [make_track(family, level, seed) for level in levels for seed in seeds]


def test_circular_keeps_to_its_circle_both_ways_round():
    ways = set()
    for track in tracks_of("circular"):
        d, gates = track.difficulty, track.scene.gates
        noise = 0.2 + 0.8 * d
        radius = np.hypot(*gates.center_w[:, :2].T)
        assert np.all(radius > 5 - noise * np.sqrt(2)) and np.all(radius < 8 + noise * np.sqrt(2))
        angle = np.unwrap(np.arctan2(gates.center_w[:, 1], gates.center_w[:, 0]))
        way = np.sign(angle[-1] - angle[0])
        assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi * 7 / 8, abs=0.8)
        ways.add(way)
        across = np.cross(gates.center_w, gates.rot_w[:, :, 0])[:, 2]
        assert np.all(np.sign(across) == way)
    assert ways == {-1.0, 1.0}
