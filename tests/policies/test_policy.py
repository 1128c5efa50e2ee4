"""`load_policy` finds what is meant, and says what to do where it cannot."""

import shutil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policies import shipped
from policies.policy import load_policy
from policies.spec import PolicyError


@pytest.fixture
def shelf(tmp_path, checkpoint, monkeypatch):
    """A shelf of shipped policies that holds one, "race-paper"."""
    shutil.copytree(checkpoint, tmp_path / "race-paper")
    monkeypatch.setattr(shipped, "_HERE", tmp_path)


def test_a_shipped_policy_is_found_by_name(shelf):
    assert shipped.names() == ["race-paper"]
    assert load_policy("race-paper").name == "race-paper"
    with pytest.raises(KeyError):
        shipped.folder("../racer")


def test_an_unknown_name_is_told_the_nearest(shelf):
    with pytest.raises(PolicyError, match="unknown policy 'race-papr'. Did you mean 'race-paper'"):
        load_policy("race-papr")


def test_a_missing_file_is_told_the_nearest_beside(exported):
    with pytest.raises(PolicyError, match=r"no such file.*Did you mean .*tiny\.onnx"):
        load_policy(exported / "tny.onnx")
    with pytest.raises(PolicyError, match="no such file or folder"):
        load_policy(exported / "nowhere" / "x.onnx")


def test_a_trainings_folder_is_told_where_its_policy_is(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path / "run" / "policy")
    with pytest.raises(PolicyError, match=r"run: a training's folder; its policy is .*run/policy$"):
        load_policy(tmp_path / "run")


def test_a_file_inside_a_checkpoint_and_other_kinds_are_pointed_on(checkpoint, tmp_path):
    with pytest.raises(PolicyError, match="give its folder"):
        load_policy(checkpoint / "weights.safetensors")
    (tmp_path / "policy.pkl").write_bytes(b"")
    with pytest.raises(PolicyError, match=r"allowed are .*\.onnx"):
        load_policy(tmp_path / "policy.pkl")
    with pytest.raises(PolicyError, match=r"config\.json: missing"):
        load_policy(tmp_path)


@settings(max_examples=4, deadline=None)
@given(file=st.sampled_from(["tiny.pt2", "tiny.onnx"]), keep=st.floats(0, 0.999))
def test_a_file_cut_anywhere_is_refused_by_name(exported, tmp_path_factory, file, keep):
    path = tmp_path_factory.mktemp("cut") / file
    data = (exported / file).read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(PolicyError) as caught:
        load_policy(path, trust=True)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", shipped.names() or [None])
def test_what_is_shipped_is_whole_small_and_has_its_card(name):
    if name is None:
        return
    folder = shipped.folder(name)
    assert load_policy(name).name == name
    assert (folder / "card.md").read_text().strip()
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5_000_000
