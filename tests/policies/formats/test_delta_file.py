"""A Delta Action network as a checkpoint, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.policy_file import load_delta, save_delta, save_policy
from policies.networks import delta_network, network
from policies.spec import PolicyError, PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=33.0, camera=Camera(pitch_deg=20.0), hidden_size=16)


@pytest.fixture
def params():
    return network.init(jax.random.key(1), SPEC)


def test_a_delta_comes_back_and_a_policy_is_none(tmp_path, params):
    delta = delta_network.init(jax.random.key(0))
    back = load_delta(save_delta(tmp_path / "d", delta, seed=1, fit={"epochs": 2}))
    assert back.config["fit"] == {"epochs": 2}
    for name, value in delta.items():
        np.testing.assert_array_equal(back.params[name], value)
    with pytest.raises(PolicyError, match="kind is 'policy', expected 'delta'"):
        load_delta(save_policy(tmp_path / "p", params, SPEC, seed=None))
    with pytest.raises(PolicyError, match=r"'output.bias' is float32 \(4,\)"):
        load_delta(save_delta(tmp_path / "d", delta | {"output.bias": jnp.zeros(4)}, seed=1))
