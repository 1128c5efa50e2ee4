"""The ellipse family's layout."""

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


def test_ellipse_has_two_apexes_and_two_straights_flown_along_the_tangent():
    for track in tracks_of("ellipse"):
        d, gates = track.difficulty, track.scene.gates
        half_x, half_y = 2.5 * (3.14 + 1.66 * d), 2.5 * (1.41 - 0.61 * d)
        x = np.array([half_x, 5, 0, -5, -half_x, -5, 0, 5])
        y = half_y * np.sqrt(1 - (x / half_x) ** 2) * [0, 1, 1, 1, 0, -1, -1, -1]
        both_ways = [(np.stack([x, way * y], -1), way) for way in (1, -1)]
        fits = [(np.roll(xy, s, axis=0), way) for xy, way in both_ways for s in range(8)]
        error = [np.abs(xy - gates.center_w[:, :2]).max() for xy, _ in fits]
        assert min(error) <= 0.2 + 0.8 * d + 1e-9
        xy, way = fits[int(np.argmin(error))]
        tangent = np.arctan2(way * xy[:, 0] / half_x**2, -way * xy[:, 1] / half_y**2)
        off = (yaw_of(track) - tangent + np.pi) % (2 * np.pi) - np.pi
        assert np.all(np.abs(off) <= np.deg2rad(30) * d + 1e-9)
