"""Weights in torch's layouts: each number is where its output and its input say."""

import numpy as np

from policies.networks.tree_arrays import image_weight, kernel_oihw, rows_are_outputs
from policies.spec import PolicySpec
from tracks.geometry.camera import Camera


def test_a_matrix_has_its_outputs_as_rows():
    found = rows_are_outputs(np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(found, [[0, 3], [1, 4], [2, 5]])
    assert found.dtype == np.float32 and found.flags.c_contiguous


def test_a_kernel_has_its_channels_first():
    kernel = np.arange(2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    found = kernel_oihw(kernel)
    assert found.shape == (5, 4, 2, 3) and found.flags.c_contiguous
    assert found[4, 2, 1, 0] == kernel[1, 0, 2, 4]


def test_features_of_an_image_are_told_channel_by_channel():
    spec = PolicySpec(camera=Camera(width=28, height=24), hidden_size=2, channels=(2, 32, 64))
    rows, columns = 24 // 4 - 4, 28 // 4 - 4
    number = np.arange(rows * columns * 64)
    found = image_weight({"image.weight": np.stack([number, -number], 1)}, spec)
    # Ours runs over rows, columns and then channels; torch's over channels first.
    expected = number.reshape(rows * columns, 64).T.ravel()
    np.testing.assert_array_equal(found, [expected, -expected])
