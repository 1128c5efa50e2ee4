"""The checkpoint, the torch program and the ONNX file are one policy, layer for layer."""

import json
import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch

from policies.formats.export import export_policy
from policies.formats.onnx_graph import IR_VERSION, OPSET, onnx_model
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.formats.spec_json import KEY
from policies.policy import load_policy
from policies.spec import PolicyError
from tests.support.policy_files import SPEC, lively


def rollout(policy, n, steps):
    """Actions of a recurrent rollout of random observations, (steps, n, 3)."""
    rng = np.random.default_rng(7)
    hidden, actions = policy.start(n), []
    for _ in range(steps):
        state = rng.normal(size=(n, policy.spec.state_size)).astype(np.float32)
        image = rng.uniform(-0.3, 9.4, (n, 24, 32)).astype(np.float32)
        action, hidden = policy.act(hidden, state, image, rng.random(n) < 0.1)
        actions.append(action)
    return np.stack(actions)


def test_the_three_are_equal_over_a_rollout(checkpoint, exported, in_process):
    ours = rollout(load_policy(checkpoint), 70, 12)
    assert np.abs(ours).std() > 1.0
    for file in ("tiny.pt2", "tiny.onnx"):
        policy = load_policy(exported / file, trust=file.endswith(".pt2"))
        assert policy.spec == SPEC
        np.testing.assert_allclose(rollout(policy, 70, 12), ours, atol=5e-5, rtol=1e-5)


def test_a_checkpoint_that_says_no_seed_is_exported_without_one(tmp_path, checkpoint):
    folder = shutil.copytree(checkpoint, tmp_path / "tiny")
    config = json.loads((folder / "config.json").read_text())
    del config["seed"]
    (folder / "config.json").write_text(json.dumps(config))
    assert load_policy_checkpoint(folder).seed is None
    export_policy(folder, tmp_path, ["onnx", "c"])
    entries = onnx.load(tmp_path / "tiny.onnx").metadata_props
    text = next(entry.value for entry in entries if entry.key == KEY)
    assert json.loads(text)["seed"] is None


def test_plain_torch_and_plain_onnxruntime_run_the_files_at_any_batch(exported):
    import onnxruntime

    program = torch.export.load(exported / "tiny.pt2").module()
    session = onnxruntime.InferenceSession(exported / "tiny.onnx")
    assert [v.name for v in session.get_outputs()] == ["action", "hidden_next"]
    for n in (1, 3):
        feed = {"state": (n, 12), "image": (n, 24, 32), "hidden": (n, 64)}
        feed = {name: np.ones(shape, np.float32) for name, shape in feed.items()}
        by_torch = program(*(torch.from_numpy(value) for value in feed.values()))
        by_onnx = session.run(None, feed)
        for a, b in zip(by_torch, by_onnx, strict=True):
            np.testing.assert_allclose(a.numpy(), np.asarray(b), atol=2e-5, rtol=1e-5)


def test_what_cannot_be_exported_is_refused(tmp_path, checkpoint, exported):
    with pytest.raises(PolicyError, match="not a shipped policy"):
        export_policy(exported / "tiny.onnx", tmp_path)
    with pytest.raises(ValueError, match="unknown format 'onx'. Did you mean 'onnx'"):
        export_policy(checkpoint, tmp_path, ["onx"])
    assert list(tmp_path.iterdir()) == []


def test_policies_of_other_inputs_and_sizes_are_one_policy_as_well(tmp_path, in_process):
    more = dict.fromkeys(("second_gate", "gate_axis", "second_axis"), True)
    spec = replace(SPEC, **more, channels=(6, 64, 32))
    folder = save_policy(tmp_path / "other", lively(spec, 3), spec, seed=1)
    ours = load_policy(folder)
    assert ours.spec == spec
    expected = rollout(ours, 70, 5)
    assert np.abs(expected).std() > 1.0
    for path in export_policy(folder, tmp_path):
        theirs = load_policy(path, trust=True)
        assert theirs.spec == spec
        np.testing.assert_allclose(rollout(theirs, 70, 5), expected, atol=5e-5, rtol=1e-5)


def test_it_asks_for_old_standard_operators_only_and_carries_its_texts(params):
    model = onnx_model(params, SPEC, {"key": "text"})
    assert model.ir_version == IR_VERSION <= 8
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)] and OPSET <= 17
    assert {node.domain for node in model.graph.node} == {""}
    assert [(p.key, p.value) for p in model.metadata_props] == [("key", "text")]
