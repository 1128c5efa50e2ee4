"""The policy network: CNN + GRU (Su et al. 2026, Sec. III-E; stem after Zhang et al. 2025).

The encoded inverse depth is max-pooled by 2 (near things win) before three convolutions; the
state's embedding is added to the image's; a GRU (torch's gate convention) and a linear layer give
the wanted net acceleration in body axes. Parameters are a flat dict of float32 arrays.
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
    """Return how many features leave the last convolution, flattened height x width x channel."""
    rows, columns = spec.camera.height // 4 - 4, spec.camera.width // 4 - 4
    return rows * columns * spec.channels[2]


def init(key: jax.Array, spec: PolicySpec) -> Params:
    """Return fresh parameters: torch's uniform defaults, the state branch x 0.5.

    Zhang et al. 2025 scale the output by 0.01 as well. Then the first gradient steps, which all ask
    for the same climb, grow what comes before it until the memory saturates, and some seeds take a
    thousand iterations to come back.
    """
    return _drawn(key, spec)


@jax.jit(static_argnames="spec")
def _drawn(key: jax.Array, spec: PolicySpec) -> Params:
    hidden, (first, second, third) = spec.hidden_size, spec.channels
    fan = {
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
    drawn = uniform(key, {name: shape for name, (shape, _) in fan.items()})
    params = {name: (2 * drawn[name] - 1) * fan_in**-0.5 for name, (_, fan_in) in fan.items()}
    params["state.weight"] *= 0.5
    return params


def fitted(params: Params, seen: PolicySpec, spec: PolicySpec) -> Params:
    """Return parameters of a policy that sees `seen` as parameters for `spec`.

    Numbers that `spec` adds to the state get weights of zero, so the policy acts as it did. At
    another rate its memory keeps its pace in seconds: the update gate's bias grows by the logarithm
    of the rates' ratio, which is exact for what is remembered over many decisions.

    Raises:
        ValueError: where the policy sees what `spec` does not have, or they differ in all but that.
    """
    for entry in dataclasses.fields(spec):
        has, wanted = getattr(seen, entry.name), getattr(spec, entry.name)
        if entry.name == "camera":  # rays change the pixels' values, but not their number
            has = dataclasses.replace(has, rays=wanted.rays)
        if has != wanted and entry.name not in (*EXTRAS, "speed", "rate_hz"):
            raise ValueError(
                f"the policy to start from has spec.{entry.name} {has}, and this run {wanted}; "
                "train from nothing, or with the policy's own"
            )
    rows, first = [params["state.weight"][: spec.base_size]], spec.base_size
    for key, count in EXTRAS.items():
        has, wanted = getattr(seen, key), getattr(spec, key)
        if has and not wanted:
            raise ValueError(f"the policy to start from has spec.{key}; set spec.{key}=True")
        if has:
            rows.append(params["state.weight"][first : first + count])
            first += count
        elif wanted:
            rows.append(jnp.zeros((count, rows[0].shape[1])))
    keeps = slice(spec.hidden_size, 2 * spec.hidden_size)
    bias = params["gru.bias_input"].at[keeps].add(math.log(spec.rate_hz / seen.rate_hz))
    return {**params, "state.weight": jnp.concatenate(rows), "gru.bias_input": bias}


def encode(params: Params, image: jax.Array) -> jax.Array:
    """Return the embeddings of encoded images: (N, height, width) to (N, hidden)."""
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
    """Return (action_b (N, 3) [m/s^2], hidden' (N, hidden)) from an image's embedding and state."""
    x = leaky_relu(embedding + state @ params["state.weight"] + params["state.bias"])
    gates_x = x @ params["gru.weight_input"] + params["gru.bias_input"]
    gates_h = hidden @ params["gru.weight_hidden"] + params["gru.bias_hidden"]
    hidden = gru_update(gates_x, gates_h, hidden)
    return leaky_relu(hidden) @ params["action.weight"], hidden


def step(
    params: Params, hidden: jax.Array, state: jax.Array, image: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return (action_b (N, 3) [m/s^2], hidden' (N, hidden)) from one observation.

    Args:
        params: from `init` or a checkpoint.
        hidden: (N, hidden) recurrent state, zero at the start of a trial.
        state: (N, spec.state_size) the state of `observation.observe`.
        image: (N, height, width) its image.
    """
    return recur(params, hidden, encode(params, image), state)
