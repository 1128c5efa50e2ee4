"""Culling leaves out only what cannot be seen."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.support.scene_poses import POSES, batch, free_poses, model_of
from tracks.families import MAX_COUNTS, make_track
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.scene import Boxes, counts

CAMERA = Camera()
RAYS = pixel_rays_b(CAMERA)
render = jax.jit(depth_image, static_argnames=("range_m", "limits"))


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
