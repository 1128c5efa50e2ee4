"""Layers of the networks: convolutions with fast CPU gradients, the GRU, and initial weights.

On the CPU, XLA computes gradients of small convolutions at a tenth of the speed of its matrix
products, or less. So here the gradients are matrix products. A row of pixels with all its channels
is one vector, and a kernel row maps it to an output row by a banded matrix. Both gradients are then
products of matrices some hundreds wide. They take two to three times the arithmetic of the
convolution, but run many times as fast.

XLA divides the sums of a product of two long and narrow matrices among all threads. So the last
bits of the product would depend on the number of cores. `patch_product` divides the sums itself.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp

_LAYOUT = ("NHWC", "HWIO", "NHWC")
"""Order of axes of the image, the kernel and the result."""
PIECE = 8
"""Number of images in one product of `patch_product`'s gradient; XLA does not split so few among
threads."""


@jax.custom_vjp
def patch_product(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Return x (N, ..., C) @ weight (C, D); the number of cores does not change the gradient."""
    return x @ weight


def _patch_forward(
    x: jax.Array, weight: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return x @ weight, (x, weight)


def _patch_backward(
    saved: tuple[jax.Array, jax.Array], grad: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the gradients for x and weight; the latter is summed piece by piece."""
    x, weight = saved
    pieces = len(x) // max(size for size in range(1, PIECE + 1) if len(x) % size == 0)
    rows, grad_rows = (part.reshape(pieces, -1, part.shape[-1]) for part in (x, grad))
    return grad @ weight.T, jnp.einsum("prc,prd->pcd", rows, grad_rows).sum(0)


patch_product.defvjp(_patch_forward, _patch_backward)


@jax.custom_vjp
def conv_valid(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolve x (N, H, W, C) with kernel (h, w, C, D), stride 1, no padding."""
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "VALID", dimension_numbers=_LAYOUT)


def _as_rows(x: jax.Array) -> jax.Array:
    """Return images (N, H, W, C) as (H, N, W * C), so that a range of rows is contiguous memory."""
    return x.transpose(1, 0, 2, 3).reshape(x.shape[1], x.shape[0], -1)


def _banded(kernel_row: jax.Array, width: int) -> jax.Array:
    """Return the matrix (W * C, W' * D) by which a kernel row (w, C, D) maps an input row."""
    taps, inputs, outputs = kernel_row.shape
    places = width - taps + 1
    columns = [
        jnp.pad(kernel_row, ((place, places - 1 - place), (0, 0), (0, 0)))
        for place in range(places)
    ]
    return jnp.stack(columns, axis=2).reshape(width * inputs, places * outputs)


def _fold(banded: jax.Array, taps: int, inputs: int, outputs: int) -> jax.Array:
    """Return the gradient of a kernel row (w, C, D) from that of its banded matrix."""
    width = banded.shape[0] // inputs
    places = width - taps + 1
    split = banded.reshape(width, inputs, places, outputs)
    return functools.reduce(jnp.add, (split[k : k + taps, :, k] for k in range(places)))


def _forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return conv_valid(x, kernel), (x, kernel)


def _backward(saved: tuple[jax.Array, jax.Array], grad: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the gradients for the images and the kernel, one kernel row after another."""
    x, kernel = saved
    count, height, width, inputs = x.shape
    kernel_rows, taps, _, outputs = kernel.shape
    rows_out = height - kernel_rows + 1
    x_rows, grad_rows = _as_rows(x), _as_rows(grad)
    flat_grad = grad_rows.reshape(rows_out * count, -1)
    kernel_grad, x_grad = [], jnp.zeros_like(x_rows)
    for row in range(kernel_rows):
        inputs_of_row = x_rows[row : row + rows_out].reshape(rows_out * count, -1)
        kernel_grad.append(_fold(inputs_of_row.T @ flat_grad, taps, inputs, outputs))
        back = flat_grad @ _banded(kernel[row], width).T
        back = back.reshape(rows_out, count, -1)
        x_grad = x_grad + jnp.pad(back, ((row, kernel_rows - 1 - row), (0, 0), (0, 0)))
    x_grad = x_grad.reshape(height, count, width, inputs).transpose(1, 0, 2, 3)
    return x_grad, jnp.stack(kernel_grad)


conv_valid.defvjp(_forward, _backward)


def gru_update(from_input: jax.Array, from_hidden: jax.Array, hidden: jax.Array) -> jax.Array:
    """Return the next hidden state (..., H) of a GRU (Cho et al. 2014, in torch's convention).

    Args:
        from_input: (..., 3 H) the input's contribution to the gates reset, update and new.
        from_hidden: (..., 3 H) the hidden state's contribution to the same gates.
        hidden: (..., H) the hidden state.
    """
    reset_x, update_x, new_x = jnp.split(from_input, 3, axis=-1)
    reset_h, update_h, new_h = jnp.split(from_hidden, 3, axis=-1)
    reset = jax.nn.sigmoid(reset_x + reset_h)
    update = jax.nn.sigmoid(update_x + update_h)
    new = jnp.tanh(new_x + reset * new_h)
    return new + update * (hidden - new)


def uniform(key: jax.Array, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, jax.Array]:
    """Return random numbers in [0, 1) by name, float32, each array from its own key.

    They equal those of `jax.random.uniform(key, shape)`. In JAX a random number depends on the key
    and its index only, so a short array is the beginning of a long one. All arrays are therefore
    drawn with the length of the longest array, which compiles ten times as fast as a program for
    each shape.
    """
    longest = max(math.prod(shape) for shape in shapes.values())
    rows = jax.vmap(lambda row_key: jax.random.uniform(row_key, (longest,), jnp.float32))(
        jax.random.split(key, len(shapes))
    )
    return {
        name: row[: math.prod(shape)].reshape(shape)
        for row, (name, shape) in zip(rows, shapes.items(), strict=True)
    }
