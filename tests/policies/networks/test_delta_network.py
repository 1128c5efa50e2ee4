"""The Delta Action network: no correction at first, and the recurrence of its equations after."""

import jax
import jax.numpy as jnp
import numpy as np
import torch

from policies.networks import delta_network
from policies.networks.network import LEAK

HIDDEN = delta_network.HIDDEN


def inputs(n):
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(size=(n, 3)), jnp.float32) for _ in range(3)]


def test_a_fresh_one_corrects_nothing():
    params = delta_network.init(jax.random.key(1))
    correction, hidden = delta_network.step(params, delta_network.start(4), *inputs(4))
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
    correction, after = delta_network.step(params, hidden, *seen)

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
