"""Torch's files can run code when torch loads them: refused without trust, checked with it."""

import contextlib
import io
import json
import os
import pickle
import re
import zipfile

import numpy as np
import pytest
import torch

from policies.block_policy import BlockPolicy
from policies.formats.spec_json import KEY
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError
from tests.support.policy_files import action_of

PROGRAM = "models/model.json"
WEIGHTS = "data/weights/model_weights_config.json"
SAMPLES = "data/sample_inputs/model.pt"


def rewrite(source, target, change):
    """Copy an archive with `change(files)` done to its entries by name."""
    with zipfile.ZipFile(source) as archive:
        top = archive.namelist()[0].partition("/")[0]
        files = {n.partition("/")[2]: archive.read(n) for n in archive.namelist()}
    change(files)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in files.items():
            archive.writestr(f"{top}/{name}", data)
    return target


class Payload:
    """A pickle that makes a folder when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_without_trust_nothing_of_a_file_reaches_torch(exported, tmp_path, in_process):
    mark, pickled = tmp_path / "it_ran", io.BytesIO()
    torch.save((Payload(mark),), pickled, pickle_module=pickle)
    bad = {SAMPLES: pickled.getvalue()}
    path = rewrite(exported / "tiny.pt2", tmp_path / "bad.pt2", lambda files: files.update(bad))
    with pytest.raises(PolicyError, match=r"bad\.pt2: .*any code.*--trust.*\.onnx"):
        load_policy(path)
    assert not mark.exists()
    with contextlib.suppress(PolicyError):
        load_policy(path, trust=True)
    assert mark.exists(), "the attack itself does not work, so this test shows nothing"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda files: files.pop(PROGRAM), "cannot load it"),
        (lambda files: files.pop("data/weights/weight_0"), "cannot load it"),
        (lambda files: files.update({PROGRAM: b"{}"}), "cannot load it"),
        (lambda files: files.update({WEIGHTS: b'{"config": []}'}), "cannot load it"),
        (lambda files: files.update({"data/weights/weight_0": b"abc"}), "cannot load it"),
        (lambda files: files.update({"extra/policy.json": b"{"}), "policy.json: not JSON"),
    ],
)
def test_a_damaged_archive_is_refused(exported, tmp_path, change, said, in_process):
    path = rewrite(exported / "tiny.pt2", tmp_path / "bad.pt2", change)
    with pytest.raises(PolicyError, match=said) as caught:
        load_policy(path, trust=True)
    assert str(path) in str(caught.value)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(PolicyError, match=re.escape(str(path))):
        load_policy(path, trust=True)


def module(forward):
    """Return a module with this method."""
    return type("Module", (torch.nn.Module,), {"forward": forward})()


def reactive(self, state, image):
    """Answer without a memory."""
    return state[:, 6:9] - state[:, 0:3] + 0.0 * image.mean((1, 2))[:, None]


def program(folder, model, *inputs, free=True):
    """Save a module as a torch exported program."""
    dynamic = tuple({0: torch.export.Dim("batch")} for _ in inputs) if free else None
    made = torch.export.export(model, inputs, dynamic_shapes=dynamic)
    torch.export.save(made, folder / "it.pt2")
    return folder / "it.pt2"


def zeros(rows, *more):
    return (torch.zeros(rows, 12), torch.zeros(rows, 24, 32), *more)


@pytest.mark.parametrize(("rows", "free"), [(2, True), (5, False), (1, False)])
def test_a_policy_without_memory_and_of_any_batch_flies(tmp_path, rows, free, in_process):
    policy = load_policy(program(tmp_path, module(reactive), *zeros(rows), free=free), trust=True)
    assert isinstance(policy, BlockPolicy)
    assert policy.block == (64 if free else rows)
    state = np.random.default_rng(0).normal(size=(7, 12)).astype(np.float32)
    np.testing.assert_array_equal(action_of(policy, state), state[:, 6:9] - state[:, :3])
    assert policy.hidden_shape == (0,)


@pytest.mark.parametrize(
    ("forward", "inputs", "said"),
    [
        (lambda self, obs, image: obs[:, :3], zeros(2), "inputs are obs, image; expected state"),
        (lambda self, state, image: (state[:, :3], state), zeros(2), "gives 2 outputs"),
        (
            lambda self, state, image, hidden: state[:, :3] + hidden[:, :3],
            zeros(2, torch.zeros(2, 4)),
            "gives 1 outputs",
        ),
        (reactive, (torch.zeros(2, 13), torch.zeros(2, 24, 32)), r"'state'.*\(batch, 12\)"),
    ],
)
def test_a_program_that_does_not_fit_is_told_what_does(tmp_path, forward, inputs, said, in_process):
    with pytest.raises(PolicyError, match=said):
        load_policy(program(tmp_path, module(forward), *inputs), trust=True)


class Failing(torch.nn.Module):
    """Answers, but for states that are far from those it was tried with."""

    def forward(self, state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        if state.max() > 1e3:
            raise ValueError("too far")
        return state[:, :3]


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_torchscript_needs_trust_and_flies_on_after_a_failure(tmp_path):
    path, spec = tmp_path / "it.pt", json.dumps({"spec": {"rate_hz": 50.0}})
    torch.jit.save(torch.jit.script(Failing()), str(path), _extra_files={KEY: spec})
    with pytest.raises(PolicyError, match="TorchScript can run any code.*--trust"):
        load_policy(path)
    policy = load_policy(path, trust=True)
    assert policy.spec.rate_hz == 50.0
    with pytest.raises(NoAnswer, match="it.pt: fails while it runs .*too far") as refused:
        action_of(policy, np.full((2, 12), 1e4))
    assert len(str(refused.value).splitlines()) == 1
    np.testing.assert_array_equal(action_of(policy, np.ones((2, 12))), np.ones((2, 3)))


def test_answers_are_those_of_torch_here_to_the_bit(exported):
    """In a process of its own a program gives what it gives in this one, with one thread."""
    policy = load_policy(exported / "tiny.pt2", trust=True)
    assert isinstance(policy, BlockPolicy)
    module = torch.export.load(exported / "tiny.pt2").module(check_guards=False)
    rng = np.random.default_rng(3)
    inputs = [rng.normal(size=s).astype(np.float32) for s in ((64, 12), (64, 24, 32), (64, 64))]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.inference_mode():
        wanted = module(*map(torch.from_numpy, inputs))
    torch.set_num_threads(threads)
    for mine, theirs in zip(policy.model(*inputs), wanted, strict=True):
        assert mine.tobytes() == theirs.numpy().tobytes()
