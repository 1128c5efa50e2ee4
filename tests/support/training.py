"""A trainer small enough for tests: few worlds, few steps, a narrow network, gate frames only."""

from dataclasses import replace
from functools import cache
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from policies.formats.checkpoint import load_arrays
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import network
from policies.spec import PolicySpec
from suite.common import curve
from suite.train import shards, update
from suite.train.config import (
    EpisodeConfig,
    LossConfig,
    OptimizerConfig,
    PointMassConfig,
    TrainConfig,
)
from suite.train.rollout import make_rollout
from suite.train.worlds import Worlds, sample_worlds
from tracks.geometry.camera import Camera
from tracks.geometry.scene import Boxes, Gates, Rods, Scene, Spheres

SPEC = PolicySpec(camera=Camera(width=20, height=20), hidden_size=8)
KEY = jax.random.key(5)
SPREADS = ("mass_std", "lag_spread", "drag_spread", "delay_spread_s", "gain_spread")
ALIKE = {**dict.fromkeys(SPREADS, 0.0), "wind_std": (0.0, 0.0, 0.0)}
"""Settings of a quadrotor whose worlds all have the vehicle file's."""


def blind(params, image):
    """Return embeddings of nothing, for tests that are not about images."""
    return jnp.zeros((image.shape[0], SPEC.hidden_size))


def loss_of(config, encode=blind):
    """Return loss(params, worlds, delta, **weights) of the plain loop with `encode` inside."""

    def loss(params, worlds, delta=None, **weights):
        weighted = replace(config, loss=replace(config.loss, **weights))
        embedding_shift = jnp.zeros((config.episode.steps, worlds.pos_w.shape[0], SPEC.hidden_size))
        return make_rollout(weighted)(params, embedding_shift, worlds, KEY, encode, delta)[0]

    return loss


def assert_slopes(along, params, names, step, rel):
    """Compare slopes with central differences, in a random direction of each named parameter.

    `along(params, way)` returns the value and its slope in the direction `way`.
    """
    rng, still = np.random.default_rng(0), jax.tree.map(np.zeros_like, params)
    for name in names:
        way = {**still, name: rng.normal(size=params[name].shape)}
        ahead, behind = (
            along({**params, name: params[name] + h * way[name]}, way)[0] for h in (step, -step)
        )
        slope = float(ahead - behind) / (2 * step)
        assert abs(slope) > 1e-4, name
        found = float(along(params, way)[1])
        assert abs(found - slope) <= rel * abs(slope), f"{name}: {found} is not {slope}"


def small_config(batch=4, steps=6, physics=None, loss=None, optimizer=None, **episode):
    """Return a run of a second in which every world counts to the end, unless `stop_from` is given.

    `physics`, `loss` and `optimizer` are settings by name.
    """
    return TrainConfig(
        spec=SPEC,
        physics=PointMassConfig(**{"depth_noise": 0.0, **(physics or {})}),
        loss=LossConfig(**(loss or {})),
        episode=EpisodeConfig(
            **{"batch": batch, "steps": steps, "stop_from": 1.0, "shards": 1, **episode}
        ),
        optimizer=OptimizerConfig(**{"iterations": 6, "warmup": 1, **(optimizer or {})}),
    )


def boxes_only(scene: Scene) -> Scene:
    """Return a batched scene with its first two gates' frames alone, which compiles faster."""
    rods = Rods(*(array[:, :0] for array in scene.cylinders))
    spheres = Spheres(*(array[:, :0] for array in scene.spheres))
    boxes = Boxes(*(array[:, :8] for array in scene.boxes))
    return scene._replace(boxes=boxes, cylinders=rods, capsules=rods, spheres=spheres)


def boxes_worlds(config: TrainConfig, iteration: int = 0) -> Worlds:
    """Return the worlds of an iteration with the boxes of `boxes_only`."""
    worlds = sample_worlds(config, iteration)
    return worlds._replace(scene=boxes_only(worlds.scene))


def straight_worlds(worlds: Worlds, speed: float, wall_x: float = 50.0) -> Worlds:
    """Return two worlds as a straight flight along x at `speed`: gates at 2 m and 4 m, one wall.

    The wall stands across the second world's path, at `wall_x`.
    """
    scene = boxes_only(worlds.scene)
    x = np.array([2.0, 4.0])
    center = np.stack([x, 0 * x, 0 * x + 1.5], -1)
    square = 0.6 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    sizes = np.full((2, 2), 0.2)
    gates = Gates(
        np.broadcast_to(center, (2, 2, 3)),
        np.broadcast_to(np.eye(3), (2, 2, 3, 3)),
        np.broadcast_to(square, (2, 2, 4, 2)),
        sizes,
        sizes,
    )
    walls = np.full((2, 8, 3), 1e3)
    walls[1, 0] = [wall_x, 0, 1.5]
    boxes = Boxes(
        walls, np.broadcast_to(np.eye(3), (2, 8, 3, 3)), np.full((2, 8, 3), [0.1, 3.0, 3.0])
    )
    scene = scene._replace(gates=gates, boxes=boxes)
    scene = jax.tree.map(lambda array: np.asarray(array, np.float32), scene)
    row = np.ones((2, 1), np.float32)
    return worlds._replace(
        scene=scene,
        pos_w=row * np.array([0, 0, 1.5], np.float32),
        vel_w=row * np.array([speed, 0, 0], np.float32),
        heading_w=row * np.array([1, 0, 0], np.float32),
    )


def doubled(tree):
    """Return a tree whose float arrays are as long as JAX has them: float64 where that is on."""
    kind = jax.dtypes.canonicalize_dtype(float)

    def longer(x):
        return np.asarray(x, kind) if np.asarray(x).dtype.kind == "f" else x

    return jax.tree.map(longer, tree)


def fresh_params(spec: PolicySpec = SPEC, seed: int = 0, lively: float = 1.0):
    """Return fresh parameters with the last layer's weights so many times as large."""
    params = network.init(jax.random.key(seed), spec)
    params["action.weight"] *= lively
    return params


def largest_difference(tree, expected):
    """Return the largest difference of any array relative to the largest entry of its like."""
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True)
    return max(
        float(np.abs(np.asarray(a) - np.asarray(b)).max() / (np.abs(np.asarray(b)).max() + 1e-12))
        for a, b in pairs
    )


def assert_same_run(folder, other):
    """Compare state, curve and policy of two runs to the bit, but for the machine's speed."""
    for load in (
        lambda one: load_arrays(one / "state", kind="training").arrays,
        lambda one: load_policy_checkpoint(one / "policy").params,
    ):
        ours, theirs = load(folder), load(other)
        assert ours.keys() == theirs.keys()
        for name, value in theirs.items():
            np.testing.assert_array_equal(ours[name], value, err_msg=name)
    rows = curve.read(folder), curve.read(other)
    for row in (*rows[0], *rows[1]):
        assert all(row.pop(key) >= 0 for key in ("steps_per_s", "seconds", "cold"))
    assert rows[0] == rows[1]


NOISY = small_config(physics={"depth_noise": 0.02}, shards=2)
"""Four worlds in two shards, six steps, noise in the images: what most tests of the trainer fly."""


@cache
def gradient_of(config):
    """Return the compiled gradient(params, worlds, key, delta) with the encoder in the loop."""
    rollout = make_rollout(config)

    def loss_of(params, *given):
        shift = jnp.zeros((config.episode.steps, config.episode.batch, config.spec.hidden_size))
        return rollout(params, shift, *given[:2], network.encode, given[2])

    def gradient(*given):
        (loss, records), found = jax.value_and_grad(loss_of, has_aux=True)(*given)
        return found, loss, records

    return jax.default_matmul_precision("highest")(jax.jit(gradient))


@cache
def flown_of(config):
    """Return the compiled flight(params, worlds, key) -> (loss, records), without a gradient."""
    rollout, shape = make_rollout(config), (config.episode.steps, config.episode.batch)
    shift = np.zeros((*shape, config.spec.hidden_size), np.float32)
    return jax.jit(lambda params, *given: rollout(params, shift, *given, network.encode))


@cache
def shards_of(config):
    """Return the compiled shards of a configuration, for two cores."""
    with mock.patch.object(shards, "usable_cores", lambda: 2):
        return shards.make_shards(config)


@cache
def update_of(config):
    """Return the compiled update(state, worlds) of a configuration, as a run makes it."""
    made = shards_of(replace(config, optimizer=NOISY.optimizer))  # of any optimiser the same
    with mock.patch.object(update, "make_shards", lambda *_: made):
        return update.make_update(config)
