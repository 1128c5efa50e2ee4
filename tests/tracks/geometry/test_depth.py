"""Depth images against MuJoCo's rays; culling leaves out only what cannot be seen."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from tests.support.scene_poses import POSES, batch, by_mujoco, free_poses, model_of
from tracks.families import FAMILIES, MAX_COUNTS, make_track
from tracks.formats.custom import load_track
from tracks.geometry.camera import Camera, optical_axis_b, pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.gates import yaw_rotation
from tracks.geometry.scene import Boxes, counts, stack

CAMERA = Camera()
RAYS = pixel_rays_b(CAMERA)
render = jax.jit(depth_image, static_argnames=("range_m", "limits"))


def assert_same_but_at_silhouettes(depth, expected):
    """A ray that grazes an edge may fall on either side: at most one pixel in a thousand."""
    wrong = np.abs(depth - expected) > 1e-3 + 1e-3 * expected
    assert wrong.mean() < 1e-3
    assert np.ptp(expected) > 3


@pytest.mark.parametrize("family", FAMILIES)
def test_depth_is_what_mujocos_rays_see(family):
    seen = set()
    for seed in (1, 2):
        track = make_track(family, 9, seed)
        model, data = model_of(track)
        pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(seed))
        expected, geoms = by_mujoco(model, data, pos_w, rot_w, RAYS, CAMERA.range_m)
        seen |= {int(model.geom_type[g]) for g in np.unique(geoms) if g >= 0}
        scene = batch(track, POSES, MAX_COUNTS)
        args = (jnp.asarray(pos_w), jnp.asarray(rot_w), jnp.asarray(RAYS))
        assert_same_but_at_silhouettes(render(scene, *args, CAMERA.range_m), expected)
    if family != "random":
        kinds = mujoco.mjtGeom
        assert seen >= {kinds.mjGEOM_PLANE, kinds.mjGEOM_BOX, kinds.mjGEOM_CYLINDER}
        assert seen >= {kinds.mjGEOM_CAPSULE, kinds.mjGEOM_SPHERE}


def test_meshes_and_polygonal_gates_are_seen_alike(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(0), 40)
    expected, geoms = by_mujoco(model, data, pos_w, rot_w, RAYS, CAMERA.range_m)
    meshes = [i for i in range(model.ngeom) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH]
    assert np.isin(geoms, meshes).mean() > 0.003
    args = (jnp.asarray(pos_w), jnp.asarray(rot_w), jnp.asarray(RAYS))
    assert_same_but_at_silhouettes(render(batch(track, 40), *args, CAMERA.range_m), expected)


def test_worlds_of_a_batch_do_not_mix():
    tracks = [make_track("zigzag", 9, 1), make_track("circular", 2, 5)]
    scene = jax.tree.map(jnp.asarray, stack([t.scene for t in tracks], MAX_COUNTS))
    pos_w = np.array([t.start_pos_w for t in tracks])
    rot_w = yaw_rotation(np.array([t.start_yaw for t in tracks]))
    args = (jnp.asarray(pos_w), jnp.asarray(rot_w), jnp.asarray(RAYS))
    depth = render(scene, *args, CAMERA.range_m)
    for i, track in enumerate(tracks):
        expected, _ = by_mujoco(
            *model_of(track), pos_w[i : i + 1], rot_w[i : i + 1], RAYS, CAMERA.range_m
        )
        assert_same_but_at_silhouettes(depth[i], expected[0])


def test_a_wall_ahead_has_the_same_planar_depth_in_every_pixel():
    track = make_track("zigzag", 0, 0)
    scene = batch(track, 1)
    wall = scene.boxes._replace(
        center_w=scene.boxes.center_w.at[0, 0].set(jnp.array([-7.0, 0.0, 50.0])),
        rot_w=scene.boxes.rot_w.at[0, 0].set(jnp.eye(3)),
        half_size=scene.boxes.half_size.at[0, 0].set(jnp.array([0.5, 60.0, 60.0])),
    )
    axis = optical_axis_b(CAMERA)
    level = np.array([[axis[0], 0, axis[2]], [0, 1, 0], [-axis[2], 0, axis[0]]])
    pos_w = jnp.array([[-11.5, 0.0, 50.0]])
    depth = render(
        scene._replace(boxes=wall), pos_w, jnp.asarray(level)[None], jnp.asarray(RAYS), 10.0
    )
    assert np.allclose(depth, 4.0, atol=1e-4)


def test_image_rows_run_from_the_sky_down_and_columns_from_left_to_right():
    rays = RAYS.reshape(CAMERA.height, CAMERA.width, 3)
    assert np.all(np.diff(rays[:, 0, 2]) < 0) and np.all(np.diff(rays[0, :, 1]) < 0)
    assert np.allclose(rays @ optical_axis_b(CAMERA), 1)
    half = np.rad2deg(np.arctan(rays[0, 0, 1] * CAMERA.width / (CAMERA.width - 1)))
    assert half == pytest.approx(78.4 / 2)


def test_culling_that_keeps_enough_changes_nothing():
    track = make_track("ellipse", 9, 3)
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(7))
    args = (jnp.asarray(pos_w), jnp.asarray(rot_w), jnp.asarray(RAYS))
    whole = render(batch(track, POSES), *args, CAMERA.range_m)
    have = counts(track.scene)
    some = have._replace(boxes=have.boxes - 12, cylinders=8, capsules=6, spheres=6)
    culled = render(batch(track, POSES), *args, CAMERA.range_m, limits=some)
    assert np.allclose(culled, whole, atol=1e-4)


def test_culling_keeps_what_only_reaches_into_view():
    """A long box whose middle is out of view is kept before a far one in the middle of it."""
    boxes = Boxes(
        jnp.array([[[3.0, 5.0, 50.0], [6.0, 0.0, 51.0], [8.0, -1.0, 52.0]]]),
        jnp.tile(jnp.eye(3), (1, 3, 1, 1)),
        jnp.array([[[0.1, 4.5, 0.3], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]]]),
    )
    scene = batch(make_track("zigzag", 0, 0), 1)._replace(boxes=boxes)
    args = (jnp.array([[0.0, 0.0, 50.0]]), jnp.eye(3)[None], jnp.asarray(RAYS), CAMERA.range_m)
    limits = MAX_COUNTS._replace(boxes=2)
    whole = render(scene, *args)
    culled = render(scene, *args, limits=limits)
    near = np.asarray(whole) < 7
    assert 20 < near.sum() < 400 and np.any((whole > 7) & (whole < 9))
    assert np.allclose(culled[near], whole[near], atol=1e-5)
    assert np.all(culled[~near] > 7)
