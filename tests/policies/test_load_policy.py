"""`load_policy` finds what is meant, and says what to do where it cannot."""

import json
import shutil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from policies import shipped
from policies.block_policy import BlockPolicy
from policies.errors import PolicyError
from policies.formats.embedded_spec import KEY
from policies.policy import load_policy


@pytest.fixture
def shelf(tmp_path, checkpoint, monkeypatch):
    """A shelf of shipped policies that holds one, "racer"."""
    shutil.copytree(checkpoint, tmp_path / "racer")
    monkeypatch.setattr(shipped, "_HERE", tmp_path)


def test_a_shipped_policy_is_found_by_name(shelf):
    assert shipped.names() == ["racer"]
    assert load_policy("racer").name == "racer"
    with pytest.raises(KeyError):
        shipped.folder("../racer")


def test_an_unknown_name_is_told_the_nearest(shelf):
    with pytest.raises(PolicyError, match="unknown policy 'racr'. Did you mean 'racer'"):
        load_policy("racr")


def test_a_missing_file_is_told_the_nearest_beside(exported):
    with pytest.raises(PolicyError, match=r"no such file.*Did you mean .*tiny\.onnx"):
        load_policy(exported / "tny.onnx")
    with pytest.raises(PolicyError, match="no such file or folder"):
        load_policy(exported / "nowhere" / "x.onnx")


def test_a_file_inside_a_checkpoint_and_other_kinds_are_pointed_on(checkpoint, tmp_path):
    with pytest.raises(PolicyError, match="give its folder"):
        load_policy(checkpoint / "weights.safetensors")
    (tmp_path / "policy.pkl").write_bytes(b"")
    with pytest.raises(PolicyError, match=r"allowed are .*\.onnx"):
        load_policy(tmp_path / "policy.pkl")
    with pytest.raises(PolicyError, match=r"config\.json: missing"):
        load_policy(tmp_path)


@settings(max_examples=25, deadline=None)
@given(file=st.sampled_from(["tiny.pt2", "tiny.onnx"]), keep=st.floats(0, 0.999))
def test_a_file_cut_anywhere_is_refused_by_name(exported, tmp_path_factory, file, keep):
    path = tmp_path_factory.mktemp("cut") / file
    data = (exported / file).read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(PolicyError) as caught:
        load_policy(path, trust=True)
    assert str(path) in str(caught.value)


class Reactive(torch.nn.Module):
    """A policy without memory."""

    def forward(self, state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return the action."""
        return state[:, 6:9] - state[:, 0:3] + 0.0 * image.mean((1, 2))[:, None]


def program(folder, module, *shapes, free=True):
    inputs = tuple(torch.zeros(shape) for shape in shapes)
    batch = torch.export.Dim("batch")
    dynamic = tuple({0: batch} for _ in shapes) if free else None
    made = torch.export.export(module, inputs, dynamic_shapes=dynamic)
    torch.export.save(made, folder / "it.pt2")
    return folder / "it.pt2"


@pytest.mark.parametrize(("rows", "free"), [(2, True), (5, False), (1, False)])
def test_a_policy_without_memory_and_of_any_batch_flies(tmp_path, rows, free):
    path = program(tmp_path, Reactive(), (rows, 12), (rows, 24, 32), free=free)
    policy = load_policy(path, trust=True)
    assert isinstance(policy, BlockPolicy)
    assert policy.block == (64 if free else rows)
    state = np.random.default_rng(0).normal(size=(7, 12)).astype(np.float32)
    image = np.zeros((7, 24, 32), np.float32)
    action, hidden = policy.act(policy.start(7), state, image, np.zeros(7, bool))
    np.testing.assert_array_equal(action, state[:, 6:9] - state[:, :3])
    assert hidden.shape == (7, 0)


class Renamed(torch.nn.Module):
    def forward(self, obs, image):
        return obs[:, :3]


class TooMany(torch.nn.Module):
    def forward(self, state, image):
        return state[:, :3], state


class TooFew(torch.nn.Module):
    def forward(self, state, image, hidden):
        return state[:, :3] + hidden[:, :3]


@pytest.mark.parametrize(
    ("module", "shapes", "said"),
    [
        (Renamed(), [(2, 12), (2, 24, 32)], "inputs are obs, image; expected state, image"),
        (TooMany(), [(2, 12), (2, 24, 32)], "gives 2 outputs"),
        (TooFew(), [(2, 12), (2, 24, 32), (2, 4)], "gives 1 outputs"),
        (Reactive(), [(2, 13), (2, 24, 32)], r"'state' has shape .*13.*expected \(batch, 12\)"),
        (Reactive(), [(2, 12), (2, 32, 24)], r"expected \(batch, 24, 32\)"),
    ],
)
def test_a_program_that_does_not_fit_is_told_what_does(tmp_path, module, shapes, said):
    with pytest.raises(PolicyError, match=said):
        load_policy(program(tmp_path, module, *shapes), trust=True)


def test_torchscript_needs_trust_and_then_flies(tmp_path):
    path = tmp_path / "it.pt"
    spec = json.dumps({"spec": {"rate_hz": 50.0}})
    with pytest.warns(DeprecationWarning):
        torch.jit.save(torch.jit.script(Reactive()), str(path), _extra_files={KEY: spec})
    with pytest.raises(PolicyError, match="TorchScript can run any code.*--trust"):
        load_policy(path)
    policy = load_policy(path, trust=True)
    assert policy.spec.rate_hz == 50.0
    state = np.ones((2, 12), np.float32)
    action, _ = policy.act(policy.start(2), state, np.zeros((2, 24, 32)), np.zeros(2, bool))
    np.testing.assert_array_equal(action, np.zeros((2, 3)))


def test_a_pickled_module_is_no_torchscript_even_with_trust(tmp_path):
    torch.save({"weights": torch.zeros(1)}, tmp_path / "it.pt")
    with pytest.raises(PolicyError, match="cannot load it"):
        load_policy(tmp_path / "it.pt", trust=True)


@pytest.mark.parametrize("name", shipped.names() or [None])
def test_what_is_shipped_is_whole_small_and_has_its_card(name):
    if name is None:
        return
    folder = shipped.folder(name)
    assert load_policy(name).name == name
    assert (folder / "card.md").read_text().strip()
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5_000_000
