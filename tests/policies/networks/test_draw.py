"""Fresh weights are the numbers that JAX draws for each shape by itself."""

import jax
import numpy as np

from policies.networks.layers import uniform


def test_every_array_is_what_its_own_key_gives():
    shapes = {"long": (40, 7), "short": (3,), "one": ()}
    key = jax.random.key(5)
    keys = jax.random.split(key, len(shapes))
    found = uniform(key, shapes)
    assert list(found) == list(shapes)
    for (name, shape), own in zip(shapes.items(), keys, strict=True):
        np.testing.assert_array_equal(found[name], jax.random.uniform(own, shape))
