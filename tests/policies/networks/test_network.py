"""Layers against JAX and torch; networks can be trained and extended; training states come back."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch

from policies.formats.checkpoint import load_arrays, save_arrays
from policies.networks import delta_network, network
from policies.networks.layers import conv_valid, gru_update, patch_product, uniform
from policies.networks.network import LEAK
from policies.networks.tree_arrays import tree_from_arrays, tree_to_arrays
from policies.spec import PolicyError, PolicySpec
from tests.support.marks import more


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


def training_state(params):
    optimizer = optax.adamw(1e-3)
    return {"params": params, "optimizer": optimizer.init(params), "step": jnp.asarray(4)}


def test_a_training_state_comes_back_as_a_tree(tmp_path, params):
    state = training_state(params)
    save_arrays(tmp_path / "t", tree_to_arrays(state), kind="training", seed=9)
    arrays = load_arrays(tmp_path / "t", kind="training").arrays
    zero = jax.tree.map(jnp.zeros_like, params)
    back = tree_from_arrays(training_state(zero), arrays, "here")
    assert jax.tree.structure(back) == jax.tree.structure(state)
    jax.tree.map(np.testing.assert_array_equal, back, state)


def test_a_training_state_of_another_shape_is_refused(params):
    arrays = tree_to_arrays(training_state(params))
    other = training_state(network.init(jax.random.key(0), PolicySpec(hidden_size=8)))
    with pytest.raises(PolicyError, match="expected float32"):
        tree_from_arrays(other, arrays, "here")
    with pytest.raises(PolicyError, match="missing arrays"):
        tree_from_arrays({"params": params, "more": jnp.zeros(1)}, arrays, "here")


SPEC = PolicySpec(rate_hz=15.0)
SMALL = PolicySpec(rate_hz=33.0, hidden_size=64)
SECOND = replace(SMALL, second_gate=True)
AXIS = replace(SMALL, gate_axis=True)
BOTH = replace(SECOND, gate_axis=True)
PACED = replace(AXIS, speed_input=True, speed=0.5)
CLIMB_B = jnp.asarray([1.0, 0.0, 1.0])
ADAMW = optax.adamw(2e-3, b2=0.99, weight_decay=1e-2)


def error(params, states, images):
    """Return how far all actions are from CLIMB_B, and the memory after the last."""

    def step(hidden, seen):
        action, hidden = network.step(params, hidden, *seen)
        return hidden, ((action - CLIMB_B) ** 2).sum(-1).mean()

    start = jnp.zeros((states.shape[1], SPEC.hidden_size))
    hidden, errors = jax.lax.scan(step, start, (states, images))
    return errors.mean(), hidden


@cache
def fresh(seed, spec):
    return jax.jit(network.init, static_argnums=1)(jax.random.key(seed), spec)


step = jax.jit(network.step)
delta_step = jax.jit(delta_network.step)


@jax.jit
def learn(params, optimizer, key):
    states = jax.random.normal(key, (4, 4, SPEC.state_size))
    images = jax.random.uniform(key, (4, 4, SPEC.camera.height, SPEC.camera.width))
    (loss, hidden), gradient = jax.value_and_grad(error, has_aux=True)(params, states, images)
    change, optimizer = ADAMW.update(gradient, optimizer, params)
    return optax.apply_updates(params, change), optimizer, loss, hidden


@pytest.mark.parametrize("seed", [more(k) for k in (0, 1, 3)])
def test_one_action_for_all_is_learned_without_saturating_the_memory(seed):
    # What the first gradient steps of a training ask for. With outputs that start near zero the
    # memory's mean size comes to 0.85 to 0.91, and nothing that is seen changes it any more.
    params = fresh(seed, SPEC)
    optimizer = ADAMW.init(params)
    loss, hidden = jnp.inf, jnp.zeros(1)
    for i in range(30):
        params, optimizer, loss, hidden = learn(params, optimizer, jax.random.key(100 + i))
    assert loss < 0.1
    assert jnp.abs(hidden).mean() < 0.65


@pytest.mark.parametrize(
    ("seen", "spec", "columns"),
    [
        more(SMALL, SECOND, slice(0, 12)),
        more(AXIS, BOTH, np.r_[0:12, 15:18]),
        more(AXIS, PACED, slice(0, 15)),
        more(PACED, replace(PACED, second_axis=True), np.r_[0:15, 18]),
        (PACED, replace(PACED, second_gate=True, speed=1.0), np.r_[0:12, 15:19]),
    ],
)
def test_a_policy_goes_on_as_one_that_sees_more(seen, spec, columns):
    """It acts as before, whatever the new numbers are."""
    rng = np.random.default_rng(0)
    params = fresh(5, seen)
    wide = network.adapt_params(params, seen, spec)
    state, image, hidden = (
        jnp.asarray(rng.normal(size=(4, *s)), jnp.float32)
        for s in ((spec.state_size,), (24, 32), (64,))
    )
    before = step(params, hidden, state[:, columns], image)
    for a, b in zip(before, step(wide, hidden, state, image), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize(
    ("seen", "spec", "key"),
    [
        (SECOND, SMALL, "spec.second_gate=True"),
        (AXIS, SECOND, "spec.gate_axis=True"),
        (BOTH, SMALL, "spec.second_gate=True spec.gate_axis=True"),
    ],
)
def test_a_policy_that_sees_more_is_refused(seen, spec, key):
    params = fresh(5, seen)
    with pytest.raises(ValueError, match=f"has more inputs; give --set {key}, or"):
        network.adapt_params(params, seen, spec)


def test_at_twice_the_rate_a_memory_lasts_as_long():
    """Two decisions forget what one did, where little is forgotten in each."""
    params = fresh(5, SMALL)
    # With an update gate of 0.9 whatever is seen, and nothing new, states only fade.
    params = {name: jnp.zeros_like(value) for name, value in params.items()}
    params["gru.bias_input"] = params["gru.bias_input"].at[64:128].set(np.log(0.9 / 0.1))
    often = network.adapt_params(params, SMALL, replace(SMALL, rate_hz=2 * SMALL.rate_hz))
    seen = jnp.zeros((1, SMALL.state_size)), jnp.zeros((1, 24, 32))
    _, once = step(params, jnp.ones((1, 64)), *seen)
    _, half = step(often, jnp.ones((1, 64)), *seen)
    _, twice = step(often, half, *seen)
    np.testing.assert_allclose(once, 0.9, rtol=1e-5)
    np.testing.assert_allclose(twice, once, rtol=0.005)


def test_more_rays_a_pixel_keep_the_weights_and_another_size_is_refused():
    params = fresh(5, SMALL)
    finer = replace(SMALL, camera=replace(SMALL.camera, rays=2))
    for name, value in network.adapt_params(params, SMALL, finer).items():
        np.testing.assert_array_equal(value, params[name])
    other = {
        "hidden_size 64, and this run 32": {"hidden_size": 32},
        r"channels .*128\), and this run \(16": {"channels": (16, 32, 32)},
        "camera .*width=36": {"camera": replace(SMALL.camera, width=36)},
    }
    for words, changed in other.items():
        with pytest.raises(ValueError, match=words):
            network.adapt_params(params, SMALL, replace(SMALL, **changed))


HIDDEN = delta_network.HIDDEN


def inputs(n):
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(size=(n, 3)), jnp.float32) for _ in range(3)]


def test_a_fresh_one_corrects_nothing():
    params = delta_network.init(jax.random.key(1))
    correction, hidden = delta_step(params, delta_network.start(4), *inputs(4))
    np.testing.assert_array_equal(correction, np.zeros((4, 3)))
    assert hidden.shape == (4, HIDDEN) and float(jnp.abs(hidden).max()) > 0.01


def test_a_step_is_that_of_the_same_layers_in_torch():
    params = delta_network.init(jax.random.key(1))
    rng = np.random.default_rng(1)
    params = {
        name: jnp.asarray(value + 0.1 * rng.normal(size=value.shape), jnp.float32)
        for name, value in params.items()
    }
    hidden = jnp.asarray(rng.normal(size=(4, HIDDEN)), jnp.float32)
    seen = inputs(4)
    correction, after = delta_step(params, hidden, *seen)

    held = {name: torch.from_numpy(np.array(value)) for name, value in params.items()}
    cell = torch.nn.GRUCell(HIDDEN, HIDDEN)
    bias_h = torch.cat([torch.zeros(2 * HIDDEN), held["gru.bias_new"]])
    weights = held["gru.weight_input"].T, held["gru.weight_hidden"].T, held["gru.bias"], bias_h
    for parameter, value in zip(cell.parameters(), weights, strict=True):
        parameter.data = value
    # Metres a second are a fifth, m/s^2 a tenth.
    x = np.concatenate([seen[0] * 0.2, seen[1], seen[2] * 0.1], axis=1)
    with torch.no_grad():
        x = torch.from_numpy(x) @ held["input.weight"] + held["input.bias"]
        x = torch.nn.functional.leaky_relu(x, LEAK)
        expected = cell(x, torch.from_numpy(np.array(hidden)))
        out = expected @ held["output.weight"] + held["output.bias"]
    np.testing.assert_allclose(after, expected.numpy(), atol=2e-6, rtol=1e-5)
    np.testing.assert_allclose(correction, out.numpy(), atol=2e-6, rtol=1e-5)
