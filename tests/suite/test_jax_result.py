"""The installed JAX gives right results where one release on the CPU silently did not."""

import jax
import jax.numpy as jnp
import numpy as np


def test_jitted_batch_of_products_then_a_reduction():
    # JAX issue 39103: 0.10.2 on the CPU is wrong in the last rows above 16k rows in float64 and
    # 32k in float32. Frames, rays and distances are all computed so.
    rng, rows = np.random.default_rng(0), 100_000
    matrix = rng.normal(size=(3, 3)).astype(np.float32)
    vectors = rng.normal(size=(rows, 3)).astype(np.float32)

    def squared_length(vector):
        return jnp.sum((matrix @ vector) ** 2)

    expected = ((vectors.astype(np.float64) @ matrix.astype(np.float64).T) ** 2).sum(axis=-1)
    np.testing.assert_allclose(jax.jit(jax.vmap(squared_length))(vectors), expected, rtol=1e-4)
