"""A convolution whose gradient is matrix products.

XLA's CPU convolution gradients are slow, so the weight gradient is taken on explicit patches and
the input gradient is a forward convolution with the flipped kernel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_LAYOUT = ("NHWC", "HWIO", "NHWC")


def _convolve(x: jax.Array, kernel: jax.Array, padding: str | list[tuple[int, int]]) -> jax.Array:
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), padding, dimension_numbers=_LAYOUT)


def patches(x: jax.Array, rows: int, columns: int) -> jax.Array:
    """Return the valid windows of x (N, H, W, C): (N, H', W', rows * columns * C)."""
    height, width = x.shape[1] - rows + 1, x.shape[2] - columns + 1
    shifted = [x[:, i : i + height, j : j + width] for i in range(rows) for j in range(columns)]
    return jnp.concatenate(shifted, axis=-1)


@jax.custom_vjp
def conv_valid(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolve x (N, H, W, C) with kernel (h, w, C, D), stride 1, no padding."""
    return _convolve(x, kernel, "VALID")


def _forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return conv_valid(x, kernel), (x, kernel)


def _backward(
    saved: tuple[jax.Array, jax.Array], grad: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    rows, columns, inputs, outputs = kernel.shape
    windows = patches(x, rows, columns).reshape(-1, rows * columns * inputs)
    kernel_grad = (windows.T @ grad.reshape(-1, outputs)).reshape(kernel.shape)
    flipped = kernel[::-1, ::-1].transpose(0, 1, 3, 2)
    full = [(rows - 1, rows - 1), (columns - 1, columns - 1)]
    return _convolve(grad, flipped, full), kernel_grad


conv_valid.defvjp(_forward, _backward)
