"""The camera's rays, and scenes padded to a common size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tracks.families import make_track
from tracks.geometry.camera import Camera, cast_rays_b, nearest, optical_axis_b, pixel_rays_b
from tracks.geometry.gates import frame_boxes, rectangle, regular_polygon, yaw_rotation
from tracks.geometry.rotation import cross, exp_rot, quat_to_rot, rot_to_quat, to_local, to_world
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
