"""What a numpy mask is known to hold, and that nothing is known of one of JAX."""

import jax.numpy as jnp
import numpy as np

from tracks.common.masks import everywhere, nowhere


def test_a_numpy_mask_is_looked_at():
    yes, no = np.array([True, True]), np.array([False, False])
    assert everywhere(yes) and not nowhere(yes)
    assert nowhere(no) and not everywhere(no)
    mixed = np.array([True, False])
    assert not everywhere(mixed) and not nowhere(mixed)


def test_a_program_of_jax_is_the_same_whatever_its_mask_holds():
    for mask in (jnp.array([True, True]), jnp.array([False, False])):
        assert not everywhere(mask) and not nowhere(mask)
