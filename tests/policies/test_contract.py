"""The contract of a policy: it comes back from JSON, and what does not fit it is refused."""

import dataclasses
import json
from typing import Any, cast

import numpy as np
import pytest
import torch

from policies.contract import KEY, contract_of, read_contract, refuse_differences, spec_of
from policies.policy import load_policy
from policies.spec import ActionSpec, DepthEncoding, PolicyError, PolicySpec

SPECS = [
    PolicySpec(),
    PolicySpec(rate_hz=50, second_gate=True, speed_input=True, speed=0.9),
    PolicySpec(action=ActionSpec("ctbr", (9.0, 6.0, 6.0, 6.0), (9.0, 0.0, 0.0, 0.0))),
    PolicySpec(action=ActionSpec("motors", (0.5,), (0.5,), "speed"),
               depth=DepthEncoding(channel_axis=True, uint8=True)),
]  # fmt: skip


@pytest.mark.parametrize("spec", SPECS)
def test_a_contract_comes_back_with_its_digest_and_gives_the_spec(spec):
    contract = contract_of(spec, (4,))
    again = read_contract(contract.text, "here")
    assert again == contract and again.digest == contract.digest
    assert spec_of(again, "here") == dataclasses.replace(spec, hidden_size=4)
    wide = contract_of(spec, (5000,))  # wider than the suite's network can be
    assert spec_of(read_contract(wide.text, "here"), "here") == spec


@pytest.mark.parametrize(
    ("said", "changes"),
    [
        (
            r"action.scale is 20.0, allowed is a tuple",
            {"action": ActionSpec(scale=cast(Any, 20.0))},
        ),
        (r"action.offset is \[0\], allowed is a tu", {"action": ActionSpec(offset=cast(Any, [0]))}),
        ("kind of action 'CTBR'. Did you mean 'ctbr'", {"action": ActionSpec("CTBR")}),
        ("action is 'ctbr', allowed is an object Act", {"action": "ctbr"}),
        (r"camera is \(32, 24\), allowed is an object", {"camera": (32, 24)}),
        ("second_gate is 'no', allowed is True or F", {"second_gate": "no"}),
        ("rate_hz is '50', allowed is a number", {"rate_hz": "50"}),
    ],
)
def test_an_impossible_spec_has_no_contract(said, changes):
    with pytest.raises(ValueError, match=f"^spec.*{said}"):
        contract_of(PolicySpec(**changes))


def test_the_digest_is_one_for_one_meaning():
    assert contract_of(PolicySpec(rate_hz=30)).digest == contract_of(PolicySpec()).digest
    assert contract_of(PolicySpec(rate_hz=31)).digest != contract_of(PolicySpec()).digest


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("state", 2, "frame"), "FRD", r"state\[2\].frame is 'FRD', the suite provides 'body"),
        (("state", 0, "scale"), 0.1, r"state\[0\].scale is 0.1, the suite provides 1.0"),
        (("state", 0, "name"), "rates", r"state\[0\].name is 'rates'"),
        (("action", "frame"), "FRD", "action.frame is 'FRD'"),
        (("action", "unit"), ["g"] * 3, "action.unit"),
        (("image", "encoding"), "depth", "image.encoding is 'depth'"),
        (("image", "near_m"), 20.0, r"image.near_m is 20 m, allowed is below image.far_m \(10 m"),
        (("image", "far_m"), 5000.0, "here: image.far_m is 5000.0, allowed is 0.1 to 1000"),
        (("image", "shape"), [24, 2000], r"here: image.shape\[-1\] is 2000"),
        (("image", "rays"), 0, "here: image.rays is 0"),
        (("memory",), [4, 0], r"here: memory is \[4, 0\], allowed are sizes of 1 and more"),
        (
            ("action", "scale"),
            [2.0, 3.0],
            r"action.scale is \[2.0, 3.0\], allowed are 1 or 3",
        ),
        (("action", "kind"), "velocity", "unknown kind of action 'velocity'"),
    ],
)
def test_what_the_suite_does_not_provide_is_refused_by_its_place(path, value, said):
    data = json.loads(contract_of(PolicySpec()).text)
    del data["digest"]
    part = data
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(PolicyError, match=said):
        spec_of(read_contract(json.dumps(data), "here"), "here")


def test_one_number_as_scale_counts_for_all_components():
    contract = contract_of(PolicySpec(action=ActionSpec(scale=(20.0,))))
    data = contract.to_json()
    del data["digest"]
    data["action"] |= {"scale": [20.0], "offset": [0.0]}
    assert read_contract(data, "here") == contract


def test_a_contract_changed_by_hand_or_of_another_version_is_refused():
    data = contract_of(PolicySpec()).to_json()
    with pytest.raises(PolicyError, match="changed by hand"):
        read_contract({**data, "rate_hz": 50.0}, "here")
    for key, value, said in (("version", 2, "version is 2"), ("rate", 1, "'rate' at the top is"),
                             ("rate_hz", "fast", "rate_hz is 'fast'")):  # fmt: skip
        with pytest.raises(PolicyError, match=said):
            read_contract({**data, key: value}, "here")


def test_memories_differ_only_where_both_are_known():
    spec = PolicySpec()
    refuse_differences(contract_of(spec), contract_of(spec, (3,)), "here", "that")
    with pytest.raises(PolicyError, match=r"memory \(3,\), that \(4,\)"):
        refuse_differences(contract_of(spec, (3,)), contract_of(spec, (4,)), "here", "that")


class Counting(torch.nn.Module):
    """Counts its steps in a memory of two rows, as that of an LSTM."""

    def forward(
        self, state: torch.Tensor, image: torch.Tensor, hidden: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return hidden[:, 1, :3], hidden + 1.0


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_the_memory_of_a_script_is_that_of_its_contract(tmp_path, in_process):
    path = tmp_path / "it.pt"
    text = contract_of(PolicySpec(), (2, 4)).text
    torch.jit.save(torch.jit.script(Counting()), str(path), _extra_files={KEY: text})
    policy = load_policy(path, trust=True)
    hidden = policy.start(2)
    for step in range(2):
        inputs = np.ones((2, 12)), np.ones((2, 24, 32)), np.zeros(2, bool)
        action, hidden = policy.act(hidden, *inputs)
        assert hidden.shape == (2, 2, 4) and (action == step).all()
    extra = {KEY: contract_of(PolicySpec(), (2**9, 2**9)).text}
    torch.jit.save(torch.jit.script(Counting()), str(path), _extra_files=extra)
    with pytest.raises(PolicyError, match=r"\[512, 512\], allowed are up to 65536 numbers"):
        load_policy(path, trust=True)
    torch.jit.save(torch.jit.script(Counting()), str(path))  # its memory has no size
    with pytest.raises(PolicyError, match=r"given a hidden of 192 numbers; set hidden_size in the"):
        load_policy(path, trust=True)
