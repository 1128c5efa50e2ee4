"""The convolutions whose gradients are matrix products, against JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks.layers import conv_valid, patch_product


def jax_own(x, kernel):
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@pytest.mark.parametrize(
    ("image", "kernel"),
    [((5, 6, 8, 3), (3, 3, 3, 4)), ((2, 4, 7, 2), (2, 3, 2, 5)), ((3, 3, 3, 1), (3, 3, 1, 2))],
)
def test_value_and_gradients_are_those_of_jaxs_convolution(image, kernel):
    """Integers within float32's exact range: no rounding, so no tolerance."""
    rng = np.random.default_rng(0)
    x, k = (jnp.asarray(rng.integers(-4, 5, s), jnp.float32) for s in (image, kernel))
    value, back = jax.vjp(conv_valid, x, k)
    expected, own_back = jax.vjp(jax_own, x, k)
    np.testing.assert_array_equal(value, expected)
    cotangent = jnp.asarray(rng.integers(-4, 5, value.shape), jnp.float32)
    for gradient, own in zip(back(cotangent), own_back(cotangent), strict=True):
        assert np.any(own)
        np.testing.assert_array_equal(gradient, own)


@pytest.mark.parametrize("count", [1, 7, 8, 12, 13])
def test_a_product_whose_sums_are_cut_in_pieces_is_the_plain_one(count):
    rng = np.random.default_rng(0)
    x, weight, grad = (
        jnp.asarray(rng.integers(-4, 5, s), jnp.float32)
        for s in ((count, 6, 8, 4), (4, 32), (count, 6, 8, 32))
    )
    value, back = jax.vjp(patch_product, x, weight)
    expected, own_back = jax.vjp(jnp.matmul, x, weight)
    np.testing.assert_array_equal(value, expected)
    for gradient, own in zip(back(grad), own_back(grad), strict=True):
        np.testing.assert_array_equal(gradient, own)
