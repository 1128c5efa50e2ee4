"""A spec comes back from JSON and from inside a torch or ONNX file, or is refused by key."""

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from policies.formats import spec_json
from policies.formats.spec_json import KEY, extract, labels, spec_from_json, spec_to_json
from policies.spec import DepthEncoding, PolicyError, PolicySpec
from tests.support.policy_files import SPEC
from tracks.geometry.camera import Camera


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
