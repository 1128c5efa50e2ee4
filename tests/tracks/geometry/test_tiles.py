"""Depth images by tiles against MuJoCo's rays, ray by ray and to rounding."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.scene_poses import POSES, by_mujoco, free_poses, model_of
from tracks.common.masks import take
from tracks.families import MAX_COUNTS, make_track
from tracks.geometry import tiles
from tracks.geometry.camera import Camera, cast_rays_b, nearest
from tracks.geometry.scene import Boxes, Rods, Spheres, counts, stack
from tracks.geometry.tiles import depth_images, make_tiles

SAME_M = 1e-9
"""Depths agree to this, but for rays that graze an edge [m]."""
GRAZING = 1e-4
"""Share of rays that may graze, and then fall on either side."""
FINE = Camera(rays=2)


def batched(track, n, to=None):
    return stack([track.scene] * n, counts(track.scene) if to is None else to, np.float64)


def seen(camera, track, pos_w, rot_w, to=None):
    return depth_images(make_tiles(camera), batched(track, len(pos_w), to), pos_w, rot_w)


def seen_by_mujoco(camera, model, data, pos_w, rot_w):
    depth, geoms = by_mujoco(model, data, pos_w, rot_w, cast_rays_b(camera), camera.range_m)
    return nearest(camera, depth), geoms


def assert_same(found, expected):
    assert found.shape == expected.shape
    assert (np.abs(found - expected) > SAME_M).mean() <= GRAZING
    assert np.ptp(expected) > 3


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        (("zigzag", 0, 3), FINE),
        (("zigzag", 9, 3), FINE),
        (("random", 9, 3), FINE),
        (("ellipse", 9, 3), Camera(width=7, height=5, rays=3, pitch_deg=-40.0)),
        (("circular", 9, 4), Camera(width=20, height=20, fov_deg=(150.0, 140.0), range_m=40.0)),
        (("circular", 9, 4), Camera(width=3, height=2, rays=8, range_m=4.0)),
    ],
)
def test_any_track_looks_to_any_camera_as_in_mujoco(name, camera):
    track = make_track(*name)
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(0), 2 * POSES)
    expected, _ = seen_by_mujoco(camera, model, data, pos_w, rot_w)
    assert_same(seen(camera, track, pos_w, rot_w, MAX_COUNTS), expected)


def crowd(kind, rng, n=40):
    """Return a track with n solids of one kind, of all shapes, and the ground."""
    track = make_track("zigzag", 0, 0)
    center_w = rng.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 4.0], (n, 3))
    rot_w = Rotation.random(n, rng).as_matrix()
    rot_w[: n // 4] = np.eye(3)  # rays that run along a side or an axis
    size = np.exp(rng.uniform(np.log(0.02), np.log(1.0), (n, 3)))
    rods = Rods(center_w, rot_w[:, :, 2], size[:, 0], size[:, 1])
    solids = {
        "boxes": Boxes(center_w, rot_w, size),
        "cylinders": rods,
        "capsules": rods,
        "spheres": Spheres(center_w, size[:, 0]),
    }
    none = track.scene._replace(
        **{name: take(getattr(track.scene, name), slice(0, 0)) for name in solids}
    )
    return dataclasses.replace(track, scene=none._replace(**{kind: solids[kind]}), names=())


@pytest.mark.parametrize("kind", ["boxes", "cylinders", "capsules", "spheres"])
def test_each_kind_of_solid_looks_as_in_mujoco(kind):
    rng = np.random.default_rng(7)
    track = crowd(kind, rng)
    model, data = model_of(track)
    yaw = rng.uniform(-np.pi, np.pi, 2 * POSES)
    yaw[:4] = np.arange(4) * np.pi / 2
    pos_w = np.stack([-7 * np.cos(yaw), -7 * np.sin(yaw), rng.uniform(0.5, 3.0, len(yaw))], -1)
    tilt = rng.uniform(-0.5, 0.5, (len(yaw), 2))
    tilt[:4] = 0.0
    rot_w = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    expected, geoms = seen_by_mujoco(FINE, model, data, pos_w, rot_w)
    assert ((geoms >= 0) & (geoms < model.ngeom - 1)).mean() > 0.05, "solids, not the ground"
    assert_same(seen(FINE, track, pos_w, rot_w), expected)


def test_an_image_is_its_cameras_alone(monkeypatch):
    """To the bit, whatever is beside it, however much is worked on at once, and any padding."""
    track, other = make_track("ellipse", 9, 1), make_track("ellipse", 4, 2)
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(5))
    together = seen(FINE, track, pos_w, rot_w, MAX_COUNTS)
    scene = stack([track.scene, other.scene] * POSES, MAX_COUNTS, np.float64)
    mixed = depth_images(make_tiles(FINE), scene, np.repeat(pos_w, 2, 0), np.repeat(rot_w, 2, 0))
    np.testing.assert_array_equal(mixed[::2], together)
    monkeypatch.setattr(tiles, "PAIRS_AT_ONCE", 37)
    monkeypatch.setattr(tiles, "RAYS_AT_ONCE", 10_000)
    for part in (slice(0, 1), slice(3, 8), slice(None, None, -1)):
        alone = seen(FINE, track, pos_w[part], rot_w[part])
        np.testing.assert_array_equal(alone, together[part])


def test_special_places_inside_a_solid_above_and_below_the_ground_and_none_at_all():
    track = crowd("spheres", np.random.default_rng(0), 1)
    center_w = track.scene.spheres.center_w
    level = np.eye(3)[None]
    assert (seen(FINE, track, center_w, level) == 0).all()
    assert (seen(FINE, track, np.array([[50.0, 0.0, -1.0]]), level) == FINE.range_m).all()
    ground = seen(FINE, track, np.array([[50.0, 0.0, 1.0]]), level)
    assert (ground[0, -1] < 4.0).all() and (ground[0, 0] == FINE.range_m).all()
    nothing = take((batched(track, 1), np.zeros((1, 3)), level), slice(0))
    assert depth_images(make_tiles(FINE), *nothing).shape == (0, 24, 32)
