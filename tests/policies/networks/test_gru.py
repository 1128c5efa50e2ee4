"""The gated recurrent unit against torch's cell, and where its gates shut."""

import jax.numpy as jnp
import numpy as np
import torch

from policies.networks.layers import gru_update


def test_it_is_torchs_cell():
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
