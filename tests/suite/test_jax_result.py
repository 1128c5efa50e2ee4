"""The installed JAX gives right results where one release on the CPU silently did not."""

import jax
import numpy as np
import pytest


@pytest.mark.parametrize("rows", [1_000, 16_385, 40_000])
def test_jitted_batch_of_products_then_a_sum(rows):
    # JAX issue 39103: 0.10.2 on the CPU, wrong above about 16k rows. That is our hot path.
    rng = np.random.default_rng(rows)
    matrix = rng.normal(size=(rows, 3, 3)).astype(np.float32)
    vector = rng.normal(size=(rows, 3)).astype(np.float32)

    @jax.jit
    def total(matrix, vector):
        return jax.vmap(lambda m, v: m @ v)(matrix, vector).sum(axis=-1)

    expected = np.einsum("nij,nj->n", matrix.astype(np.float64), vector.astype(np.float64))
    np.testing.assert_allclose(total(matrix, vector), expected, atol=1e-5)


@pytest.mark.parametrize("rows", [20_000])
def test_jitted_products_with_one_matrix_then_a_reduction_over_all(rows):
    rng = np.random.default_rng(rows)
    matrix = rng.normal(size=(3, 3)).astype(np.float32)
    vector = rng.normal(size=(rows, 3)).astype(np.float32)

    @jax.jit
    def total(matrix, vector):
        turned = jax.vmap(lambda v: matrix @ v)(vector)
        return (turned**2).sum(axis=-1), turned.min(axis=0), turned.max(axis=0)

    turned = vector.astype(np.float64) @ matrix.astype(np.float64).T
    expected = (turned**2).sum(axis=-1), turned.min(axis=0), turned.max(axis=0)
    for got, want in zip(total(matrix, vector), expected, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
