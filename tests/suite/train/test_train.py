"""What the trainer leaves out of images and distances: next to nothing, and only what is far."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train.rollout import SEEN
from suite.train.step import NEAR
from tracks.families import FAMILIES, MAX_COUNTS, make_track
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.depth import depth_image
from tracks.geometry.gates import yaw_rotation
from tracks.geometry.scene import stack

RAYS = jnp.asarray(pixel_rays_b(Camera()), jnp.float32)
WORLDS = 40

image = jax.jit(partial(depth_image, range_m=10.0), static_argnames="limits")
nearest = jax.jit(nearest_obstacle, static_argnames="limits")


def flights(family):
    """Return scenes of all levels and poses on the way from gate to gate, looking ahead."""
    rng = np.random.default_rng(11)
    tracks = [make_track(family, i % 10, i) for i in range(WORLDS)]
    pos, yaw = [], []
    for track in tracks:
        center = track.scene.gates.center_w
        i = rng.integers(0, len(center) - 1)
        way = center[i + 1] - center[i]
        pos.append(center[i] + rng.uniform(0.05, 0.95) * way + rng.normal(0, 0.3, 3))
        yaw.append(np.arctan2(way[1], way[0]) + rng.normal(0, 0.4))
    pos = np.maximum(np.array(pos), [-np.inf, -np.inf, 0.3])
    scene = jax.tree.map(jnp.asarray, stack([t.scene for t in tracks], MAX_COUNTS))
    rot = yaw_rotation(np.array(yaw))
    return scene, jnp.asarray(pos, jnp.float32), jnp.asarray(rot, jnp.float32)


@pytest.mark.parametrize("family", FAMILIES)
def test_culled_images_are_whole_but_for_a_few_far_pixels(family):
    scene, pos, rot = flights(family)
    whole = np.array(image(scene, pos, rot, RAYS))
    culled = np.array(image(scene, pos, rot, RAYS, limits=SEEN))
    assert np.mean(whole < 9.9) > 0.2
    missing = np.abs(culled - whole) > 1e-3
    assert np.all(culled[missing] > whole[missing])
    assert missing.mean() < 2e-3
    assert not np.any(missing & (whole < 5.0))


@pytest.mark.parametrize("family", FAMILIES)
def test_culled_distances_are_exact_where_they_matter(family):
    """Within 1 m, where the loss of an obstacle starts."""
    scene, pos, _ = flights(family)
    step = jnp.asarray(np.random.default_rng(3).normal(0, 0.1, (WORLDS, 1, 3)), jnp.float32)
    path = pos[:, None] + jnp.linspace(0, 1, 4)[:, None] * step
    whole, away = (np.array(x) for x in nearest(scene, path))
    culled, culled_away = (np.array(x) for x in nearest(scene, path, limits=NEAR))
    near = whole < 1.15
    assert near.mean() > 0.3
    wrong = (np.abs(culled - whole) > 1e-4) | (np.abs(culled_away - away).max(-1) > 1e-3)
    assert wrong[near].mean() < 0.005
    assert np.abs(culled - whole).max() < 0.5
