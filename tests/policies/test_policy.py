"""Policies by name, their contracts, and that every export is one policy, layer for layer."""

import hashlib
import json
import os
import shutil
import sys
from dataclasses import replace

import gymnasium
import jax
import numpy as np
import onnx
import pytest
import torch

from eval.envs.gymnasium_env import ID
from policies import shipped
from policies.block_policy import BlockPolicy
from policies.contract import KEY, contract_of, read_contract
from policies.formats.export import export_module, export_policy
from policies.formats.onnx_graph import IR_VERSION, OPSET, onnx_model
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.formats.spec_json import KEY as SPEC_KEY
from policies.networks import network
from policies.policy import check_is_policy, load_policy
from policies.spec import ActionSpec, PolicyError, PolicySpec
from suite.cli import main
from tests.support.marks import more
from tests.support.policy_files import SPEC, action_of, lively
from tests.support.tools import program, python


@pytest.fixture
def shelf(tmp_path, checkpoint, monkeypatch):
    """A shelf of shipped policies that holds one, "race-paper"."""
    shutil.copytree(checkpoint, tmp_path / "race-paper")
    monkeypatch.setattr(shipped, "_HERE", tmp_path)


def test_a_shipped_policy_is_found_by_name_and_another_told_the_nearest(shelf, exported):
    assert shipped.names() == ["race-paper"]
    assert load_policy("race-paper").name == "race-paper"
    with pytest.raises(PolicyError, match="unknown policy 'race-papr'. Did you mean 'race-paper'"):
        load_policy("race-papr")
    with pytest.raises(PolicyError, match=r"no such file.*Did you mean .*tiny\.onnx"):
        load_policy(exported / "tny.onnx")
    with pytest.raises(PolicyError, match="no such file or folder"):
        load_policy(exported / "nowhere" / "x.onnx")
    with pytest.raises(PolicyError, match="give --policy once for each"):
        load_policy("race,race-small")
    with pytest.raises(PolicyError, match=r"no checkpoint, but a folder with .*tiny\.onnx"):
        load_policy(exported)


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


def test_the_policy_of_a_stopped_training_has_a_note(checkpoint, tmp_path, capsys):
    stored = load_policy_checkpoint(checkpoint)
    for done in (48, 600):
        training = {"iteration": done, "config": {"optimizer": {"iterations": 600}}}
        folder = tmp_path / f"{done}"
        save_policy(folder, stored.params, stored.spec, seed=1, training=training)
        notes = load_policy(folder).notes
        assert [note.fault for note in notes] == ["training_unfinished"] * (done == 48)
        assert done == 600 or "stopped after 48 of 600 gradient steps" in notes[0].evidence
    unfinished, out = str(tmp_path / "48"), ["--out", str(tmp_path / "out")]
    for asked, code in (
        (["export", "--policy", unfinished, "--format", "onnx"], 0),
        (["train", "--init-from", unfinished], 2),  # its inputs are not those of the recipe
    ):
        assert main([*asked, *out]) == code
        assert "stopped after 48 of 600 gradient steps; repeat" in capsys.readouterr().err


@pytest.mark.parametrize("name", shipped.names())
def test_what_is_shipped_is_whole_small_and_has_its_card(name):
    folder = shipped.locate(name)
    assert load_policy(name).name == name
    assert (folder / "card.md").read_text().strip()
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5_000_000


@pytest.mark.extended
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


@pytest.mark.extended
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
    one_thread = python(script, checkpoint, check=True, env=os.environ | {"XLA_FLAGS": flags})
    policy, rng = load_policy(checkpoint), np.random.default_rng(0)
    state, image = rng.normal(size=(64, 12)), rng.normal(size=(64, 24, 32))
    answer = policy.act(policy.start(64), state, image, np.ones(64, bool))
    digest = hashlib.sha256(b"".join(part.tobytes() for part in answer)).hexdigest()
    assert one_thread.stdout == f"{digest} 64\n"


def test_it_travels_in_checkpoint_onnx_and_torch_with_where_it_comes_from(checkpoint, exported):
    spec = load_policy_checkpoint(checkpoint).spec
    digest = contract_of(spec, (64,)).digest
    stored = json.loads((checkpoint / "config.json").read_text())[KEY]
    assert read_contract(stored, "config").digest == digest
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
    module.norm.eval()
    policy = load_policy(export_module(module, tmp_path / "it.onnx", contract_of(spec)))
    assert policy.spec == spec and isinstance(policy, BlockPolicy) and not policy.notes
    assert module.training and not module.norm.training, "a frozen part stays frozen"
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


def test_an_export_names_an_argument_of_another_type(tmp_path):
    for args, said in (
        ((3, PolicySpec()), "module is 3, allowed is a torch.nn.Module"),
        ((Module(), gymnasium_spec()), "trained_under is EnvSpec.*allowed is env.unwrapped.contra"),
        ((Module(), PolicySpec(), 3), "memory is 3, allowed is a shape such as"),
    ):
        with pytest.raises(ValueError, match=said):
            export_module(args[0], tmp_path / "it.onnx", *args[1:])
    assert not list(tmp_path.iterdir())


def gymnasium_spec():
    """Return what `env.spec` is in gymnasium, which is no `PolicySpec`."""
    return gymnasium.spec(ID)


def test_weights_without_a_program_are_named(tmp_path):
    torch.save(Module().state_dict(), tmp_path / "it.pt")
    os.link(tmp_path / "it.pt", tmp_path / "it.pt2")
    for name in ("it.pt", "it.pt2"):
        with pytest.raises(PolicyError, match="weights without a program"):
            load_policy(tmp_path / name, trust=True)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_torch_file_with_the_suffix_of_another_kind_is_named(exported, tmp_path):
    torch.jit.save(torch.jit.script(Module()), str(tmp_path / "it.pt2"))
    os.link(exported / "tiny.pt2", tmp_path / "tiny.pt")
    for name, said in (
        ("it.pt2", "this file is TorchScript; rename it to it.pt$"),
        ("tiny.pt", "this file is a torch exported program; rename it to tiny.pt2$"),
    ):
        with pytest.raises(PolicyError, match=said):
            load_policy(tmp_path / name, trust=True)


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


WIDER = replace(SPEC, second_gate=True, gate_axis=True, second_axis=True, channels=(6, 64, 32))


@pytest.mark.parametrize("spec", [more(SPEC), WIDER])
def test_the_three_are_equal_over_a_rollout(spec, tmp_path, in_process):
    folder = save_policy(tmp_path / "it", lively(spec, 3), spec, seed=1)
    ours = load_policy(folder)
    expected = rollout(ours, 70, 12)
    assert ours.spec == spec and np.abs(expected).std() > 1.0
    for path in export_policy(folder, tmp_path):
        theirs = load_policy(path, trust=True)
        assert theirs.spec == spec
        np.testing.assert_allclose(rollout(theirs, 70, 12), expected, atol=5e-5, rtol=1e-5)


def test_a_checkpoint_that_says_no_seed_is_exported_without_one(tmp_path, checkpoint):
    folder = shutil.copytree(checkpoint, tmp_path / "tiny")
    config = json.loads((folder / "config.json").read_text())
    del config["seed"]
    (folder / "config.json").write_text(json.dumps(config))
    assert load_policy_checkpoint(folder).seed is None
    export_policy(folder, tmp_path, ["onnx", "c"])
    entries = onnx.load(tmp_path / "tiny.onnx").metadata_props
    text = next(entry.value for entry in entries if entry.key == SPEC_KEY)
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


def test_it_asks_for_old_standard_operators_only_and_carries_its_texts(params):
    model = onnx_model(params, SPEC, {"key": "text"})
    assert model.ir_version == IR_VERSION <= 8
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)] and OPSET <= 17
    assert {node.domain for node in model.graph.node} == {""}
    assert [(p.key, p.value) for p in model.metadata_props] == [("key", "text")]


class _Aim:
    """Flies towards the gate."""

    name, spec = "aim", PolicySpec()

    def start(self, n):
        return None

    def act(self, hidden, state, image, fresh):
        return state[:, 6:9], hidden


def test_a_class_and_methods_with_other_arguments_are_refused_before_a_flight():
    class NoFresh(_Aim):
        def act(self, hidden, state, image):
            return state[:, 6:9], hidden

    class NoCount(_Aim):
        def start(self):
            return None

    check_is_policy(_Aim())
    for wrong, said in (
        (_Aim, r"policy _Aim is a class; give an object, such as _Aim\(\); a policy object has"),
        (
            NoFresh(),
            r"its act\(hidden, state, image\) takes other arguments .*act\(hidden, .*fresh\)",
        ),
        (NoCount(), r"its start\(\) takes other arguments .* start\(n\)"),
    ):
        with pytest.raises(PolicyError, match=said):
            check_is_policy(wrong)
