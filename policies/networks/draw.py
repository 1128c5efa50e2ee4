"""Random numbers for fresh weights, drawn by one compiled program whatever their shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp


def uniform(key: jax.Array, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, jax.Array]:
    """Return numbers in [0, 1) by name, float32, each array from a key of its own.

    They are those of `jax.random.uniform(key, shape)`: JAX makes a number from its place alone, so
    a short array is the beginning of a long one. A program for each shape takes ten times as long
    to compile as one row of the longest does.
    """
    longest = max(math.prod(shape) for shape in shapes.values())
    rows = jax.vmap(lambda one: jax.random.uniform(one, (longest,), jnp.float32))(
        jax.random.split(key, len(shapes))
    )
    return {
        name: row[: math.prod(shape)].reshape(shape)
        for row, (name, shape) in zip(rows, shapes.items(), strict=True)
    }
