"""Policies and Delta Action networks as checkpoints, a spec as JSON, and what they refuse."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policies.formats import spec_json
from policies.formats.checkpoint import CONFIG, save_arrays
from policies.formats.policy_file import load_delta, load_policy_checkpoint, save_policy
from policies.formats.spec_json import KEY, extract, labels, spec_from_json, spec_to_json
from policies.networks import delta_network
from policies.spec import DepthEncoding, PolicyError, PolicySpec
from tests.support.policy_files import SPEC
from tracks.geometry.camera import Camera


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
        ("hidden_size", 32, r"expected float32 \(.*32"),
        ("second_gate", True, r"state\.weight"),
        ("channels", [16, 20, 32], r"channels is \(16, 20, 32\), allowed are an even number"),
        ("channels", [0, 32, 32], r"channels is \(0, 32, 32\), allowed is 2 to 1024"),
        ("channels", [16, 32, 32], r"expected float32 \(.*16"),
        ("tempo", 3, "key 'tempo' at the top is unknown. Allowed: rate_hz, camera"),
        ("camera", {"width": 34}, "camera.width is 34"),
        ("camera", {"fov_deg": [70.0, 180.0]}, r"fov_deg is \(70.0, 180.0\)"),
        ("depth", {"near": 20.0}, "below camera.range_m"),
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
    saved = partial(
        save_arrays, tmp_path / "run/delta", kind="delta", seed=1, extra={"fit": {"epochs": 2}}
    )
    back = load_delta(saved(delta))
    assert back.config["fit"] == {"epochs": 2}
    of_run = load_delta(tmp_path / "run")  # the --out of `suite delta`
    for name, value in delta.items():
        np.testing.assert_array_equal(back.arrays[name], value)
        np.testing.assert_array_equal(of_run.arrays[name], value)
    with pytest.raises(PolicyError, match="kind is 'policy', expected 'delta'"):
        load_delta(save_policy(tmp_path / "p", params, SPEC, seed=None))
    with pytest.raises(PolicyError, match=r"'output.bias' is float32 \(4,\)"):
        load_delta(saved(delta | {"output.bias": jnp.zeros(4)}))


@given(
    st.builds(
        PolicySpec,
        rate_hz=st.floats(1, 500),
        camera=st.builds(Camera, pitch_deg=st.floats(-90, 90), range_m=st.floats(5, 1000)),
        depth=st.builds(DepthEncoding, scale=st.floats(0.01, 100), near=st.floats(0.01, 4)),
        hidden_size=st.integers(1, 1000),
        channels=st.tuples(*[st.integers(2, 1024)] * 3),
    )
)
def test_a_spec_survives_json(spec):
    assert spec_from_json(json.loads(json.dumps(spec_to_json(spec))), "here") == spec


def test_keys_left_out_of_a_spec_take_the_default_and_another_type_is_refused():
    assert spec_from_json({"camera": {"width": 64}}, "here") == PolicySpec(camera=Camera(width=64))
    stored = spec_to_json(SPEC)
    del stored["second_gate"], stored["gate_axis"], stored["channels"]
    assert spec_from_json(stored, "here") == SPEC
    for value in (1, "yes", None):
        with pytest.raises(PolicyError, match=r"second_gate is .*allowed is true or false"):
            spec_from_json({**stored, "second_gate": value}, "here")


def test_what_is_embedded_comes_back():
    texts = labels(SPEC, "tiny", 7)
    text, alone = texts[KEY], {"contract": texts["contract"]}
    assert extract(texts, "here").spec == extract({KEY: text.encode()}, "here").spec == SPEC
    assert extract(alone, "here").spec == replace(SPEC, hidden_size=192)  # nothing says it there
    assert not extract(alone, "here").notes
    data = json.loads(text)
    assert (data["schema"], data["name"], data["seed"]) == (spec_json.SCHEMA, "tiny", 7)


@pytest.mark.parametrize("text", [None, "", b"", "{}"])
def test_a_file_that_says_nothing_has_the_default_spec(text):
    said = extract({} if text is None else {KEY: text}, "here")
    assert said.spec == PolicySpec() and said.contract is None
    assert said.notes[0].fault == "no_contract" and "30 Hz" in str(said.notes[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not JSON"),
        ("[]", "expected an object with schema 1"),
        ('{"schema": 2}', "update the suite"),
        ('{"spec": {"rate_hz": -1}}', "spec: rate_hz is -1"),
        ('{"spec": {"rate": 1}}', "key 'rate' at the top is unknown"),
        ('{"rate_hz": 15.0}', "unknown key 'rate_hz'.*Known: .*spec"),
        ('{"Spec": {"rate_hz": 15.0}}', "unknown key 'Spec'. Did you mean 'spec'"),
    ],
)
def test_a_damaged_one_is_refused(text, said):
    with pytest.raises(PolicyError, match=rf"^here: {KEY}.*{said}"):
        extract({KEY: text}, "here")


def test_a_contract_and_a_spec_that_contradict_are_refused():
    other = labels(replace(SPEC, rate_hz=50.0), "tiny", 7)
    with pytest.raises(PolicyError, match="contract has rate_hz 50.0, the spec in policy.json 33"):
        extract({KEY: spec_json.embed(SPEC, "tiny", 7), "contract": other["contract"]}, "here")
