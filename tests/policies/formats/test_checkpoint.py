"""Checkpoints come back to the bit, survive a kill, and are refused by name when damaged."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from policies.formats import spec_json
from policies.formats.checkpoint import CONFIG, WEIGHTS, load_arrays, save_arrays
from policies.formats.policy_file import load_delta, load_policy_checkpoint, save_policy
from policies.formats.spec_json import KEY, extract, labels, spec_from_json
from policies.networks import delta_network
from policies.spec import DepthEncoding, PolicyError, PolicySpec
from tests.support.policy_files import SPEC
from tracks.geometry.camera import Camera

ARRAYS = {"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "step": np.int64(7)}


def save(folder, arrays=ARRAYS, **extra):
    return save_arrays(folder, arrays, kind="policy", seed=3, extra=extra)


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    saved = save(tmp_path_factory.mktemp("saved") / "c")  # once, for many copies
    return lambda: Path(shutil.copytree(saved, tmp_path_factory.mktemp("copy") / "c"))


@settings(max_examples=8)
@given(
    st.dictionaries(
        st.text("abc.'[]µ", min_size=1, max_size=8),
        hnp.arrays(
            st.sampled_from([np.float32, np.float64, np.int32, np.uint32, np.bool_]),
            hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
            elements={"allow_nan": False, "allow_infinity": False},
        ),
        max_size=4,
    )
)
def test_arrays_come_back_to_the_bit(tmp_path_factory, arrays):
    folder = tmp_path_factory.mktemp("round") / "checkpoint"
    save(folder, arrays)
    back = load_arrays(folder, kind="policy").arrays
    assert back.keys() == arrays.keys()
    for name, value in arrays.items():
        assert back[name].dtype == value.dtype and back[name].shape == value.shape
        assert back[name].tobytes() == value.tobytes()


def test_transposed_and_jax_arrays_are_stored_as_they_read(tmp_path):
    import jax.numpy as jnp

    strided = np.arange(6.0).reshape(2, 3).T
    save(tmp_path / "c", {"t": strided, "j": jnp.ones((2, 2))})
    back = load_arrays(tmp_path / "c", kind="policy").arrays
    np.testing.assert_array_equal(back["t"], strided)
    np.testing.assert_array_equal(back["j"], np.ones((2, 2)))


def test_the_config_says_what_the_weights_are(tmp_path):
    config = json.loads((save(tmp_path / "c", note={"x": 1}) / CONFIG).read_text())
    assert {"kind", "schema", "suite_version", "git_commit", "seed", "weights"} <= config.keys()
    assert (config["kind"], config["seed"], config["note"]) == ("policy", 3, {"x": 1})
    with pytest.raises(ValueError, match="kind"):
        save(tmp_path / "c", kind="delta")


@settings(max_examples=20)
@given(file=st.sampled_from([WEIGHTS, CONFIG]), keep=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_is_refused_by_name(copied, file, keep):
    folder = copied()
    path = folder / file
    whole = path.read_bytes().rstrip()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(PolicyError) as caught:
        load_arrays(folder, kind="policy")
    assert str(path) in str(caught.value)
    assert file == CONFIG or "incomplete or of another" in str(caught.value)


@settings(max_examples=20)
@given(at=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_a_changed_byte_of_the_weights_is_refused(copied, at, flip):
    folder = copied()
    data = bytearray((folder / WEIGHTS).read_bytes())
    data[int(at * len(data))] ^= flip
    (folder / WEIGHTS).write_bytes(data)
    with pytest.raises(PolicyError, match="sha256"):
        load_arrays(folder, kind="policy")


@settings(max_examples=5)
@given(
    key=st.sampled_from(["schema", "kind", "weights", "weights.sha256", "weights.bytes"]),
    value=st.one_of(st.none(), st.booleans(), st.floats(allow_nan=False), st.text(), st.just([])),
)
def test_a_damaged_config_is_refused_by_key(copied, key, value):
    folder = copied()
    config = json.loads((folder / CONFIG).read_text())
    table = config["weights"] if "." in key else config
    if table[key.split(".")[-1]] == value:
        return
    table[key.split(".")[-1]] = value
    (folder / CONFIG).write_text(json.dumps(config))
    with pytest.raises(PolicyError, match=r"config\.json|weights\.safetensors"):
        load_arrays(folder, kind="policy")


def test_a_missing_file_another_kind_and_a_newer_schema_are_refused(tmp_path):
    for file in (WEIGHTS, CONFIG):
        (save(tmp_path / "c") / file).unlink()
        with pytest.raises(PolicyError, match=f"{file}: missing"):
            load_arrays(tmp_path / "c", kind="policy")
    folder = save(tmp_path / "c")
    with pytest.raises(PolicyError, match="kind is 'policy', expected 'delta'"):
        load_arrays(folder, kind="delta")
    config = json.loads((folder / CONFIG).read_text())
    for data, said in ((config | {"schema": 2}, "schema is 2"), ([1], "expected an object")):
        (folder / CONFIG).write_text(json.dumps(data))
        with pytest.raises(PolicyError, match=said):
            load_arrays(folder, kind="policy")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    save(tmp_path / "c", {"w": np.array([1.0, np.nan, -np.inf], np.float32)})
    with pytest.raises(PolicyError, match="'w' has 2 of 3"):
        load_arrays(tmp_path / "c", kind="policy")


@pytest.mark.parametrize("fail_at", range(1, 12))
def test_a_stop_at_any_system_call_leaves_one_whole_checkpoint(tmp_path, monkeypatch, fail_at):
    folder = tmp_path / "c"
    save(folder, note=1)
    calls = 0

    def stopping(real):
        def call(*arguments, **options):
            nonlocal calls
            calls += 1
            if calls == fail_at:
                raise KeyboardInterrupt
            return real(*arguments, **options)

        return call

    with monkeypatch.context() as patch:
        for name in ("replace", "fsync"):
            patch.setattr(os, name, stopping(getattr(os, name)))
        patch.setattr(type(folder), "write_bytes", stopping(type(folder).write_bytes))
        patch.setattr(type(folder), "write_text", stopping(type(folder).write_text))
        try:
            save(folder, {"a": np.ones(2)}, note=2)
        except KeyboardInterrupt:
            pass
        else:
            assert fail_at > calls
    assert load_arrays(folder, kind="policy").config["note"] in (1, 2)
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


DYING_SAVE = """
import os, sys, pathlib, numpy as np
from policies.formats.checkpoint import save_arrays
real, done = os.replace, []
def dying(source, target):
    if len(done) == int(sys.argv[2]):
        os._exit(9)
    done.append(source)
    real(source, target)
os.replace = dying
arrays = {"a": np.ones(2, np.float32)}
save_arrays(pathlib.Path(sys.argv[1]), arrays, kind="policy", seed=3, extra={"note": 2})
"""


@pytest.mark.parametrize("renames", [0, 1])
def test_a_kill_before_or_between_the_two_renames_is_recovered_from(tmp_path, renames):
    folder = tmp_path / "c"
    save(folder, note=1)
    killed = subprocess.run([sys.executable, "-c", DYING_SAVE, str(folder), str(renames)])
    assert killed.returncode == 9
    assert folder.exists() == (renames == 0)
    assert load_arrays(folder, kind="policy").config["note"] == 1 + renames
    save(folder, note=3)
    assert load_arrays(folder, kind="policy").config["note"] == 3


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
        ("depth", {"uint8": True}, "depth.uint8 is True, allowed for the suite's network is False"),
        ("action", {"scale": [20.0]}, r"action.scale is \(20.0,\), allowed .* is \(1.0,\)"),
        ("action", {"clip": 1.0}, "action.clip is 1.0, allowed .* is 0.0; other values"),
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
    policy = save_policy(tmp_path / "trained/policy", params, SPEC, seed=None)
    with pytest.raises(PolicyError, match="kind is 'policy', expected 'delta': this is a policy"):
        load_delta(policy)
    with pytest.raises(PolicyError, match="folder of a training, .* no Delta Action Model; give"):
        load_delta(policy.parent)
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
    assert spec_from_json(json.loads(json.dumps(asdict(spec))), "here") == spec


def test_keys_left_out_of_a_spec_take_the_default_and_another_type_is_refused():
    assert spec_from_json({"camera": {"width": 64}}, "here") == PolicySpec(camera=Camera(width=64))
    stored = asdict(SPEC)
    del stored["second_gate"], stored["gate_axis"], stored["channels"]
    assert spec_from_json(stored, "here") == SPEC
    for value in (1, "yes", None):
        with pytest.raises(PolicyError, match=r"second_gate is .*allowed is true or false"):
            spec_from_json({**stored, "second_gate": value}, "here")


def test_what_is_embedded_comes_back():
    texts = labels(SPEC, "tiny", 7)
    text, alone = texts[KEY], {"contract": texts["contract"]}
    assert extract(texts, "here").spec == extract({KEY: text.encode()}, "here").spec == SPEC
    assert extract(alone, "here").spec == SPEC
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
        ("[1]", r"is \[1\], expected an object such as"),
        ("null", "is None, expected an object"),
        ('{"schema": 2}', "update the suite"),
        ('{"spec": {"rate_hz": -1}}', "spec: rate_hz is -1"),
        ('{"spec": {"rate": 1}}', "key 'rate' at the top is unknown"),
        ('{"spec": {"action": {"kind": "motor"}}}', "spec: action.kind: .*mean 'motors'"),
        ('{"spec": {"action": {"motors": "x"}}}', "spec: action.motors: .*thrust, speed"),
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
