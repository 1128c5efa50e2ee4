"""The twin in torch."""

import jax.numpy as jnp
import numpy as np
import torch

from policies.formats.torch_twin import torch_twin
from policies.networks import network
from tests.policies.conftest import SPEC


def test_the_twin_is_our_network_layer_for_layer(params):
    rng = np.random.default_rng(0)
    state, image, hidden = (
        rng.normal(size=(5, *shape)).astype(np.float32) for shape in ((12,), (24, 32), (64,))
    )
    ours = network.step(params, *map(jnp.asarray, (hidden, state, image)))
    with torch.no_grad():
        theirs = torch_twin(params, SPEC)(*map(torch.from_numpy, (state, image, hidden)))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5, rtol=1e-5)
