"""Policies and Delta Action networks as checkpoints, and what they refuse."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.checkpoint import CONFIG
from policies.formats.policy_file import load_delta, load_policy_checkpoint, save_delta, save_policy
from policies.networks import delta_network
from policies.spec import PolicyError
from tests.support.policy_files import SPEC


def test_a_policy_comes_back_with_its_spec(tmp_path, params):
    folder = save_policy(tmp_path / "p", params, SPEC, seed=5, training={"steps": 3})
    back = load_policy_checkpoint(folder)
    assert back.spec == SPEC
    assert (back.config["seed"], back.config["training"]) == (5, {"steps": 3})
    assert back.params.keys() == params.keys()
    for name, value in params.items():
        np.testing.assert_array_equal(back.params[name], value)


def edit(folder, change):
    config = json.loads((folder / CONFIG).read_text())
    change(config)
    (folder / CONFIG).write_text(json.dumps(config))


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("rate_hz", -1, "rate_hz is -1"),
        ("rate_hz", "30", "rate_hz is '30'"),
        ("hidden_size", 32, r"expected float32 \(.*32"),
        ("second_gate", True, r"state\.weight"),
        ("channels", [16, 20, 32], r"channels is \(16, 20, 32\), allowed are an even number"),
        ("channels", [15, 32, 32], r"channels is \(15, 32, 32\)"),
        ("channels", [0, 32, 32], r"channels is \(0, 32, 32\), allowed is 2 to 1024"),
        ("channels", [16, 32, 32], r"expected float32 \(.*16"),
        ("tempo", 3, "key 'tempo' at the top is unknown. Allowed: rate_hz, camera"),
        ("camera", {"width": 34}, "camera.width is 34"),
        ("camera", {"height": 16}, "camera.height is 16"),
        ("camera", {"fov_deg": [70.0, 180.0]}, r"fov_deg is \(70.0, 180.0\)"),
        ("depth", {"near": 20.0}, "below camera.range_m"),
        ("depth", {"scale": float("inf")}, "scale is inf"),
    ],
)
def test_a_spec_that_cannot_be_is_refused_by_key(tmp_path, params, key, value, said):
    folder = save_policy(tmp_path / "p", params, SPEC, seed=None)
    edit(folder, lambda config: config["spec"].update({key: value}))
    with pytest.raises(PolicyError, match=said):
        load_policy_checkpoint(folder)


def test_a_policy_without_a_spec_and_weights_of_another_network_are_refused(tmp_path, params):
    folder = save_policy(tmp_path / "p", params, SPEC, seed=None)
    edit(folder, lambda config: config.pop("spec"))
    with pytest.raises(PolicyError, match="'spec' is missing"):
        load_policy_checkpoint(folder)
    renamed = {("x" if name == "state.bias" else name): v for name, v in params.items()}
    save_policy(folder, renamed, SPEC, seed=None)
    with pytest.raises(PolicyError, match=r"missing arrays \['state.bias'\], unknown.*\['x'\]"):
        load_policy_checkpoint(folder)
    doubled = params | {"state.bias": np.zeros(64)}
    save_policy(folder, doubled, SPEC, seed=None)
    with pytest.raises(PolicyError, match="'state.bias' is float64"):
        load_policy_checkpoint(folder)


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
