"""A spec survives JSON, and is refused by key where it cannot be."""

import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from policies.formats.spec_json import spec_from_json, spec_to_json
from policies.spec import DepthEncoding, PolicyError, PolicySpec
from tests.policies.conftest import SPEC
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


def test_keys_left_out_of_a_spec_take_the_default():
    assert spec_from_json({"camera": {"width": 64}}, "here") == PolicySpec(
        camera=dataclasses.replace(Camera(), width=64)
    )


def test_a_checkpoint_without_the_keys_sees_one_gate_with_the_usual_channels():
    stored = spec_to_json(SPEC)
    del stored["second_gate"], stored["gate_axis"], stored["channels"]
    assert spec_from_json(stored, "here") == SPEC


@pytest.mark.parametrize("value", [1, "yes", None])
def test_the_key_is_true_or_false(value):
    stored = json.loads(json.dumps({**spec_to_json(SPEC), "second_gate": value}))
    with pytest.raises(PolicyError, match=r"second_gate is .*allowed is true or false"):
        spec_from_json(stored, "here")
