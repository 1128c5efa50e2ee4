"""The trainer's gradient: images outside the loop, in chunks, and few of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import network
from suite.train.gradient import encoder_gradient, sampled_encoder_gradient
from tests.support.canonical import NOISY, gradient_of
from tests.support.training import KEY, boxes_worlds, fresh_params, largest_difference, loss_of


whole_gradient = jax.jit(encoder_gradient)


@pytest.fixture(scope="module")
def two_pass():
    """Return (config, worlds, params, gradient, loss, records) of the trainer's own method."""
    worlds, params = boxes_worlds(NOISY), fresh_params()
    return NOISY, worlds, params, *gradient_of(NOISY)(params, worlds, KEY, None)


def test_images_outside_the_loop_give_the_gradient_of_the_plain_loop(two_pass):
    """The sums run in another order in float32: 1e-4 of each array's largest entry."""
    config, worlds, params, gradient, loss, _ = two_pass
    plain = jax.jit(jax.value_and_grad(loss_of(config, network.encode)))
    expected_loss, expected = plain(params, worlds, None, config.loss.field_gain)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)
    sizes = {k: float(np.abs(np.array(g)).max()) for k, g in expected.items()}
    assert min(sizes.values()) > 1e-7, sizes
    assert largest_difference(gradient, expected) < 1e-4


def test_the_encoders_gradient_does_not_depend_on_its_chunks(two_pass, monkeypatch):
    params = two_pass[2]
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.normal(size=(12, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(12, 8)), jnp.float32)
    inputs = params, images, cotangents
    whole = whole_gradient(*inputs)
    monkeypatch.setattr("suite.train.gradient.CHUNK", 5)
    in_chunks = jax.jit(lambda *inputs: encoder_gradient(*inputs))
    assert largest_difference(in_chunks(*inputs), whole) < 1e-5


def test_the_encoders_gradient_from_every_other_image_is_right_on_average(two_pass):
    params, rng = two_pass[2], np.random.default_rng(1)
    images = jnp.asarray(rng.normal(size=(6, 2, 20, 20)), jnp.float32)
    cotangents = jnp.asarray(rng.normal(size=(6, 2, 8)), jnp.float32)
    whole = whole_gradient(params, images.reshape(12, 20, 20), cotangents.reshape(12, 8))
    keys = {int(jax.random.randint(key, (), 0, 2)): key for key in jax.random.split(KEY, 8)}
    sampled = jax.jit(sampled_encoder_gradient, static_argnums=3)
    halves = [sampled(params, images, cotangents, 2, keys[k]) for k in (0, 1)]
    mean = jax.tree.map(lambda one, other: (one + other) / 2, *halves)
    assert largest_difference(mean, whole) < 1e-5
