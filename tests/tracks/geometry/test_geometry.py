"""Cameras, padded scenes, gates and rotations; crossings; the field against a line integral."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from scipy.spatial.transform import Rotation

from tracks.families import make_track
from tracks.geometry.camera import Camera, cast_rays_b, nearest, optical_axis_b, pixel_rays_b
from tracks.geometry.crossing import crossing, is_inside, is_near
from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.gates import frame_boxes, rectangle, regular_polygon
from tracks.geometry.rotation import (
    cross,
    exp_rot,
    quat_to_rot,
    rot_to_quat,
    to_local,
    to_world,
    yaw_rotation,
)
from tracks.geometry.scene import PARKED_Z, Gates, counts, pad, stack


def test_rays_fill_the_field_of_view_and_measure_depth_along_the_axis():
    camera = Camera(pitch_deg=20.0, fov_deg=(90.0, 60.0), width=8, height=6)
    rays = pixel_rays_b(camera).reshape(6, 8, 3)
    np.testing.assert_allclose(rays @ optical_axis_b(camera), 1.0, atol=1e-12)
    # The outermost pixel's centre is half a pixel inside the edge.
    assert rays[0, 0, 1] == pytest.approx(np.tan(np.pi / 4) * 7 / 8)
    assert rays[0, 0, 2] > rays[-1, 0, 2], "the first row looks up"
    assert rays[0, 0, 1] > rays[0, -1, 1], "the first column looks left"


def test_several_rays_a_pixel_share_it_evenly_and_the_nearest_counts():
    camera = Camera(fov_deg=(90.0, 60.0), width=8, height=6, rays=3)
    np.testing.assert_array_equal(cast_rays_b(Camera()), pixel_rays_b(Camera()))
    rays = cast_rays_b(camera)
    parts = rays.reshape(9, 6 * 8, 3)
    np.testing.assert_allclose(parts.mean(0), pixel_rays_b(camera), atol=1e-12)
    finer = pixel_rays_b(Camera(fov_deg=(90.0, 60.0), width=24, height=18)).reshape(18, 24, 3)
    # The last part of the pixel in row 1, column 2 is the finer image's row 5, column 8.
    np.testing.assert_allclose(rays.reshape(9, 6, 8, 3)[8, 1, 2], finer[5, 8], atol=1e-12)

    depth_m = np.full((2, 9 * 6 * 8), 10.0)
    depth_m[1, 4 * 48 + 1 * 8 + 2] = 3.0
    image = nearest(camera, depth_m)
    assert image.shape == (2, 6, 8) and image[1, 1, 2] == 3.0
    assert (image < 10.0).sum() == 1


def test_padding_is_out_of_reach_and_keeps_what_is_there():
    scene = make_track("ellipse", 9, 1).scene
    have = counts(scene)
    more = have._replace(boxes=have.boxes + 3, spheres=have.spheres + 2, triangles=1)
    padded = pad(scene, more)
    assert counts(padded) == more
    np.testing.assert_array_equal(padded.boxes.center_w[: have.boxes], scene.boxes.center_w)
    assert (padded.boxes.center_w[have.boxes :, 2] == PARKED_Z).all()
    assert (padded.triangles[..., 2] <= PARKED_Z).all()
    with pytest.raises(ValueError, match=f"scene has {have.boxes} boxes, more than the 1"):
        pad(scene, have._replace(boxes=1))
    both = stack([scene, make_track("zigzag", 0, 1).scene], more)
    assert both.boxes.center_w.shape == (2, have.boxes + 3, 3) and both.gates.center_w.shape[0] == 2
    assert both.boxes.center_w.dtype == np.float32


IRREGULAR = np.array([[-0.7, -0.4], [0.6, -0.5], [0.5, 0.5], [-0.2, 0.6]])
"""An opening whose corners all turn by other angles."""


def inside_boxes(boxes, point_w):
    local = np.einsum("nij,pni->pnj", boxes.rot_w, point_w[:, None] - boxes.center_w)
    return np.any(np.all(np.abs(local) <= boxes.half_size, axis=-1), axis=-1)


def one_gate(opening):
    rot_w = yaw_rotation(np.array([0.7]))
    size = np.array([0.2]), np.array([0.06])
    return Gates(np.array([[1.0, 2.0, 1.5]]), rot_w, opening[None], *size)


OPENINGS = {
    "rectangle": rectangle(1.2, 0.8),
    "hexagon": regular_polygon(6, 0.5),
    "round": regular_polygon(16, 0.6),
    "triangle": regular_polygon(3, 0.4),
    "irregular": IRREGULAR,
}


@pytest.mark.parametrize("opening", OPENINGS.values(), ids=OPENINGS)
def test_the_frame_surrounds_the_opening_and_nothing_else(opening):
    gates = one_gate(opening)
    boxes = frame_boxes(gates)
    assert len(boxes.center_w) == len(opening)
    rng = np.random.default_rng(0)
    point = rng.uniform(-1.6, 1.6, (20000, 2))
    side = np.roll(opening, -1, axis=0) - opening
    outward = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1)[:, None]
    beyond = np.max(np.sum((point[:, None] - opening) * outward, -1), axis=-1)
    # The rim, exactly: distance to the polygon's boundary within the width.
    share = np.clip(np.sum((point[:, None] - opening) * side, -1) / np.sum(side * side, -1), 0, 1)
    gap = np.linalg.norm(point[:, None] - opening - share[..., None] * side, axis=-1).min(-1)
    point_w = gates.center_w[0] + np.column_stack([0 * gap, point]) @ gates.rot_w[0].T
    solid = inside_boxes(boxes, point_w)
    assert not solid[beyond < -1e-9].any()
    assert solid[(beyond > 1e-9) & (gap < 0.2 - 1e-9)].all()
    assert not solid[gap > 0.2 * np.sqrt(2) + 1e-9].any()
    off = point_w + 0.0301 * gates.rot_w[0, :, 0]
    assert not inside_boxes(boxes, off).any()


def test_openings_are_counter_clockwise_and_round_ones_keep_their_clear_radius():
    for opening in (rectangle(1.0, 0.5), regular_polygon(12, 0.6)):
        after = np.roll(opening, -1, axis=0)
        assert np.all(opening[:, 0] * after[:, 1] - opening[:, 1] * after[:, 0] > 0)
    round_one = regular_polygon(12, 0.6)
    middle = (round_one + np.roll(round_one, -1, axis=0)) / 2
    assert np.allclose(np.linalg.norm(middle, axis=-1), 0.6)
    corner = regular_polygon(5, 0.5)
    np.testing.assert_allclose(corner[:2, 1], -0.5, atol=1e-12)
    assert corner[1, 0] == pytest.approx(-corner[0, 0]) and corner[1, 0] > 0


VECTORS = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


@given(VECTORS)
def test_rotations_against_scipy(vector):
    for turn in (vector, 1e-5 * vector, np.pi * np.eye(3)[np.abs(vector).argmax()]):
        expected = Rotation.from_rotvec(turn)
        rot = exp_rot(turn)
        np.testing.assert_allclose(rot, expected.as_matrix(), atol=1e-12)
        quat = expected.as_quat(canonical=True, scalar_first=True)
        np.testing.assert_allclose(quat_to_rot(quat), rot, atol=1e-12)
        found = rot_to_quat(expected.as_matrix())
        assert abs(found @ quat) == pytest.approx(1.0) and found[0] >= 0.0


def test_small_rotations_are_exact():
    tiny = np.array([3e-5, -2e-5, 1e-5])
    np.testing.assert_allclose(exp_rot(tiny), Rotation.from_rotvec(tiny).as_matrix(), atol=1e-16)


@given(VECTORS, VECTORS, VECTORS)
def test_vectors_are_turned_and_turned_back(turn, vector, other):
    rot = Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(to_world(rot, vector), rot @ vector, atol=1e-12)
    np.testing.assert_allclose(to_local(rot, vector), rot.T @ vector, atol=1e-12)
    np.testing.assert_allclose(cross(vector, other), np.cross(vector, other), atol=1e-12)


SQUARE = rectangle(1.0, 1.0)
seeds = st.integers(0, 10_000)


def draw(seed, n=200):
    """Return a random gate pose, opening and n steps around it, in the gate's frame and outside."""
    rng = np.random.default_rng(seed)
    opening = (SQUARE, rectangle(1.3, 0.6), regular_polygon(7, 0.5))[seed % 3]
    rot_w = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    center_w = rng.normal(size=3) * 20
    before_g, after_g = rng.uniform(-1, 1, (2, n, 3))
    return center_w, rot_w, opening, before_g, after_g


def placed(center_w, rot_w, point_g):
    return center_w + point_g @ rot_w.T


@given(seeds)
def test_a_crossing_is_what_it_looks_like_in_the_gates_frame(seed):
    center_w, rot_w, opening, before, after = draw(seed)
    ends = (placed(center_w, rot_w, point) for point in (before, after))
    passed, missed = crossing(center_w, rot_w, opening, *ends)
    forward = (before[:, 0] < 0) & (after[:, 0] > 0)
    share = before[:, :1] / (before[:, :1] - after[:, :1])
    hit = (before + share * (after - before))[:, 1:]
    inside = Polygon(opening).contains_points(hit)
    assert np.array_equal(passed, forward & inside)
    assert np.array_equal(missed, forward & ~inside)
    assert passed.any() and missed.any()


@given(seeds, st.integers(2, 40))
def test_a_straight_flight_crosses_once_however_it_is_cut(seed, parts):
    center_w, rot_w, opening, before, after = draw(seed, 20)
    # Points exactly on the plane are among the cuts for some.
    before[::2, 0], after[::2, 0] = -0.5, 0.5
    share = np.linspace(0, 1, 2 * parts + 1)[:, None, None]
    path = before + share * (after - before)
    passed, missed = crossing(np.zeros(3), np.eye(3), opening, path[:-1], path[1:])
    whole = crossing(np.zeros(3), np.eye(3), opening, before, after)
    crosses = (before[:, 0] < 0) & (after[:, 0] > 0)
    assert np.array_equal(np.sum(np.logical_or(passed, missed), axis=0), crosses.astype(int))
    assert np.array_equal(passed.any(0), whole[0])


def test_repeated_corners_change_nothing():
    padded = np.concatenate([SQUARE, SQUARE[-1:], SQUARE[-1:]])
    point = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    assert np.array_equal(is_inside(padded, point), is_inside(SQUARE, point))
    assert is_inside(padded, np.zeros(2)) and not is_inside(padded, np.array([0.0, 0.51]))


def test_both_libraries_agree():
    center_w, rot_w, opening, before, after = draw(4, 12)
    steps = (placed(center_w, rot_w, point) for point in (before, after))
    given = (center_w, rot_w, opening, *steps)
    np.testing.assert_array_equal(jax.jit(crossing)(*given), crossing(*given))


@pytest.mark.parametrize(("distance", "near"), [(0.34, True), (0.36, False)])
def test_the_radius_rule_is_a_ball_of_35_cm(distance, near):
    direction = np.array([2.0, -1.0, 2.0]) / 3
    assert is_near(np.ones(3), np.ones(3) + distance * direction) == near


UPRIGHT = (np.zeros(3), np.eye(3))


def by_line_integral(center_w, rot_w, opening, point_w, current=2e-5, pieces=2000):
    """Biot and Savart, C * integral of dl x r / |r|^3 along the rim, by the midpoint rule."""
    corner = center_w + np.column_stack([np.zeros(len(opening)), opening]) @ rot_w.T
    share = ((np.arange(pieces) + 0.5) / pieces)[:, None]
    total = np.zeros_like(point_w)
    for begin, end in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        away = point_w[:, None] - (begin + share * (end - begin))
        cubed = np.linalg.norm(away, axis=-1, keepdims=True) ** 3
        total += (np.cross((end - begin) / pieces, away) / cubed).sum(1)
    return current * total


def away_from_rim(opening, point, least=0.1):
    side = np.roll(opening, -1, axis=0) - opening
    corner = np.column_stack([np.zeros(len(opening)), opening])
    side = np.column_stack([np.zeros(len(side)), side])
    share = np.sum((point[:, None] - corner) * side, -1) / np.sum(side**2, -1)
    gap = point[:, None] - corner - np.clip(share, 0, 1)[..., None] * side
    return np.linalg.norm(gap, axis=-1).min(-1) > least


@pytest.mark.parametrize(
    "opening", [SQUARE, rectangle(1.3, 0.7), regular_polygon(3, 0.4), regular_polygon(12, 0.5)]
)
def test_the_field_is_the_line_integral(opening):
    rng = np.random.default_rng(len(opening))
    point_g = rng.uniform(-2, 2, (60, 3))
    point_g = point_g[away_from_rim(opening, point_g)]
    rot_w, center_w = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    point_w = center_w + point_g @ rot_w.T
    field = magnetic_field(center_w, rot_w, opening, point_w)
    expected = by_line_integral(center_w, rot_w, opening, point_w)
    assert np.allclose(field, expected, rtol=1e-4, atol=1e-9)


def test_strengths_on_the_axis_of_a_1_m_gate():
    axis = np.array([[x, 0.0, 0.0] for x in (0, 1, 2, 3, 5)])
    field = magnetic_field(*UPRIGHT, SQUARE, axis)
    strength = np.linalg.norm(field, axis=-1) ** 0.7
    assert np.allclose(strength, [2.8e-3, 6.2e-4, 1.8e-4, 8e-5, 2.8e-5], rtol=0.05)
    # A square loop's centre: 4 * (2 / sqrt 2) / half side.
    assert field[0, 0] == pytest.approx(2e-5 * 4 * np.sqrt(2) / 0.5, rel=1e-6)


def test_padding_corners_add_nothing_and_the_wire_is_safe_in_both_libraries():
    padded = np.concatenate([SQUARE, SQUARE[-1:], SQUARE[-1:]])
    point = np.random.default_rng(1).uniform(-2, 2, (6, 3))
    expected = magnetic_field(*UPRIGHT, SQUARE, point)
    assert np.allclose(magnetic_field(*UPRIGHT, padded, point), expected, rtol=1e-9, atol=0)
    on_wire = np.array([[0, 0.5, 0], [0, 0.5, 0.5], [0, 0.1, -0.5], [0, 0.5, 3.0]])
    points = np.concatenate([point, on_wire])
    assert np.isfinite(magnetic_field(*UPRIGHT, padded, points)).all()
    by_jax = np.asarray(jax.jit(magnetic_field)(*UPRIGHT, padded, points))
    assert np.allclose(by_jax[:6], expected, rtol=2e-3, atol=1e-8) and np.isfinite(by_jax).all()


def test_attraction_fades_with_alignment_and_keeps_the_fields_direction():
    field = magnetic_field(*UPRIGHT, SQUARE, np.array([-0.5, 0.2, 0.1]))
    unit, size = field / np.linalg.norm(field), np.linalg.norm(field)
    along = attractive_field(field, 1e4 * unit)
    against = attractive_field(field, -1e4 * unit)
    at_rest = attractive_field(field, np.zeros(3))
    assert np.linalg.norm(along) < 1e-3 * size**0.7
    assert np.allclose(against, 2 * size**0.7 * unit, rtol=1e-3)
    assert np.allclose(at_rest, size**0.7 * unit)
    aligned = 3 * size / (3 * size + 1e-5)
    assert np.allclose(attractive_field(field, 3 * unit), (1 - aligned) * size**0.7 * unit)
    assert np.all(attractive_field(np.zeros(3), np.ones(3)) == 0)
