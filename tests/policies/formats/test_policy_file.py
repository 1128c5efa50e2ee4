"""Policies, Delta Action networks and training states as checkpoints, and what they refuse."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policies.errors import PolicyError
from policies.formats.checkpoint import CONFIG, load_arrays, save_arrays
from policies.formats.delta_file import load_delta, save_delta
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.formats.spec_json import spec_from_json, spec_to_json
from policies.networks import delta_network, network
from policies.networks.tree_arrays import tree_from_arrays, tree_to_arrays
from policies.spec import DepthEncoding, PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=33.0, camera=Camera(pitch_deg=20.0), hidden_size=16)


@pytest.fixture
def params():
    return network.init(jax.random.key(1), SPEC)


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
        ("rate_hz", True, "rate_hz is True"),
        ("hidden_size", 1.5, "hidden_size is 1.5"),
        ("hidden_size", 32, r"expected float32 \(.*32"),
        ("speed", 3, "unknown key 'speed', allowed are rate_hz, camera"),
        ("camera", {"width": 34}, "camera.width is 34"),
        ("camera", {"height": 16}, "camera.height is 16"),
        ("camera", {"fov_deg": [70.0]}, r"fov_deg is \[70.0\], expected 2"),
        ("camera", {"fov_deg": [70.0, 180.0]}, "fov_deg is 180.0"),
        ("camera", [1], "camera: is"),
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
    doubled = params | {"state.bias": np.zeros(16)}
    save_policy(folder, doubled, SPEC, seed=None)
    with pytest.raises(PolicyError, match="'state.bias' is float64"):
        load_policy_checkpoint(folder)


def test_nan_weights_are_refused(tmp_path, params):
    bad = params | {"action.weight": params["action.weight"].at[0, 0].set(jnp.nan)}
    with pytest.raises(PolicyError, match="'action.weight' holds 1 of 48"):
        load_policy_checkpoint(save_policy(tmp_path / "p", bad, SPEC, seed=None))


@given(
    st.builds(
        PolicySpec,
        rate_hz=st.floats(1, 500),
        camera=st.builds(Camera, pitch_deg=st.floats(-90, 90), range_m=st.floats(5, 1000)),
        depth=st.builds(DepthEncoding, scale=st.floats(0.01, 100), near=st.floats(0.01, 4)),
        hidden_size=st.integers(1, 1000),
    )
)
def test_a_spec_survives_json(spec):
    assert spec_from_json(json.loads(json.dumps(spec_to_json(spec))), "here") == spec


def test_keys_left_out_of_a_spec_take_the_default():
    assert spec_from_json({"camera": {"width": 64}}, "here") == PolicySpec(
        camera=dataclasses.replace(Camera(), width=64)
    )


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
