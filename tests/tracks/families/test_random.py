"""The training distribution covers the judged families' shapes, and its tracks can be flown."""

import numpy as np
import pytest

from tracks.families import make_track, random, random_track
from tracks.families.random import Mix, is_free
from tracks.geometry.obstacles import segment_distance


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
    for track in tracks[::4]:
        gates = track.scene.gates
        point = np.concatenate([track.start_pos_w[None], gates.center_w])[:, :2]
        for k, (begin, end) in enumerate(zip(point, point[1:], strict=False)):
            others = np.delete(point[1:], [max(k - 1, 0), k], axis=0)
            way = begin + share * (end - begin)
            assert np.linalg.norm(way[:, None] - others, axis=-1).min() > 1.5
        assert is_free(gates, track.start_pos_w)


def test_a_track_through_its_own_gate_is_not_free():
    track = make_track("circular", 0, 3)
    gates = track.scene.gates
    center = gates.center_w.copy()
    center[3] = (center[6] + center[7]) / 2
    assert is_free(gates, track.start_pos_w)
    assert not is_free(gates._replace(center_w=center), track.start_pos_w)


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
