"""Obstacles are scattered off the line, in the sizes and numbers of the baseline."""

from collections.abc import Sequence

import numpy as np
import pytest

from tracks.families import FAMILIES, JUDGED, LEVELS, make_track
from tracks.track import Track

SEEDS = range(12)


def tracks_of(
    family: str, levels: Sequence[int] = LEVELS, seeds: Sequence[int] = SEEDS
) -> list[Track]:
    return [make_track(family, level, seed) for level in levels for seed in seeds]


def obstacle_numbers(track: Track) -> dict[str, int]:
    kinds = {"plate": 0, "small": 0, "pillar": 0, "ground": 0}
    for name in track.names[32:]:
        kinds[name.split()[0]] += 1
    return kinds


def test_things_on_the_ground_lie_or_stand_on_it():
    seen = {"cylinder": 0, "capsule": 0}
    for track in tracks_of("circular", [9]):
        scene = track.scene
        rods = [*zip(*scene.cylinders, strict=True), *zip(*scene.capsules, strict=True)]
        first = len(scene.boxes.center_w)
        for name, (center, axis, radius, half) in zip(track.names[first:], rods, strict=False):
            if name.startswith("ground cylinder"):
                assert np.allclose(axis, [0, 0, 1]) and center[2] == half
                seen["cylinder"] += 1
            elif name.startswith("ground capsule"):
                assert abs(axis[2]) < 1e-9 and center[2] == radius
                seen["capsule"] += 1
    assert min(seen.values()) > 5


@pytest.mark.parametrize("family", JUDGED)
def test_obstacle_numbers_follow_the_difficulty(family):
    lost = 0
    for track in tracks_of(family):
        d, have = track.difficulty, obstacle_numbers(track)
        if family == "circular":
            # The radius is not stored: 5 to 8 m, so counts are 5/8 of the full ones or more.
            assert 7 * int((1 + 3 * d) * 5 / 8) - 2 <= have["plate"] <= 7 * int(1 + 3 * d)
            assert have["ground"] <= 28
            continue
        assert have["plate"] <= 7 * int(1 + 3 * d) and have["small"] <= 7 * int(1 + 3 * d)
        assert have["pillar"] <= 7 and have["ground"] <= 28
        lost += 14 * int(1 + 3 * d) + 7 - have["plate"] - have["small"] - have["pillar"]
    assert lost <= 3


def test_every_kind_of_obstacle_has_its_sizes():
    seen = set()
    for track in tracks_of("zigzag"):
        scene = track.scene
        solids = [
            *(("box", *s) for s in zip(*scene.boxes, strict=True)),
            *(("cylinder", *s) for s in zip(*scene.cylinders, strict=True)),
            *(("capsule", *s) for s in zip(*scene.capsules, strict=True)),
            *(("sphere", *s) for s in zip(*scene.spheres, strict=True)),
        ]
        for name, (kind, center, *shape) in list(zip(track.names, solids, strict=True))[32:]:
            what = name.split()[0]
            seen.add((what, kind))
            if what == "plate":
                half = shape[1]
                assert 0.2 <= half[0] == half[1] <= 0.5 and 0.02 <= half[2] <= 0.04
                assert 0.5 <= center[2] <= 3
            elif what == "pillar":
                half, radius = (shape[1][2], shape[1][0]) if kind == "box" else (shape[2], shape[1])
                assert 0.5 <= half <= 1.5 and radius <= 0.5 and center[2] == half
            elif kind == "box":
                assert np.all((shape[1] >= 0.05) & (shape[1] <= 0.25))
                assert what == "small" or center[2] == shape[1][2]
            else:
                radius = shape[0] if kind == "sphere" else shape[1]
                assert 0.1 <= radius <= 0.3
            if what == "small":
                assert 0.5 <= center[2] <= 3
    assert seen == {
        *(("small", kind) for kind in ("box", "cylinder", "capsule", "sphere")),
        *(("ground", kind) for kind in ("box", "cylinder", "capsule", "sphere")),
        ("plate", "box"),
        ("pillar", "box"),
        ("pillar", "cylinder"),
    }


def surface_points(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Return points on every obstacle and which solid each belongs to, drawn independently."""
    from tracks.formats.meshes import solid_meshes

    points, owner = [], []
    for i, (_, mesh) in enumerate(solid_meshes(track)[32:]):
        points.append(np.concatenate([mesh.vertices, mesh.triangles_center]))
        owner.append(np.full(len(points[-1]), i))
    return np.concatenate(points), np.concatenate(owner)


@pytest.mark.parametrize("family", FAMILIES)
def test_gates_and_start_are_free_of_obstacles(family):
    for level, seed in ((0, 1), (5, 2), (9, 3), (9, 6)):
        track = make_track(family, level, seed)
        if len(track.names) == 32:
            continue
        gates, (points, _) = track.scene.gates, surface_points(track)
        for center, rot in zip(gates.center_w, gates.rot_w, strict=True):
            local = (points - center) @ rot
            near = np.abs(local[:, 0]) < 1.5
            assert np.all(np.hypot(local[near, 1], local[near, 2]) > 0.39)
        way = gates.center_w[0] - track.start_pos_w
        share = np.clip((points - track.start_pos_w) @ way / (way @ way), 0, 1)
        gap = points - track.start_pos_w - share[:, None] * way
        assert np.linalg.norm(gap, axis=-1).min() > 0.5


@pytest.mark.parametrize("family", FAMILIES)
def test_obstacles_keep_their_distance_from_all_gates(family):
    nearest = np.inf
    for track in tracks_of(family):
        scene = track.scene
        solids = (scene.cylinders, scene.capsules, scene.spheres)
        center = np.concatenate([scene.boxes.center_w[32:], *(kind.center_w for kind in solids)])
        gap = center[:, None, :2] - scene.gates.center_w[None, :, :2]
        nearest = min(nearest, np.linalg.norm(gap, axis=-1).min(initial=np.inf))
    assert 1.5 <= nearest < 1.6
