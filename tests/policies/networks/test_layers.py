"""Convolutions, the gated recurrent unit and fresh weights, against those of JAX and torch."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from policies.networks.layers import conv_valid, gru_update, patch_product, uniform


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


def test_an_open_update_gate_keeps_and_a_shut_one_replaces():
    hidden = jnp.asarray([0.3, -0.7])
    for update, expected in ((100.0, [0.3, -0.7]), (-100.0, np.tanh([0.5, 0.5]))):
        gates = jnp.asarray([0.0, 0.0, update, update, 0.5, 0.5])
        found = gru_update(gates, jnp.zeros(6), hidden)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_every_array_is_what_its_own_key_gives():
    shapes = {"long": (40, 7), "short": (3,), "one": ()}
    key = jax.random.key(5)
    keys = jax.random.split(key, len(shapes))
    found = uniform(key, shapes)
    assert list(found) == list(shapes)
    for (name, shape), own in zip(shapes.items(), keys, strict=True):
        np.testing.assert_array_equal(found[name], jax.random.uniform(own, shape))
