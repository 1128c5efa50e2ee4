"""The policy network: CNN and GRU (Su et al. 2026, Sec. III-E; first layers as Zhang et al. 2025).

The encoded inverse depth is max-pooled by 2, so that near objects remain, and passes three
convolutions. The embedding of the state is added to that of the image. A GRU (with torch's gate
convention) and a linear layer compute the wanted net acceleration in body axes. Parameters are a
flat dict of float32 arrays.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from policies.networks.layers import conv_valid, gru_update, patch_product, uniform
from policies.spec import EXTRAS, PolicySpec

Params = dict[str, jax.Array]

LEAK = 0.05
"""Slope of the LeakyReLU for negative inputs."""


def leaky_relu(x: jax.Array) -> jax.Array:
    """Return max(x, LEAK x)."""
    return jnp.maximum(x, LEAK * x)


def flat_features(spec: PolicySpec) -> int:
    """Return the number of outputs of the last convolution: height x width x channels."""
    rows, columns = spec.camera.height // 4 - 4, spec.camera.width // 4 - 4
    return rows * columns * spec.channels[2]


@jax.jit(static_argnames="spec")
def init(key: jax.Array, spec: PolicySpec) -> Params:
    """Return random initial parameters: torch's uniform defaults, with the state's weights halved.

    Zhang et al. 2025 also scale the output by 0.01. Here this is left out. With it the first
    gradient steps, which all increase the thrust, grow the earlier layers until the memory
    saturates, and some seeds take a thousand iterations to recover.
    """
    hidden, (first, second, third) = spec.hidden_size, spec.channels
    # Name -> shape, and number of inputs of each output (fan-in), which sets the range of values.
    sizes = {
        "conv1.weight": ((2, 2, 1, first), 4),
        "conv2.weight": ((3, 3, first, second), 9 * first),
        "conv3.weight": ((3, 3, second, third), 9 * second),
        "image.weight": ((flat_features(spec), hidden), flat_features(spec)),
        "state.weight": ((spec.state_size, hidden), spec.state_size),
        "state.bias": ((hidden,), spec.state_size),
        "gru.weight_input": ((hidden, 3 * hidden), hidden),
        "gru.weight_hidden": ((hidden, 3 * hidden), hidden),
        "gru.bias_input": ((3 * hidden,), hidden),
        "gru.bias_hidden": ((3 * hidden,), hidden),
        "action.weight": ((hidden, spec.action.size), hidden),
    }
    numbers = uniform(key, {name: shape for name, (shape, _) in sizes.items()})
    params = {name: (2 * numbers[name] - 1) * fan_in**-0.5 for name, (_, fan_in) in sizes.items()}
    params["state.weight"] *= 0.5
    return params


def adapt_params(params: Params, old: PolicySpec, new: PolicySpec) -> Params:
    """Return the parameters of a policy with spec `old`, adapted to the spec `new`.

    Numbers that `new` adds to the state get weights of zero, so the actions do not change. At
    another rate the memory keeps its time constants in seconds. For this, the bias of the update
    gate is raised by the logarithm of the ratio of the rates, which is exact for a long memory.

    Raises:
        ValueError: where `new` lacks a part of the state, or the specs differ in anything but the
            state, the speed and the rate.
    """
    for entry in dataclasses.fields(new):
        before, after = getattr(old, entry.name), getattr(new, entry.name)
        if entry.name == "camera":  # rays change the pixels' values, but not their number
            before = dataclasses.replace(before, rays=after.rays)
        if before != after and entry.name not in (*EXTRAS, "speed", "rate_hz"):
            raise ValueError(
                f"the policy to start from has spec.{entry.name} {before}, and this run {after}; "
                "train with the value of the policy (its own --recipe), or without a start"
            )
    lacking = [f"spec.{key}=True" for key in EXTRAS if getattr(old, key) and not getattr(new, key)]
    if lacking:
        raise ValueError(
            f"the policy to start from has more inputs; give --set {' '.join(lacking)}, or its own "
            "--recipe with --finetune"
        )
    weights, next_row = [params["state.weight"][: new.base_size]], new.base_size
    for key, count in EXTRAS.items():
        before, after = getattr(old, key), getattr(new, key)
        if before:
            weights.append(params["state.weight"][next_row : next_row + count])
            next_row += count
        elif after:
            weights.append(jnp.zeros((count, weights[0].shape[1])))
    update_gate = slice(new.hidden_size, 2 * new.hidden_size)
    bias = params["gru.bias_input"].at[update_gate].add(math.log(new.rate_hz / old.rate_hz))
    return {**params, "state.weight": jnp.concatenate(weights), "gru.bias_input": bias}


def encode(params: Params, image: jax.Array) -> jax.Array:
    """Return the embeddings (N, hidden) of encoded images (N, height, width)."""
    n, height, width = image.shape
    pooled = image.reshape(n, height // 2, 2, width // 2, 2).max((2, 4))
    # The 2x2 convolution of stride 2 is a matrix product on patches that do not overlap.
    rows, columns = height // 4, width // 4
    patches = pooled.reshape(n, rows, 2, columns, 2).transpose(0, 1, 3, 2, 4)
    patches = patches.reshape(n, rows, columns, 4)
    x = leaky_relu(patch_product(patches, params["conv1.weight"].reshape(4, -1)))
    x = leaky_relu(conv_valid(x, params["conv2.weight"]))
    x = leaky_relu(conv_valid(x, params["conv3.weight"]))
    return x.reshape(n, -1) @ params["image.weight"]


def recur(
    params: Params, hidden: jax.Array, embedding: jax.Array, state: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the actions (N, 3) [m/s^2, body axes] and the new hidden states (N, hidden).

    Args:
        params: the network's parameters, from `init` or a checkpoint.
        hidden: (N, hidden) recurrent state.
        embedding: (N, hidden) embeddings of the images, from `encode`.
        state: (N, spec.state_size) the state of `observation.observe`.
    """
    x = leaky_relu(embedding + state @ params["state.weight"] + params["state.bias"])
    gates_x = x @ params["gru.weight_input"] + params["gru.bias_input"]
    gates_h = hidden @ params["gru.weight_hidden"] + params["gru.bias_hidden"]
    hidden = gru_update(gates_x, gates_h, hidden)
    return leaky_relu(hidden) @ params["action.weight"], hidden


def step(
    params: Params, hidden: jax.Array, state: jax.Array, image: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the actions (N, 3) [m/s^2, body axes] and the new hidden states for one observation.

    Args:
        params: the network's parameters, from `init` or a checkpoint.
        hidden: (N, hidden) recurrent state, zero at the start of a trial.
        state: (N, spec.state_size) the state of `observation.observe`.
        image: (N, height, width) the image of `observation.observe`.
    """
    return recur(params, hidden, encode(params, image), state)
