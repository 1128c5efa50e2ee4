"""What a numpy mask is known to hold, and that nothing is known of one of JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

from tracks.common.masks import everywhere, make_contiguous, nowhere, select


def test_a_numpy_mask_is_looked_at():
    yes, no = np.array([True, True]), np.array([False, False])
    assert everywhere(yes) and not nowhere(yes)
    assert nowhere(no) and not everywhere(no)
    mixed = np.array([True, False])
    assert not everywhere(mixed) and not nowhere(mixed)


def test_a_program_of_jax_is_the_same_whatever_its_mask_holds():
    for mask in (jnp.array([True, True]), jnp.array([False, False])):
        assert not everywhere(mask) and not nowhere(mask)


NEW = ({"a": np.arange(3.0)}, np.ones((3, 2)))

OLD = ({"a": -np.arange(3.0)}, np.zeros((3, 2)))


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("mask", [[True] * 3, [False] * 3])
def test_a_mask_that_is_the_same_in_all_rows_takes_all_of_one_side(xp, mask):
    chosen, ones = select(xp.asarray(mask), NEW, OLD)
    sign = np.where(mask, 1.0, -1.0)
    np.testing.assert_array_equal(chosen["a"], sign * np.arange(3.0))
    np.testing.assert_array_equal(ones, np.repeat(np.asarray(mask, float)[:, None], 2, axis=1))


@pytest.mark.parametrize("xp", [np, jnp])
def test_rows_are_chosen_through_tuples_and_dicts(xp):
    mask = xp.asarray([True, False])
    new = {"a": (xp.ones((2, 3)), xp.ones(2))}
    old = {"a": (xp.zeros((2, 3)), xp.zeros(2))}
    chosen = select(mask, new, old)["a"]
    np.testing.assert_array_equal(chosen[0], [[1, 1, 1], [0, 0, 0]])
    np.testing.assert_array_equal(chosen[1], [1, 0])


def test_packed_lays_rows_one_after_another():
    across = np.arange(6.0).reshape(2, 3).T
    (again,) = make_contiguous((across,))
    np.testing.assert_array_equal(again, across)
    assert again.flags.c_contiguous and not across.flags.c_contiguous
