"""Depth images against MuJoCo's rays; culling leaves out only what cannot be seen."""

from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest

from tests.support.scene_poses import POSES, batch, by_mujoco, free_poses, model_of
from tracks.families import MAX_COUNTS, make_track
from tracks.formats.custom import load_track
from tracks.geometry.camera import Camera, optical_axis_b, pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.scene import Boxes, counts, stack

CAMERA = Camera()
RAYS = pixel_rays_b(CAMERA)
render = jax.jit(depth_image, static_argnames=("range_m", "limits"))


def assert_same_but_at_silhouettes(depth, expected):
    """A ray that grazes an edge may fall on either side: at most one pixel in a thousand."""
    wrong = np.abs(depth - expected) > 1e-3 + 1e-3 * expected
    assert wrong.mean() < 1e-3
    assert np.ptp(expected) > 3


def seen(scene, pos_w, rot_w, limits=None):
    return np.asarray(render(scene, pos_w, rot_w, RAYS, CAMERA.range_m, limits=limits))


@pytest.mark.parametrize("family", ["zigzag", "random"])
def test_depth_is_what_mujocos_rays_see_in_each_world_of_a_batch(family):
    tracks = [make_track(family, 9, seed) for seed in (1, 2)]
    poses, expected, kinds = [], [], set()
    for seed, track in enumerate(tracks):
        model, data = model_of(track)
        poses.append(free_poses(model, data, track, np.random.default_rng(seed)))
        depth, geoms = by_mujoco(model, data, *poses[-1], RAYS, CAMERA.range_m)
        expected.append(depth)
        kinds |= {mujoco.mjtGeom(model.geom_type[g]).name for g in np.unique(geoms) if g >= 0}
    scenes = stack([track.scene for track in tracks for _ in range(POSES)], MAX_COUNTS)
    pos_w, rot_w = (np.concatenate(parts) for parts in zip(*poses, strict=True))
    depth = seen(scenes, pos_w, rot_w)
    assert_same_but_at_silhouettes(depth, np.concatenate(expected))
    if family != "random":
        solids = ("PLANE", "BOX", "CYLINDER", "CAPSULE", "SPHERE")
        assert kinds >= {f"mjGEOM_{kind}" for kind in solids}


def test_meshes_and_polygonal_gates_are_seen_alike(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(0), 40)
    expected, geoms = by_mujoco(model, data, pos_w, rot_w, RAYS, CAMERA.range_m)
    meshes = [i for i in range(model.ngeom) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH]
    assert np.isin(geoms, meshes).mean() > 0.003
    assert_same_but_at_silhouettes(seen(batch(track, 40), pos_w, rot_w), expected)


def test_a_wall_ahead_has_the_same_planar_depth_in_every_pixel():
    scene = batch(make_track("zigzag", 0, 0), 2 * POSES, MAX_COUNTS)
    wall = Boxes(*(field.copy() for field in scene.boxes))
    wall.center_w[:, 0], wall.rot_w[:, 0] = [-7.0, 0.0, 50.0], np.eye(3)
    wall.half_size[:, 0] = [0.5, 60.0, 60.0]
    axis = optical_axis_b(CAMERA)
    level = np.array([[axis[0], 0, axis[2]], [0, 1, 0], [-axis[2], 0, axis[0]]])
    pos_w, rot_w = np.tile([-11.5, 0.0, 50.0], (2 * POSES, 1)), np.tile(level, (2 * POSES, 1, 1))
    assert np.allclose(seen(scene._replace(boxes=wall), pos_w, rot_w), 4.0, atol=1e-4)


def test_culling_that_keeps_enough_changes_nothing():
    track = make_track("ellipse", 9, 3)
    poses = free_poses(*model_of(track), track, np.random.default_rng(7), 2 * POSES)
    scene, have = batch(track, 2 * POSES, MAX_COUNTS), counts(track.scene)
    some = have._replace(boxes=have.boxes - 12, cylinders=8, capsules=6, spheres=6)
    # Two programs round differently, relative to the distance; a lost object is off by centimetres.
    culled, whole = seen(scene, *poses, limits=some), seen(scene, *poses)
    np.testing.assert_allclose(culled, whole, rtol=1e-4, atol=1e-4)


def test_culling_keeps_what_only_reaches_into_view():
    """A long box whose middle is out of view is kept before a far one in the middle of it."""
    boxes = Boxes(
        np.array([[3.0, 5.0, 50.0], [6.0, 0.0, 51.0], [8.0, -1.0, 52.0]]),
        np.tile(np.eye(3), (3, 1, 1)),
        np.array([[0.1, 4.5, 0.3], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]]),
    )
    track = make_track("zigzag", 0, 0)
    track = replace(track, scene=track.scene._replace(boxes=boxes))
    scene = batch(track, 2 * POSES, MAX_COUNTS)
    pose = np.tile([0.0, 0.0, 50.0], (2 * POSES, 1)), np.tile(np.eye(3), (2 * POSES, 1, 1))
    limits = MAX_COUNTS._replace(boxes=2)
    whole, culled = seen(scene, *pose)[0], seen(scene, *pose, limits=limits)[0]
    near = whole < 7
    assert 20 < near.sum() < 400 and np.any((whole > 7) & (whole < 9))
    assert np.allclose(culled[near], whole[near], atol=1e-5)
    assert np.all(culled[~near] > 7)
