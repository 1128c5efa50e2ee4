"""Compute the gradient of a rollout in two passes, because the image encoder costs the most time.

The image encoder is the part of the policy that turns an image into a vector, its embedding. A
rollout is a flight of all simulated drones of a batch. The first pass differentiates the rollout
with a frozen encoder. It adds a shift of zero to each embedding; the gradient with respect to this
shift is that with respect to the embedding. The second pass back-propagates these gradients, the
cotangents, through the encoder, for many images at once.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from policies.networks import delta_network, network
from suite.train.config import TrainConfig
from suite.train.rollout import StepRecord, make_rollout
from suite.train.worlds import Worlds

CHUNK = 320
"""Largest number of images encoded at a time in the second pass; they fit into the processor's
cache."""


def encoder_gradient(
    params: network.Params, images: jax.Array, cotangents: jax.Array
) -> network.Params:
    """Return the encoder's gradient summed over all images, in chunks.

    Args:
        params: the policy's parameters.
        images: (N, height, width) encoded images, inverse depths.
        cotangents: (N, hidden) gradient of the loss with respect to the embeddings.
    """
    count = images.shape[0]
    # The largest divisor of the number of images that is at most CHUNK.
    size = max(size for size in range(1, min(count, CHUNK) + 1) if count % size == 0)

    def add_chunk(
        total: network.Params, part: tuple[jax.Array, jax.Array]
    ) -> tuple[network.Params, None]:
        image, cotangent = part
        _, encoder_vjp = jax.vjp(lambda p: network.encode(p, image), params)
        return jax.tree.map(jnp.add, total, encoder_vjp(cotangent)[0]), None

    zero = jax.tree.map(jnp.zeros_like, params)
    split = (
        images.reshape(-1, size, *images.shape[1:]),
        cotangents.reshape(-1, size, cotangents.shape[-1]),
    )
    return jax.lax.scan(add_chunk, zero, split)[0]


def sampled_encoder_gradient(
    params: network.Params, images: jax.Array, cotangents: jax.Array, stride: int, key: jax.Array
) -> network.Params:
    """Return the encoder's gradient from the images of every `stride`-th step, times `stride`.

    Neighbouring images are similar, so a sample of them saves most of the cost. The random first
    step and the factor `stride` make the expected gradient equal to that of all images.

    Args:
        params: the policy's parameters.
        images: (T, B, height, width) encoded images of all steps.
        cotangents: (T, B, hidden) gradient of the loss with respect to the embeddings.
        stride: a divisor of T.
        key: selects the first step.
    """
    first = jax.random.randint(key, (), 0, stride)

    def sampled(array: jax.Array) -> jax.Array:
        split = array.reshape(-1, stride, *array.shape[1:])
        chosen = jax.lax.dynamic_index_in_dim(split, first, axis=1, keepdims=False)
        return chosen.reshape(-1, *array.shape[2:])

    return encoder_gradient(params, sampled(images), sampled(stride * cotangents))


def make_gradient(
    config: TrainConfig,
) -> Callable[..., tuple[network.Params, jax.Array, StepRecord]]:
    """Return gradient(params, worlds, key, delta) -> (gradient, loss, records).

    It computes on one device. `delta` are the parameters of a Delta Action Model, a network that
    corrects the actions so that simulated flights match measured ones; None: no correction.
    `records` are the numbers of every step (`StepRecord`).
    """
    stride, steps = config.episode.image_stride, config.episode.steps
    rollout, width = make_rollout(config), config.spec.hidden_size

    def frozen_encode(params: network.Params, image: jax.Array) -> jax.Array:
        return jax.lax.stop_gradient(network.encode(params, image))

    def gradient(
        params: network.Params, worlds: Worlds, key: jax.Array, delta: delta_network.Params | None
    ) -> tuple[network.Params, jax.Array, StepRecord]:
        def rollout_loss(
            params: network.Params, embedding_shift: jax.Array
        ) -> tuple[jax.Array, StepRecord]:
            return rollout(params, embedding_shift, worlds, key, frozen_encode, delta)

        # First pass: gradients with respect to the parameters and to the embeddings.
        embedding_shift = jnp.zeros((steps, worlds.pos_w.shape[0], width))
        (loss, records), (direct, cotangents) = jax.value_and_grad(
            rollout_loss, argnums=(0, 1), has_aux=True
        )(params, embedding_shift)
        # Second pass: the gradient through the encoder.
        through_images = sampled_encoder_gradient(
            params, records.image, cotangents, stride, jax.random.fold_in(key, stride)
        )
        return jax.tree.map(jnp.add, direct, through_images), loss, records

    return gradient
