"""The contract comes back from its JSON, finds what differs, and travels in every file."""

import dataclasses
import json
import os

import numpy as np
import onnx
import pytest
import torch

from policies.block_policy import BlockPolicy
from policies.contract import KEY, contract_of, read_contract, refuse_differences, spec_of
from policies.formats.export import export_module
from policies.formats.policy_file import load_policy_checkpoint
from policies.formats.spec_json import KEY as SPEC_KEY
from policies.policy import load_policy
from policies.spec import ActionSpec, DepthEncoding, PolicyError, PolicySpec
from tests.support.policy_files import action_of

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
        (("image", "near_m"), 20.0, "depth.near is 20 m"),
        (("memory",), [5000], r"here: memory\[0\] is 5000"),
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


def test_it_travels_in_checkpoint_onnx_and_torch_with_where_it_comes_from(checkpoint, exported):
    spec = load_policy_checkpoint(checkpoint).spec
    digest = contract_of(spec).digest
    stored = json.loads((checkpoint / "config.json").read_text())[KEY]
    assert read_contract(stored, "config").memory == (64,)
    props = onnx.load(exported / "tiny.onnx").metadata_props
    extra = dict.fromkeys((KEY, SPEC_KEY), "")
    torch.export.load(exported / "tiny.pt2", extra_files=extra)
    for texts in ({each.key: each.value for each in props}, extra):
        assert read_contract(texts[KEY], "here").digest == digest
        data = json.loads(texts[SPEC_KEY])
        assert {"schema", "suite_version", "git_commit", "seed", "name", "spec"} <= data.keys()
        assert (data["name"], data["seed"]) == ("tiny", 1)


class Module(torch.nn.Module):
    """Answers with three numbers of the state, the image's mean and what BatchNorm makes of it."""

    def __init__(self, norm=False, size=3):
        super().__init__()
        self.norm, self.size = torch.nn.BatchNorm1d(12) if norm else None, size

    def forward(self, state, image):
        state = state if self.norm is None else self.norm(state)
        return state[:, : self.size] + image.mean((1, 2))[:, None]


def test_a_module_flies_in_evaluation_mode_with_the_contract_it_was_exported_with(tmp_path):
    spec = PolicySpec(rate_hz=50.0, action=ActionSpec(scale=(20.0,)))
    module = Module(norm=True).train()
    policy = load_policy(export_module(module, tmp_path / "it.onnx", contract_of(spec)))
    assert policy.spec == spec and isinstance(policy, BlockPolicy) and not policy.notes
    assert module.training
    action = spec.action.to_si(action_of(policy, np.ones((1, 12))))
    np.testing.assert_allclose(action, 20.0, rtol=1e-4)  # the norm divides by sqrt(1 + 1e-5)


def test_an_export_that_does_not_fit_its_contract_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="output 'action' is float32 .*4"):
        export_module(Module(size=4), tmp_path / "it.onnx", PolicySpec())
    path = export_module(Module(), tmp_path / "it.onnx", PolicySpec())
    good, unusable = path.read_bytes(), Module(norm=True)
    torch.nn.init.constant_(unusable.norm.weight, torch.nan)
    for module, name, said in (
        (Module(size=4), "it.onnx", f"{path}: output 'action'"),
        (unusable, "it.onnx", f"{path}: the module's actions are NaN or infinite"),
        (Module(), "it.pt", "must end in .onnx"),
    ):
        with pytest.raises(PolicyError, match=said):
            export_module(module, tmp_path / name, PolicySpec())
        assert path.read_bytes() == good and os.listdir(tmp_path) == ["it.onnx"]
    proto = onnx.load(tmp_path / "it.onnx")
    ctbr = contract_of(PolicySpec(action=ActionSpec("ctbr")))
    onnx.helper.set_model_props(proto, {KEY: ctbr.text})
    onnx.save(proto, tmp_path / "it.onnx")
    with pytest.raises(PolicyError, match=r"'state' has shape .*expected \(batch, 13\)"):
        load_policy(tmp_path / "it.onnx")


def test_weights_without_a_program_are_named(tmp_path):
    torch.save(Module().state_dict(), tmp_path / "it.pt")
    with pytest.raises(PolicyError, match="weights without a program"):
        load_policy(tmp_path / "it.pt", trust=True)
