"""Layers against those of JAX and torch; a training state comes back, or is refused by name."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch

from policies.formats.checkpoint import load_arrays, save_arrays
from policies.networks import network
from policies.networks.layers import conv_valid, gru_update, patch_product, uniform
from policies.networks.tree_arrays import tree_from_arrays, tree_to_arrays
from policies.spec import PolicyError, PolicySpec


@partial(jax.jit, static_argnums=0)
def value_and_gradients(function, x, weight, cotangent):
    value, back = jax.vjp(function, x, weight)
    return value, *back(cotangent)


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
    out = (image[0], image[1] - kernel[0] + 1, image[2] - kernel[1] + 1, kernel[3])
    given = [rng.integers(-4, 5, s).astype(np.float32) for s in (image, kernel, out)]
    found, expected = (value_and_gradients(one, *given) for one in (conv_valid, jax_own))
    for ours, theirs in zip(found, expected, strict=True):
        assert np.any(theirs)
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("count", [1, 7, 8, 12, 13])
def test_a_product_whose_sums_are_cut_in_pieces_is_the_plain_one(count):
    rng = np.random.default_rng(0)
    shapes = ((count, 6, 8, 4), (4, 32), (count, 6, 8, 32))
    given = [rng.integers(-4, 5, s).astype(np.float32) for s in shapes]
    found, expected = (value_and_gradients(one, *given) for one in (patch_product, jnp.matmul))
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_gated_recurrent_unit_is_torchs_cell():
    rng = np.random.default_rng(0)
    cell = torch.nn.GRUCell(5, 4)
    x, hidden = (rng.normal(size=(3, n)).astype(np.float32) for n in (5, 4))
    with torch.no_grad():
        expected = cell(torch.from_numpy(x), torch.from_numpy(hidden)).numpy()
        weights = [value.numpy() for value in cell.parameters()]
    from_input, from_hidden = (
        jnp.asarray(value @ weight.T + bias)
        for value, weight, bias in zip((x, hidden), weights[:2], weights[2:], strict=True)
    )
    np.testing.assert_allclose(
        gru_update(from_input, from_hidden, jnp.asarray(hidden)), expected, atol=1e-6
    )


def test_every_array_is_what_its_own_key_gives():
    shapes = {"long": (40, 7), "short": (3,), "one": ()}
    key = jax.random.key(5)
    keys = jax.random.split(key, len(shapes))
    found = uniform(key, shapes)
    assert list(found) == list(shapes)
    for (name, shape), own in zip(shapes.items(), keys, strict=True):
        np.testing.assert_array_equal(found[name], jax.random.uniform(own, shape))


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
