"""The spec inside a torch or ONNX file comes back, or is refused by the file's name."""

import json
from dataclasses import replace

import pytest

from policies.formats.spec_json import KEY, SCHEMA, embed, extract, labels
from policies.spec import PolicyError, PolicySpec
from tests.policies.conftest import SPEC


def test_what_is_embedded_comes_back():
    texts = labels(SPEC, "tiny", 7)
    text, alone = texts[KEY], {"contract": texts["contract"]}
    assert extract(texts, "here").spec == extract({KEY: text.encode()}, "here").spec == SPEC
    assert extract(alone, "here").spec == replace(SPEC, hidden_size=192)  # nothing says it there
    assert not extract(alone, "here").notes
    data = json.loads(text)
    assert (data["schema"], data["name"], data["seed"]) == (SCHEMA, "tiny", 7)


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
    with pytest.raises(PolicyError, match="contract says rate_hz 50.0, the spec in policy.json 33"):
        extract({KEY: embed(SPEC, "tiny", 7), "contract": other["contract"]}, "here")
