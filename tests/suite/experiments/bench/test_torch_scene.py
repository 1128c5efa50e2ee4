"""The baseline's geometry in torch is that of `tracks.geometry`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from suite.experiments.bench import torch_scene
from suite.experiments.bench.torch_baseline import to_torch
from suite.experiments.bench.train import bench_config, bench_worlds
from tracks.geometry import clearance, crossing, depth, field
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.gates import yaw_rotation
from tracks.geometry.scene import Gates

CONFIG = bench_config(3, 2)
WORLDS = bench_worlds(CONFIG)
SCENE = to_torch(WORLDS.scene)
YAW = yaw_rotation(np.array([0.3, -1.0, 2.0])).astype(np.float32)
GATE = Gates(*(array[:, 0] for array in WORLDS.scene.gates))


def near(spread, seed=0):
    """Return points (B, 40, 3) around the start."""
    shift = np.random.default_rng(seed).normal(0, spread, (3, 40, 3))
    return (WORLDS.pos_w[:, None] + shift).astype(np.float32)


def test_images():
    rays, reach = pixel_rays_b(CONFIG.spec.camera).astype(np.float32), 10.0
    image = jax.jit(depth.depth_image)
    ours = image(WORLDS.scene, jnp.asarray(WORLDS.pos_w), YAW, rays, reach)
    pos_w, rot_w, rays_b = (torch.as_tensor(x) for x in (WORLDS.pos_w, YAW, rays))
    found = torch_scene.depth_image(SCENE, pos_w, rot_w, rays_b, reach)
    assert np.ptp(np.asarray(ours)) > 5.0
    # A ray along an edge may hit or miss by the last digit.
    assert np.mean(np.abs(found.numpy() - np.asarray(ours)) > 1e-3) < 0.002


def test_nearest_obstacles():
    points = near(2.0)
    nearest = jax.jit(clearance.nearest_obstacle)
    ours = [np.asarray(x) for x in nearest(WORLDS.scene, jnp.asarray(points))]
    found = [x.numpy() for x in torch_scene.nearest_obstacle(SCENE, torch.as_tensor(points))]
    np.testing.assert_allclose(found[0], ours[0], atol=1e-4)
    assert np.ptp(ours[0]) > 1.0
    assert np.mean(np.abs(found[1] - ours[1]).max(-1) > 1e-3) < 0.02


def test_the_field_of_a_gate():
    ours = field.magnetic_field(*GATE[:3], WORLDS.pos_w)
    found = torch_scene.magnetic_field(to_torch(GATE), torch.as_tensor(WORLDS.pos_w))
    np.testing.assert_allclose(found, ours, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(("side", "passes"), [(0.0, True), (3.0, False)])
def test_a_step_through_a_gate(side, passes):
    """Forwards through the opening only: not backwards, and not beside it."""
    ahead, left = GATE.rot_w[..., 0], GATE.rot_w[..., 1]
    before = GATE.center_w - 0.2 * ahead + side * left
    after = GATE.center_w + 0.3 * ahead + side * left
    gate = Gates(*(array.float() for array in to_torch(GATE)))
    points = [torch.as_tensor(x, dtype=torch.float32) for x in (before, after)]
    assert torch_scene.crossed(gate, *points).tolist() == [passes] * 3
    assert torch_scene.crossed(gate, *reversed(points)).tolist() == [False] * 3
    assert crossing.crossing(*GATE[:3], before, after)[0].tolist() == [passes] * 3
