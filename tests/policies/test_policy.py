"""`load_policy` finds what is meant; a checkpoint and its parameters fly alike."""

import hashlib
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from policies import shipped
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.native import load_native, native_policy
from policies.networks import network
from policies.policy import load_policy
from policies.spec import PolicyError
from tests.support.policy_files import SPEC
from tests.support.tools import program


@pytest.fixture
def shelf(tmp_path, checkpoint, monkeypatch):
    """A shelf of shipped policies that holds one, "race-paper"."""
    shutil.copytree(checkpoint, tmp_path / "race-paper")
    monkeypatch.setattr(shipped, "_HERE", tmp_path)


def test_a_shipped_policy_is_found_by_name_and_another_told_the_nearest(shelf, exported):
    assert shipped.names() == ["race-paper"]
    assert load_policy("race-paper").name == "race-paper"
    with pytest.raises(KeyError):
        shipped.folder("../racer")
    with pytest.raises(PolicyError, match="unknown policy 'race-papr'. Did you mean 'race-paper'"):
        load_policy("race-papr")
    with pytest.raises(PolicyError, match=r"no such file.*Did you mean .*tiny\.onnx"):
        load_policy(exported / "tny.onnx")
    with pytest.raises(PolicyError, match="no such file or folder"):
        load_policy(exported / "nowhere" / "x.onnx")


def test_a_trainings_folder_is_told_where_its_policy_is(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path / "run" / "policy")
    with pytest.raises(PolicyError, match="the folder of a training; give its .*run/policy$"):
        load_policy(tmp_path / "run")


def test_a_file_inside_a_checkpoint_and_other_kinds_are_pointed_on(checkpoint, tmp_path):
    with pytest.raises(PolicyError, match="give its folder"):
        load_policy(checkpoint / "weights.safetensors")
    (tmp_path / "policy.pkl").write_bytes(b"")
    with pytest.raises(PolicyError, match=r"allowed are .*\.onnx"):
        load_policy(tmp_path / "policy.pkl")
    with pytest.raises(PolicyError, match=r"config\.json: missing"):
        load_policy(tmp_path)


@pytest.mark.parametrize("name", shipped.names())
def test_what_is_shipped_is_whole_small_and_has_its_card(name):
    folder = shipped.folder(name)
    assert load_policy(name).name == name
    assert (folder / "card.md").read_text().strip()
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5_000_000


def test_a_policy_is_shipped_with_another_usual_speed(tmp_path, monkeypatch, root):
    spec = replace(SPEC, speed_input=True)
    save_policy(tmp_path / "run/policy", network.init(jax.random.key(0), spec), spec, seed=1)
    ship = program(root / "tools/ship.py")
    monkeypatch.setattr(ship, "SHELF", tmp_path)
    monkeypatch.setattr(ship, "card", lambda *_: "a card")
    monkeypatch.setattr(ship, "curves_chart", lambda _: b"")
    monkeypatch.setattr(sys, "argv", ["ship", str(tmp_path / "run"), "--speed", "0.85"])
    ship.main()
    assert load_policy_checkpoint(tmp_path / "race").spec == replace(spec, speed=0.85)


def test_a_checkpoint_is_named_and_flies_as_its_parameters_do(checkpoint, params):
    loaded, made = load_native(checkpoint, "tiny"), native_policy(params, SPEC, "tiny")
    assert (loaded.name, loaded.spec, loaded.hidden_shape) == ("tiny", SPEC, (64,))
    rng = np.random.default_rng(0)
    state = rng.normal(size=(3, 12)).astype(np.float32)
    image = rng.uniform(-0.3, 9.4, (3, 24, 32)).astype(np.float32)
    fresh = np.ones(3, bool)
    answers = [policy.act(policy.start(3), state, image, fresh) for policy in (loaded, made)]
    for one, two in zip(*answers, strict=True):
        assert one.tobytes() == two.tobytes()
    expected, _ = jax.jit(network.step)(params, made.start(3), state, image)
    np.testing.assert_allclose(answers[0][0], expected, atol=1e-5, rtol=1e-5)


def test_thread_counts_do_not_change_our_network(checkpoint):
    """XLA's pool may split the work any way; the bits have to stay."""
    script = (
        "import sys, hashlib, numpy as np\n"
        "from policies.policy import load_policy\n"
        "p, r = load_policy(sys.argv[1]), np.random.default_rng(0)\n"
        "s, i = r.normal(size=(64, 12)), r.normal(size=(64, 24, 32))\n"
        "a, h = p.act(p.start(64), s, i, np.ones(64, bool))\n"
        "print(hashlib.sha256(a.tobytes() + h.tobytes()).hexdigest(), p.rows)\n"
    )
    flags = f"{os.environ['XLA_FLAGS']} --xla_cpu_multi_thread_eigen=false"
    one_thread = subprocess.run(
        [sys.executable, "-c", script, str(checkpoint)], capture_output=True, text=True, check=True,
        env=os.environ | {"XLA_FLAGS": flags},
    )  # fmt: skip
    policy, rng = load_policy(checkpoint), np.random.default_rng(0)
    state, image = rng.normal(size=(64, 12)), rng.normal(size=(64, 24, 32))
    answer = policy.act(policy.start(64), state, image, np.ones(64, bool))
    digest = hashlib.sha256(b"".join(part.tobytes() for part in answer)).hexdigest()
    assert one_thread.stdout == f"{digest} 64\n"
