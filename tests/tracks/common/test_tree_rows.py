"""Rows of nested arrays: each from the side its mask says, whatever the mask."""

import jax.numpy as jnp
import numpy as np
import pytest

from tracks.common.tree_rows import packed, select

NEW = ({"a": np.arange(3.0)}, np.ones((3, 2)))
OLD = ({"a": -np.arange(3.0)}, np.zeros((3, 2)))


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("mask", [[True] * 3, [False] * 3, [True, False, True]])
def test_rows_come_from_the_side_that_the_mask_says(xp, mask):
    chosen, ones = select(xp.asarray(mask), NEW, OLD)
    sign = np.where(mask, 1.0, -1.0)
    np.testing.assert_array_equal(chosen["a"], sign * np.arange(3.0))
    np.testing.assert_array_equal(ones, np.repeat(np.asarray(mask, float)[:, None], 2, axis=1))


def test_packed_arrays_lie_row_by_row():
    assert packed((np.zeros((3, 2)).T,))[0].flags.c_contiguous
