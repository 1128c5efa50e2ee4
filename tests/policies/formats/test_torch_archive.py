"""A .pt2 file can run code when torch loads it; none of the ways is open without trust."""

import contextlib
import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch

from policies.errors import PolicyError
from policies.policy import load_policy

PROGRAM = "models/model.json"
WEIGHTS = "data/weights/model_weights_config.json"
CONSTANTS = "data/constants/model_constants_config.json"
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


def edit(name, change):
    def on(files):
        data = json.loads(files[name])
        change(data)
        files[name] = json.dumps(data).encode()

    return on


class Payload:
    """A pickle that makes a folder when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def pickled(value):
    buffer = io.BytesIO()
    torch.save(value, buffer, pickle_module=pickle)
    return buffer.getvalue()


def test_pickled_sample_inputs_never_reach_torch(exported, tmp_path):
    mark = tmp_path / "it_ran"
    path = rewrite(
        exported / "tiny.pt2",
        tmp_path / "bad.pt2",
        lambda files: files.update({SAMPLES: pickled((Payload(mark),))}),
    )
    load_policy(path)
    assert not mark.exists()
    with contextlib.suppress(PolicyError):
        load_policy(path, trust=True)
    assert mark.exists(), "the attack itself does not work, so this test shows nothing"


def node(data, i=0):
    return data["graph_module"]["graph"]["nodes"][i]


def set_target(target):
    return edit(PROGRAM, lambda data: node(data).update(target=target))


def pickle_weight(name):
    def change(files):
        data = json.loads(files[name])
        first = next(iter(data["config"].values()))
        first["use_pickle"] = True
        files[name] = json.dumps(data).encode()

    return change


def add_constant(path_name):
    entry = {"path_name": path_name, "is_param": False, "use_pickle": False, "tensor_meta": None}
    return edit(CONSTANTS, lambda data: data["config"].update({"x": entry}))


def expression(text):
    def change(data):
        values = data["graph_module"]["graph"]["tensor_values"]
        values["state"]["sizes"][0] = {"as_expr": {"expr_str": text, "hint": None}}

    return edit(PROGRAM, change)


def rename_input(text):
    def change(files):
        files[PROGRAM] = files[PROGRAM].replace(b'"state"', json.dumps(text).encode())

    return change


def out_spec(text):
    def change(data):
        data["graph_module"]["module_call_graph"][0]["signature"]["out_spec"] = text

    return edit(PROGRAM, change)


def argument(kind, value):
    return edit(PROGRAM, lambda data: node(data)["inputs"][0].update(arg={kind: value}))


CODE = "__import__('os').system('true')"
ENUM = '[1, {"type": "builtins.dict", "context": "{\\"__enum__\\": true}", "children_spec": []}]'


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_target("torch.os.system"), "operator 'torch.os.system'"),
        (set_target("torch.ops.aten.from_file.default"), "operator 'torch.ops.aten.from_file"),
        (set_target("torch.ops.mine.op.default"), "operator 'torch.ops.mine"),
        (set_target("torch.ops.aten.add.Tensor.__globals__"), "operator"),
        (set_target("_operator.methodcaller"), "operator '_operator.methodcaller'"),
        (set_target("_operator.add.__class__.x"), "operator"),
        (set_target("#mine:x"), "operator"),
        (set_target(["torch"]), "operator"),
        (pickle_weight(WEIGHTS), "pickled"),
        (add_constant("custom_obj_0"), "pickled or an object"),
        (add_constant("opaque_obj_0"), "pickled or an object"),
        (add_constant("../weights/weight_0"), "plain name|pickled"),
        (add_constant("tensor_0"), "tensor_0 is missing"),
        (expression(CODE), "expr_str"),
        (expression("Symbol('s0', positive=True).func"), "expr_str"),
        (rename_input(f"state={CODE}"), "plain name"),
        (rename_input("state\n"), "plain name"),
        (out_spec(ENUM), "out_spec"),
        (argument("as_operator", "torch.os.system"), "'as_operator' is not allowed"),
        (argument("as_string", "');" + CODE), "as_string"),
        (argument("as_graph", {"name": "g"}), "'as_graph' is not allowed"),
    ],
)
def test_what_could_run_code_is_refused(exported, tmp_path, change, said):
    path = rewrite(exported / "tiny.pt2", tmp_path / "bad.pt2", change)
    with pytest.raises(PolicyError, match=said) as caught:
        load_policy(path)
    assert str(path) in str(caught.value)


def test_guards_are_dropped_and_libraries_are_not_unpacked(exported, tmp_path):
    def change(files):
        edit(PROGRAM, lambda data: data.update(guards_code=[CODE]))(files)
        files["data/aotinductor/model/lib.so"] = b"\x7fELF"

    load_policy(rewrite(exported / "tiny.pt2", tmp_path / "odd.pt2", change))


DEEP = b'{"a":' + b"[" * 5000 + b"]" * 5000 + b"}"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda files: files.pop(PROGRAM), "model.json is missing"),
        (lambda files: files.pop(WEIGHTS), "config.json is missing"),
        (lambda files: files.pop("data/weights/weight_0"), "weight_0 is missing"),
        (lambda files: files.update({PROGRAM: b"{"}), "not JSON"),
        (lambda files: files.update({PROGRAM: b"[]"}), "expected an object"),
        (lambda files: files.update({PROGRAM: b"{}"}), "cannot load it"),
        (
            lambda files: files.update({PROGRAM: b'{"a":' + b"[" * 5000 + b"]" * 5000 + b"}"}),
            "deep",
        ),
        (lambda files: files.update({WEIGHTS: b'{"config": []}'}), "cannot load it"),
        (lambda files: files.update({"data/weights/weight_0": b"abc"}), "cannot load it"),
        (lambda files: files.update({"extra/policy.json": b"{"}), "policy.json: not JSON"),
        (lambda files: files.update({"extra/policy.json": b'{"schema": 9}'}), "schema 1"),
        (
            lambda files: files.update({"extra/policy.json": b'{"spec": {"rate": 1}}'}),
            "unknown key 'rate'",
        ),
    ],
)
def test_a_damaged_archive_is_refused(exported, tmp_path, change, said):
    path = rewrite(exported / "tiny.pt2", tmp_path / "bad.pt2", change)
    with pytest.raises(PolicyError, match=said):
        load_policy(path)


def test_an_archive_that_unpacks_to_too_much_is_refused(exported, tmp_path, monkeypatch):
    from policies.formats import torch_archive

    monkeypatch.setattr(torch_archive, "MAX_BYTES", 1000)
    with pytest.raises(PolicyError, match="unpacks to"):
        load_policy(exported / "tiny.pt2")


class Everything(torch.nn.Module):
    """Layers that people's policies are made of."""

    def __init__(self):
        super().__init__()
        self.encoder = torch.nn.Sequential(
            torch.nn.Conv2d(1, 4, 3, stride=2, padding=1),
            torch.nn.BatchNorm2d(4),
            torch.nn.ELU(),
            torch.nn.AdaptiveAvgPool2d(2),
            torch.nn.Flatten(),
        )
        self.mlp = torch.nn.Sequential(
            torch.nn.Linear(28, 16), torch.nn.LayerNorm(16), torch.nn.SiLU(), torch.nn.Dropout(0.1)
        )
        self.gru = torch.nn.GRU(16, 8)
        self.head = torch.nn.Linear(8, 6)

    def forward(self, state, image, hidden):
        features = self.mlp(torch.cat([state, self.encoder(image[:, None])], -1))
        out, hidden = self.gru(features[None], hidden[None].contiguous())
        mean, spread = self.head(out[0]).chunk(2, -1)
        return torch.tanh(mean) * 20.0 * torch.exp(spread).clamp(max=1.0), hidden[0]


@pytest.mark.filterwarnings("ignore:The tensor attributes:UserWarning")
def test_common_layers_pass_and_answer_as_torch_does(tmp_path):
    module = Everything().eval()
    inputs = (torch.randn(2, 12), torch.randn(2, 24, 32), torch.randn(2, 8))
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(module, inputs, dynamic_shapes=(batch, batch, batch))
    torch.export.save(program, tmp_path / "it.pt2")
    policy = load_policy(tmp_path / "it.pt2")
    state, image, hidden = (x.numpy() for x in inputs)
    found = policy.act(hidden, state, image, np.zeros(2, bool))
    with torch.no_grad():
        for mine, theirs in zip(found, module(*inputs), strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-5)
