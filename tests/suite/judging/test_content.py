"""A policy as the content of its files: its digest, and the same answers where they are not."""

import numpy as np
import pytest

from policies import shipped
from policies.policy import load_policy
from policies.spec import PolicyError
from suite.judging.content import PolicyContent, policy_digest
from tracks.common.work.pickling import pack, unpack


def answers(policy):
    rng, spec = np.random.default_rng(0), policy.spec
    state = rng.normal(size=(64, spec.state_size)).astype(np.float32)
    image = rng.random((64, spec.camera.height, spec.camera.width)).astype(np.float32)
    return policy.act(policy.start(64), state, image, np.ones(64, bool))[0]


def test_a_policy_that_came_as_content_keeps_its_name_and_is_the_same_without_its_files(tmp_path):
    folder = tmp_path / "my.policy"
    folder.mkdir()
    for name in ("config.json", "weights.safetensors", "card.md"):
        (folder / name).write_bytes((shipped.folder("race-paper") / name).read_bytes())
    content = PolicyContent.of(folder)
    assert [name for name, _ in content.files] == ["config.json", "weights.safetensors"]
    packed, expected = pack(content), answers(load_policy(folder))
    for path in folder.iterdir():
        path.unlink()
    found = unpack(packed)()
    assert found.name == "my.policy" and unpack(packed)() is found, "loaded once"
    assert np.array_equal(answers(found), expected)
    (tmp_path / "policy.h").write_text("a header")
    (tmp_path / "policy.c").write_text("a program")
    content = PolicyContent.of(tmp_path / "policy.c")
    assert (content.name, content.file) == (tmp_path.name, "policy.c")
    assert [name for name, _ in content.files] == ["policy.h", "policy.c"]
    with pytest.raises(PolicyError, match="trust"):
        content()


def test_a_digest_changes_with_any_byte_of_what_flies_and_no_other(tmp_path):
    folder, seen = tmp_path / "p", []
    folder.mkdir()
    for name, text in (("config.json", "{}"), ("config.json", "{ }"), ("weights.safetensors", "a")):
        (folder / name).write_text(text)
        seen.append(policy_digest(str(folder)))
    assert len(set(seen)) == 3
    (folder / "card.md").write_text("words")
    assert policy_digest(str(folder)) == seen[-1]
    path, seen = onnx_file(tmp_path), []
    for scale in (1, 2):
        (tmp_path / "w.bin").write_bytes(np.full(300, scale, np.float32).tobytes())
        seen.append(policy_digest(str(path)))
    assert len(set(seen)) == 2


def test_an_onnx_file_behind_a_link_comes_with_its_weights(tmp_path):
    folder = tmp_path / "real"
    folder.mkdir()
    path = onnx_file(folder)
    (tmp_path / "there").symlink_to(folder)
    (tmp_path / "mine.onnx").symlink_to(path)
    whole = {name: (folder / name).read_bytes() for name in ("it.onnx", "w.bin")}
    content = PolicyContent.of(tmp_path / "there" / "it.onnx")
    assert (content.name, content.file, dict(content.files)) == ("real", "it.onnx", whole)
    content = PolicyContent.of(tmp_path / "mine.onnx")
    assert content.file == "mine.onnx"
    assert dict(content.files) == {"mine.onnx": whole["it.onnx"], "w.bin": whole["w.bin"]}


def onnx_file(folder):
    """Write it.onnx with its weights beside it in w.bin; return its path."""
    onnx = pytest.importorskip("onnx")
    weights = onnx.numpy_helper.from_array(np.ones(300, np.float32), "w")
    node = onnx.helper.make_node("Identity", ["w"], ["action"])
    graph = onnx.helper.make_graph([node], "g", [], [], [weights])
    path = folder / "it.onnx"
    onnx.save(
        onnx.helper.make_model(graph), path,
        save_as_external_data=True, location="w.bin", size_threshold=0,
    )  # fmt: skip
    return path
