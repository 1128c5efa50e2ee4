"""The families have the numbers they promise, from (family, level, seed) alone."""

from collections.abc import Sequence

import numpy as np
import pytest

from tracks.families import FAMILIES, LEVELS, MAX_COUNTS, make_track, random_track
from tracks.geometry.scene import counts
from tracks.track import Track

SEEDS = range(12)


def arrays(track: Track) -> list[np.ndarray]:
    parts = [a for part in track.scene for a in (part if isinstance(part, tuple) else (part,))]
    return [*parts, track.start_pos_w, np.array([track.start_yaw, track.difficulty])]


def tracks_of(
    family: str, levels: Sequence[int] = LEVELS, seeds: Sequence[int] = SEEDS
) -> list[Track]:
    return [make_track(family, level, seed) for level in levels for seed in seeds]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_track_comes_from_its_name_alone(family):
    np.random.seed(1)  # noqa: NPY002 - the global state must not matter
    first = make_track(family, 4, 11)
    np.random.seed(2)  # noqa: NPY002
    again, other = make_track(family, 4, 11), make_track(family, 4, 12)
    assert all(np.array_equal(a, b) for a, b in zip(arrays(first), arrays(again), strict=True))
    assert first.names == again.names
    assert not np.array_equal(first.scene.gates.center_w, other.scene.gates.center_w)


GOLDEN = {
    ("zigzag", 0, 0): -28.07574721,
    ("zigzag", 9, 7): -1.76599018,
    ("circular", 3, 1): -6.85258334,
    ("ellipse", 6, 2): 39.92945288,
    ("random", 5, 3): 4.45124481,
}


@pytest.mark.parametrize(("family", "level", "seed"), GOLDEN)
def test_tracks_never_change(family, level, seed):
    track = make_track(family, level, seed)
    flat = np.concatenate([a.ravel() for a in arrays(track)])
    weighted = flat @ np.cos(np.arange(flat.size))
    assert weighted == pytest.approx(GOLDEN[family, level, seed], abs=1e-7)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_track_is_well_formed(family):
    for track in tracks_of(family):
        scene, gates = track.scene, track.scene.gates
        assert len(gates.center_w) == 8
        assert track.level / 10 <= track.difficulty < (track.level + 1) / 10
        assert all(have <= most for have, most in zip(counts(scene), MAX_COUNTS, strict=True))
        assert len(track.names) == sum(counts(scene))
        assert list(track.names[:32]) == [f"gate {i} frame" for i in range(8) for _ in range(4)]
        assert len(set(track.names)) == 8 + len(track.names) - 32
        assert all(np.isfinite(a).all() for a in arrays(track))
        eye = gates.rot_w @ np.swapaxes(gates.rot_w, 1, 2)
        assert np.allclose(eye, np.eye(3)) and np.allclose(np.linalg.det(gates.rot_w), 1)
        eye = scene.boxes.rot_w @ np.swapaxes(scene.boxes.rot_w, 1, 2)
        assert np.allclose(eye, np.eye(3), atol=1e-12)
        for rods in (scene.cylinders, scene.capsules):
            assert np.allclose(np.linalg.norm(rods.axis_w, axis=-1), 1)
        ahead = gates.center_w[0] - track.start_pos_w
        assert np.allclose(
            [np.cos(track.start_yaw), np.sin(track.start_yaw)],
            ahead[:2] / np.linalg.norm(ahead[:2]),
        )


def test_the_difficulty_is_anywhere_within_its_level():
    share = np.array([t.difficulty * 10 - t.level for t in tracks_of("zigzag")])
    assert share.min() < 0.1 and share.max() > 0.9 and abs(share.mean() - 0.5) < 0.1


def test_the_bound_on_solids_is_tight():
    most = np.max([counts(t.scene) for f in FAMILIES for t in tracks_of(f, [8, 9], range(60))], 0)
    assert most[0] == MAX_COUNTS.boxes
    assert np.all(np.array(MAX_COUNTS)[1:4] - most[1:4] <= 2)


def test_about_half_of_the_closed_tracks_are_reversed():
    for family in ("circular", "ellipse"):
        turns = []
        for track in tracks_of(family, [0], range(200)):
            x, y = track.scene.gates.center_w[:, :2].T
            turns.append(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0)
        assert 70 < sum(turns) < 130


@pytest.mark.parametrize(("family", "near", "far"), [("circular", 2, 4), ("ellipse", 2, 3)])
def test_the_closed_tracks_start_between_two_gates(family, near, far):
    firsts = set()
    for track in tracks_of(family):
        center, start = track.scene.gates.center_w, track.start_pos_w
        way = center[0] - center[-1]
        share = (start - center[-1]) @ way / (way @ way)
        assert np.allclose(center[-1] + share * way, start) and 0 < share < 1
        distance = np.linalg.norm(start - center[0 if family == "circular" else -1])
        assert near <= distance <= far
        assert np.linalg.norm(start - center[-1]) > 0.99
        firsts.add(round(np.arctan2(center[0, 1], center[0, 0]) / (np.pi / 4)) % 8)
    assert len(firsts) >= 6


@pytest.mark.parametrize(
    ("family", "level", "seed", "said"),
    [
        ("zigzak", 0, 0, "did you mean 'zigzag'"),
        ("zigzag", 10, 0, "level is 10.*0 to 9"),
        ("zigzag", -1, 0, "level is -1"),
        ("zigzag", 1.5, 0, "level is 1.5"),
        ("zigzag", 1, -3, "seed is -3"),
        ("zigzag", 1, 0.5, "seed is 0.5"),
    ],
)
def test_what_no_track_can_be_made_of_is_refused(family, level, seed, said):
    with pytest.raises(ValueError, match=f"(?i){said}"):
        make_track(family, level, seed)


def test_random_tracks_take_a_difficulty_and_advance_the_generator():
    rng = np.random.default_rng(3)
    first, second = random_track(0.4, rng), random_track(0.4, rng)
    assert (first.family, first.level, first.difficulty) == ("random", 4, 0.4)
    assert not np.array_equal(first.scene.gates.center_w, second.scene.gates.center_w)
    with pytest.raises(ValueError, match="difficulty is 1.5"):
        random_track(1.5, rng)
