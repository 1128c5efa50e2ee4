"""The spec inside a torch or ONNX file comes back, or is refused by the file's name."""

import json

import pytest

from policies.formats.spec_json import KEY, SCHEMA, embed, extract
from policies.spec import PolicyError, PolicySpec
from tests.policies.conftest import SPEC


def test_what_is_embedded_comes_back():
    text = embed(SPEC, "tiny", 7)
    assert extract(text, "here") == extract(text.encode(), "here") == SPEC
    data = json.loads(text)
    assert (data["schema"], data["name"], data["seed"]) == (SCHEMA, "tiny", 7)


@pytest.mark.parametrize("text", [None, "", b"", "{}"])
def test_a_file_that_says_nothing_has_the_default_spec(text):
    assert extract(text, "here") == PolicySpec()


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
        extract(text, "here")
