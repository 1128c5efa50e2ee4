"""The families' layouts, gates and obstacles; random tracks cover them and can be flown."""

from collections.abc import Iterable
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from tracks.families import FAMILIES, JUDGED, LEVELS, MAX_COUNTS, make_track, random, random_track
from tracks.families.random import Mix, Walks, is_free
from tracks.formats.meshes import solid_meshes
from tracks.geometry.obstacles import segment_distance
from tracks.geometry.scene import counts
from tracks.track import Track, first_gates


def arrays(track: Track) -> list[np.ndarray]:
    parts = [a for part in track.scene for a in (part if isinstance(part, tuple) else (part,))]
    return [*parts, track.start_pos_w, np.array([track.start_yaw, track.difficulty])]


@cache
def tracks_of(family: str, levels: Iterable[int] = LEVELS, seeds: Iterable[int] = range(12)):
    return [make_track(family, level, seed) for level in levels for seed in seeds]


GOLDEN = {
    ("zigzag", 0, 0): -28.07574721,
    ("zigzag", 9, 7): -1.76599018,
    ("circular", 3, 1): -6.85258334,
    ("circular", 9, 4): -17.67413879,
    ("circular", 6, 0): 6.26893128,
    ("ellipse", 6, 2): 39.92945288,
    ("ellipse", 9, 3): -49.71468475,
    ("ellipse", 0, 1): -28.03818328,
    ("ellipse", 9, 0): 41.47585967,
    ("random", 1, 5): -46.53382366,
    ("random", 9, 8): 18.36345052,
}


def test_tracks_never_change():
    for name, expected in GOLDEN.items():
        flat = np.concatenate([a.ravel() for a in arrays(make_track(*name))])
        assert flat @ np.cos(np.arange(flat.size)) == pytest.approx(expected, abs=1e-7), name


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
        ahead = (gates.center_w[0] - track.start_pos_w)[:2]
        facing = [np.cos(track.start_yaw), np.sin(track.start_yaw)]
        assert np.allclose(facing, ahead / np.linalg.norm(ahead))


@pytest.mark.parametrize(
    ("level", "seed", "said"),
    [
        (10, 0, "level is 10.*0 to 9"),
        (-1, 0, "level is -1"),
        (1.5, 0, "level is 1.5"),
        (1, -3, "seed is -3"),
        (1, 0.5, "seed is 0.5"),
    ],
)
def test_what_no_track_can_be_made_of_is_refused(level, seed, said):
    with pytest.raises(ValueError, match=f"(?i){said}"):
        make_track("zigzag", level, seed)


def test_random_tracks_take_a_difficulty_and_advance_the_generator():
    rng = np.random.default_rng(3)
    first, second = random_track(0.4, rng), random_track(0.4, rng)
    assert (first.family, first.level, first.difficulty) == ("random", 4, 0.4)
    assert not np.array_equal(first.scene.gates.center_w, second.scene.gates.center_w)
    with pytest.raises(ValueError, match="difficulty is 1.5"):
        random_track(1.5, rng)


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


@pytest.mark.parametrize("family", JUDGED)
def test_gate_sizes_heights_and_frames(family):
    widest = 0.22 if family == "ellipse" else 0.25
    for track in tracks_of(family):
        d, gates = track.difficulty, track.scene.gates
        side = np.ptp(gates.opening_g, axis=1)
        assert np.allclose(side[:, 0], side[:, 1])
        assert np.all(np.abs(side - (1.2 - 0.4 * d)) <= 0.05 + 1e-12)
        assert np.all((gates.frame_width >= 0.15) & (gates.frame_width <= widest))
        assert np.allclose(gates.frame_depth, 0.03 + 0.03 * d)
        assert np.all((gates.center_w[:, 2] >= 0.8) & (gates.center_w[:, 2] <= 2.0))
        assert np.allclose(gates.rot_w[:, 2, 2], 1)


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


@pytest.mark.parametrize("family", FAMILIES)
def test_every_gate_can_be_reached_by_a_body_of_20_cm(family):
    """Connected free cells lead to it from the gate before."""
    step = body = 0.2
    track = make_track(family, 9, 4)
    gates = track.scene.gates
    normal = gates.rot_w[:, :, 0]
    leave = np.concatenate([track.start_pos_w[None], gates.center_w[:-1] + 0.6 * normal[:-1]])
    reach = gates.center_w - 0.6 * normal
    low = np.minimum(leave, reach).min(0) - 4
    low[2] = 0.3
    high = np.maximum(leave, reach).max(0) + 4
    high[2] = 4.0
    axes = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    free = np.ones(grid.shape[:3], bool)
    for _, mesh in solid_meshes(track):
        # All solids are convex: outside of any face plane, pushed out by the body, is outside.
        box = [
            slice(max(int((lo - a[0]) / step) - 2, 0), int((hi - a[0]) / step) + 3)
            for lo, hi, a in zip(*mesh.bounds, axes, strict=True)
        ]
        part = grid[tuple(box)]
        normals, corner = mesh.face_normals, mesh.triangles[:, 0]
        height = part @ normals.T - np.sum(normals * corner, axis=-1)
        if height.size:
            free[tuple(box)] &= height.max(-1) > body
    labels = np.zeros(free.shape, np.int32)
    ndimage.label(free, output=labels)

    begun, ended = (labels[tuple(np.round((p - low) / step).astype(int).T)] for p in (leave, reach))
    assert (begun == ended).all() and ended.all()


@pytest.mark.parametrize("family", FAMILIES)
def test_gates_and_start_are_free_of_obstacles(family):
    for level, seed in ((0, 1), (5, 2), (9, 3), (9, 6)):
        track = make_track(family, level, seed)
        if len(track.names) == 32:
            continue
        gates = track.scene.gates
        meshes = [mesh for _, mesh in solid_meshes(track)[32:]]
        points = np.concatenate([part for m in meshes for part in (m.vertices, m.triangles_center)])
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


@pytest.mark.parametrize("count", [1, 4, 8])
def test_the_first_gates_of_a_track(count):
    track = make_track("random", 7, 3)
    short = first_gates(track, count)
    for field, whole in zip(short.scene.gates, track.scene.gates, strict=True):
        np.testing.assert_array_equal(field, whole[:count])
    have, had = counts(short.scene), counts(track.scene)
    assert had.boxes - have.boxes == 4 * (8 - count) and have[1:] == had[1:]
    boxes, kept = track.scene.boxes.center_w, np.r_[: 4 * count, 32 : had.boxes]
    np.testing.assert_array_equal(short.scene.boxes.center_w, boxes[kept])
    assert short.names == (*track.names[: 4 * count], *track.names[32:])
    assert len(short.names) == sum(have) and "gate 0 frame" in short.names[0]
    for none_or_more in (0, 9):
        with pytest.raises(ValueError, match=f"{none_or_more} gates of a track that has 8"):
            first_gates(track, none_or_more)


def test_a_family_that_returns_no_layout_or_fails_is_refused_by_name(monkeypatch):
    cases = (("hole", lambda d, rng: None, "returns NoneType, must return a Layout"),
             ("one", lambda d: 1 // 0, "fails with TypeError: .*d = 0.0"))  # fmt: skip
    for name, make, said in cases:
        monkeypatch.setitem(FAMILIES._entries, name, make)
        with pytest.raises(ValueError, match=f"track family '{name}' {said}"):
            make_track(name, 0, 0)
    with pytest.raises(ValueError, match="Did you mean .zigzag.*comes with its package"):
        make_track("zigzak", 0, 0)


@pytest.fixture(scope="module")
def tracks():
    rng = np.random.default_rng(5)
    return [random_track(d, rng) for d in np.linspace(0, 1, 400)]


def shape_numbers(track):
    """Return (turns at gates 0 to 6, spacing, yaw against the way in) of a track."""
    gates = track.scene.gates
    point = np.concatenate([track.start_pos_w[None], gates.center_w])[:, :2]
    way = np.diff(point, axis=0)
    heading = np.arctan2(way[:, 1], way[:, 0])
    normal = gates.rot_w[:, :2, 0]
    approach = np.sum(normal * way, -1) / np.linalg.norm(way, axis=-1)
    turn = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    return turn, np.linalg.norm(way[1:], axis=-1), approach


def test_no_stretch_runs_through_another_gates_frame(tracks):
    share = np.linspace(0, 1, 30)[:, None]
    for track in tracks[::12]:
        gates = track.scene.gates
        point = np.concatenate([track.start_pos_w[None], gates.center_w])[:, :2]
        for k, (begin, end) in enumerate(zip(point, point[1:], strict=False)):
            others = np.delete(point[1:], [max(k - 1, 0), k], axis=0)
            way = begin + share * (end - begin)
            assert np.linalg.norm(way[:, None] - others, axis=-1).min() > 1.5


def test_a_track_through_its_own_gate_is_not_free():
    track = make_track("circular", 0, 3)
    gates = track.scene.gates
    center, normal = gates.center_w[:, :2], gates.rot_w[:, :2, 0]
    crossed = center.copy()
    crossed[3] = (center[6] + center[7]) / 2
    yaw, start = np.arctan2(normal[:, 1], normal[:, 0]), track.start_pos_w[:2]
    walks = Walks(np.stack([center, crossed]), np.stack([yaw, yaw]), np.stack([start, start]))
    assert is_free(walks).tolist() == [True, False]


def test_sizes_and_spacings_stay_in_their_ranges(tracks):
    for track in tracks:
        gates = track.scene.gates
        turn, spacing, approach = shape_numbers(track)
        side = np.ptp(gates.opening_g, axis=1)
        assert np.all((side > 0.75 - 1e-9) & (side < 1.3 + 1e-9))
        assert np.all((spacing > 2.5 - 1e-9) & (spacing < 7 + 1e-9))
        assert np.all(approach > np.cos(np.deg2rad(95)))
        assert np.all(gates.center_w[:, 2] - side[:, 1] / 2 - gates.frame_width > -1e-9)
        assert np.all((gates.center_w[:, 2] >= 0.8) & (gates.center_w[:, 2] <= 2.2))
        assert 2 <= np.linalg.norm(track.start_pos_w[:2] - gates.center_w[0, :2]) <= 4


def test_lines_circles_of_both_directions_and_u_turns_all_occur(tracks):
    totals = np.array([shape_numbers(t)[0].sum() for t in tracks])
    sharpest = np.array([np.abs(shape_numbers(t)[0]).max() for t in tracks])
    steady = np.array([np.ptp(shape_numbers(t)[0]) for t in tracks])
    quarter = np.deg2rad(45) * 7
    circles = steady < np.deg2rad(70)
    assert np.mean(np.abs(totals) < np.deg2rad(60)) > 0.15
    assert np.mean(circles & (totals > 0.7 * quarter)) > 0.03
    assert np.mean(circles & (totals < -0.7 * quarter)) > 0.03
    assert np.mean(sharpest > np.deg2rad(110)) > 0.1
    headings = [np.arctan2(*t.scene.gates.rot_w[0, 1::-1, 0]) for t in tracks]
    assert np.ptp(headings) > 6


def test_density_runs_from_none_to_beyond_level_9(tracks):
    hardest = max(len(make_track("zigzag", 9, seed).names) - 60 for seed in range(5))
    numbers = np.array([len(t.names) - 32 for t in tracks])
    assert np.mean(numbers == 0) > 0.1
    in_air = [sum("ground" not in n for n in t.names[32:]) for t in tracks]
    assert max(in_air) > 49 > hardest - 30
    easy, hard = numbers[:100], numbers[-100:]
    assert hard.mean() > 1.4 * easy.mean()


def test_dense_tracks_are_as_dense_at_the_end_as_at_the_start():
    """What is too much for a scene is left out anywhere."""
    rng, mix = np.random.default_rng(4), Mix(density=(1.5, 1.5), bare_share=0.0)
    by_stretch = np.zeros(7)
    for _ in range(60):
        track = random_track(0.9, rng, mix)
        gates, scene = track.scene.gates.center_w, track.scene
        middles = (gates[1:] + gates[:-1]) / 2
        for center in np.concatenate([solids.center_w for solids in scene[1:5]])[32:]:
            by_stretch[np.linalg.norm(middles - center, axis=1).argmin()] += 1
    assert by_stretch.sum() > 60 * 40
    assert by_stretch[-2:].mean() > 0.85 * by_stretch[:2].mean()


def test_obstacles_stand_in_the_way_where_they_are_to_be_near(monkeypatch):
    def share_in_line(beside_m):
        monkeypatch.setattr(random, "OFFSET_M", beside_m)
        rng, inside, total = np.random.default_rng(5), 0, 0
        for _ in range(40):
            track = random_track(0.5, rng, Mix(bare_share=0.0))
            centers = np.concatenate([solids.center_w for solids in track.scene[1:5]])[32:, :2]
            gates = track.scene.gates.center_w[:, :2]
            away = segment_distance(centers[:, None], gates[:-1], gates[1:]).min(axis=1)
            inside, total = inside + (away < 0.5).sum(), total + len(away)
        return inside / total

    assert share_in_line((0.8, 1.5)) > 2 * share_in_line((3.0, 4.0)) > 0


def steepest(track):
    """Return the largest angle between a stretch and the gate that it leads to [deg]."""
    return np.rad2deg(np.arccos(shape_numbers(track)[2])).max()


@pytest.mark.extended
def test_hairpins_are_met_as_steeply_as_the_hardest_ellipses_apexes():
    """Half of the hardest ellipses have a gate that is met from beyond its side."""
    ellipses = [steepest(make_track("ellipse", 9, seed)) for seed in range(150)]
    rng, mix = np.random.default_rng(2), Mix(hairpin_share=1.0)
    hairpins = [steepest(random_track(d, rng, mix)) for d in np.linspace(0.3, 1, 150)]
    plain = [steepest(random_track(d, rng)) for d in np.linspace(0.3, 1, 150)]
    beyond = [np.mean(np.array(angles) > 85) for angles in (ellipses, hairpins, plain)]
    assert beyond[0] > 0.45 and beyond[1] > 0.25 and beyond[2] < 0.1
    assert 100 < max(hairpins) <= 110.001 and max(plain) <= 95.001


def test_heights_lie_further_apart_where_they_are_to():
    usual, wide = (
        random_track(0.6, np.random.default_rng(3), Mix(height_spread=share)).scene.gates.center_w
        for share in (1.0, 2.0)
    )
    np.testing.assert_array_equal(usual[:, :2], wide[:, :2])
    free = (usual[:, 2] > 0.9) & (wide[:, 2] > 0.9) & (wide[:, 2] < 2.2)
    assert free.sum() > 3
    np.testing.assert_allclose(np.diff(wide[free, 2]), 2 * np.diff(usual[free, 2]))
