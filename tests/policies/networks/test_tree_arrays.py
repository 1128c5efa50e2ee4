"""A training state comes back as a tree, or is refused by name; weights in torch's layouts."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from policies.formats.checkpoint import load_arrays, save_arrays
from policies.networks import network
from policies.networks.tree_arrays import (
    image_weight,
    kernel_oihw,
    rows_are_outputs,
    tree_from_arrays,
    tree_to_arrays,
)
from policies.spec import PolicyError, PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=33.0, camera=Camera(pitch_deg=20.0), hidden_size=16)


@pytest.fixture
def params():
    return network.init(jax.random.key(1), SPEC)


def training_state(params, seed):
    optimizer = optax.adamw(1e-3)
    return {
        "params": params,
        "optimizer": optimizer.init(params),
        "step": jnp.asarray(4),
        "key": jax.random.key(seed),
    }


def test_a_training_state_comes_back_as_a_tree(tmp_path, params):
    state = training_state(params, 9)
    save_arrays(tmp_path / "t", tree_to_arrays(state), kind="training", seed=9)
    arrays = load_arrays(tmp_path / "t", kind="training").arrays
    zero = jax.tree.map(jnp.zeros_like, params)
    back = tree_from_arrays(training_state(zero, 0), arrays, "here")
    assert jax.tree.structure(back) == jax.tree.structure(state)
    assert jax.random.uniform(back["key"]) == jax.random.uniform(state["key"])
    back["key"] = state["key"] = None
    jax.tree.map(np.testing.assert_array_equal, back, state)


def test_a_training_state_of_another_shape_is_refused(params):
    arrays = tree_to_arrays(training_state(params, 0))
    other = training_state(network.init(jax.random.key(0), PolicySpec(hidden_size=8)), 0)
    with pytest.raises(PolicyError, match="expected float32"):
        tree_from_arrays(other, arrays, "here")
    with pytest.raises(PolicyError, match="missing arrays"):
        tree_from_arrays({"params": params, "more": jnp.zeros(1)}, arrays, "here")


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
