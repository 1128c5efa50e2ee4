"""The zigzag family's layout."""

from collections.abc import Sequence

import numpy as np

from tracks.families import LEVELS, make_track
from tracks.track import Track

SEEDS = range(12)


def tracks_of(
    family: str, levels: Sequence[int] = LEVELS, seeds: Sequence[int] = SEEDS
) -> list[Track]:
    return [make_track(family, level, seed) for level in levels for seed in seeds]


def yaw_of(track: Track) -> np.ndarray:
    normal = track.scene.gates.rot_w[:, :, 0]
    return np.arctan2(normal[:, 1], normal[:, 0])


def test_zigzag_is_a_line_of_35_m_that_strays():
    lateral_used = 0.0
    for track in tracks_of("zigzag"):
        d, t = track.difficulty, np.arange(8) / 7
        center = track.scene.gates.center_w
        assert np.all(np.abs(center[:, 0] - 5 * np.arange(8)) <= t + 1e-12)
        assert np.all(np.abs(center[:, 1]) <= (1 + 3 * d) * t + 1e-12)
        assert np.all(np.abs(center[:, 2] - 1.4) <= (0.1 + 0.9 * d) * t + 1e-12)
        assert np.all(np.abs(yaw_of(track)) <= np.deg2rad(30) * d)
        lateral_used = max(lateral_used, np.max(np.abs(center[1:, 1]) / ((1 + 3 * d) * t[1:])))
        back = center[0] - track.start_pos_w
        assert 2 <= back[0] <= 3 and np.allclose(back[1:], 0)
    assert lateral_used > 0.95
