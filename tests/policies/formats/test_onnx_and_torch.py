"""Models from elsewhere: ONNX of standard operators, torch only with trust, inputs that fit."""

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
from onnx import TensorProto, helper, numpy_helper

from policies import contract
from policies.block_policy import BlockPolicy
from policies.contract import contract_of
from policies.formats import onnx_file
from policies.formats.onnx_file import files_of
from policies.formats.program_inputs import check_inputs
from policies.formats.spec_json import KEY
from policies.policy import load_policy
from policies.spec import ActionSpec, NoAnswer, PolicyError, PolicySpec
from tests.support.policy_files import WEIGHT, action_of, onnx_model, port, save_onnx

ONES = np.ones((1, 12), np.float32)


def refused(path, said):
    with pytest.raises(PolicyError, match=said) as caught:
        load_policy(path)
    assert str(path) in str(caught.value)


def test_an_input_that_the_exporter_dropped_is_reported_and_the_policy_flies(tmp_path):
    policy = load_policy(save_onnx(tmp_path, onnx_model(inputs=[port("state", "n", 12)])))
    assert isinstance(policy, BlockPolicy)
    assert (action_of(policy, ONES) == 1).all() and "no input 'image'" in str(policy.notes)


@pytest.mark.parametrize("rows", ["n", 5, 1])
def test_a_policy_without_memory_and_of_any_batch_flies(tmp_path, rows):
    inputs = [port("image", rows, 24, 32), port("state", rows, 12)]
    proto = onnx_model(inputs=inputs, rows=rows)
    proto.graph.output[0].name = proto.graph.node[0].output[0] = "u"
    state = np.random.default_rng(0).normal(size=(7, 12)).astype(np.float32)
    action = action_of(load_policy(save_onnx(tmp_path, proto)), state)
    np.testing.assert_array_equal(action, state[:, :3])


def test_custom_operators_are_refused_also_inside_branches(tmp_path):
    custom = helper.make_node("Evil", ["state"], ["action"], domain="com.evil")
    inner = helper.make_graph([custom], "inner", [], [port("action", "n", 3)])
    branch = helper.make_node("If", ["flag"], ["action"], then_branch=inner, else_branch=inner)
    flag = numpy_helper.from_array(np.array(True), "flag")
    for node, tensors in ((custom, ()), (branch, [flag])):
        proto = onnx_model([node], tensors, domains=["com.evil"])
        refused(save_onnx(tmp_path, proto), "domain 'com.evil'")
    unknown = helper.make_node("Evil", ["state"], ["action"])
    refused(save_onnx(tmp_path, onnx_model([unknown], ())), "standard")


def function(name, op, domain=""):
    nodes = [helper.make_node(op, ["x"], ["y"], domain=domain)]
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("local", 1)]
    return helper.make_function("local", name, ["x"], ["y"], nodes, opsets)


def test_local_functions_are_inlined_and_endless_ones_refused(tmp_path):
    nodes = [helper.make_node("F", ["state"], ["up"], domain="local"),
             helper.make_node("MatMul", ["up", "w"], ["action"])]  # fmt: skip

    def with_functions(*functions):
        return save_onnx(tmp_path, onnx_model(nodes, domains=["local"], calls=functions))

    policy = load_policy(with_functions(function("F", "Abs")))
    np.testing.assert_array_equal(action_of(policy, -2.0 * ONES), [[2, 2, 2]])
    refused(
        with_functions(function("F", "G", "local"), function("G", "F", "local")), "calls itself"
    )
    doubling = [function(f"F{k}", f"F{k + 1}", "local") for k in range(20)]
    for each in doubling:
        each.node.append(helper.make_node(each.node[0].op_type, ["y"], ["z"], domain="local"))
    doubling[0].name = "F"
    refused(with_functions(*doubling, function("F20", "Abs")), "more than 100000 operators")


def external(*locations, **entries):
    """A model whose one tensor lies at the last of `locations`, with more `entries` of where."""
    tensor = TensorProto()
    tensor.CopyFrom(WEIGHT)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for location in locations:
        tensor.external_data.add(key="location", value=location)
    for key, entry in entries.items():
        tensor.external_data.add(key=key, value=str(entry))
    return onnx_model(tensors=[tensor])


def test_data_beside_the_file_is_read_and_outside_it_is_refused(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for place in (folder / "w.bin", tmp_path / "w.bin"):
        place.write_bytes(WEIGHT.raw_data)
    # Of a place that stands twice, the last is taken, as by onnx.
    for locations in (["w.bin"], ["none.bin", "w.bin"]):
        path = save_onnx(folder, external(*locations))
        np.testing.assert_array_equal(action_of(load_policy(path), ONES), [[1, 1, 1]])
        assert files_of(path) == [path, folder / "w.bin"]
    (folder / "link.bin").symlink_to(tmp_path / "w.bin")
    outside = (["../w.bin"], [str(tmp_path / "w.bin")], [""], ["link.bin"], ["w.bin", "../w.bin"])
    for locations in outside:
        refused(save_onnx(folder, external(*locations)), "outside the file's folder")
    refused(save_onnx(folder, external("none.bin")), "missing")


def test_a_file_of_many_tensors_counts_once_and_bytes_of_many_tensors_count_each(
    tmp_path, monkeypatch
):
    tensors = []
    for k in range(8):
        (tensor,) = external("w.bin", offset=k * len(WEIGHT.raw_data),
                             length=len(WEIGHT.raw_data)).graph.initializer  # fmt: skip
        tensor.name = "w" if k == 0 else f"w{k}"
        tensors.append(tensor)
    data = WEIGHT.raw_data * len(tensors)
    (tmp_path / "w.bin").write_bytes(data)
    path = save_onnx(tmp_path, onnx_model(tensors=tensors))
    monkeypatch.setattr(onnx_file, "MODEL_BYTES", path.stat().st_size + len(data))
    assert load_policy(path).name == "it.onnx"
    for tensor in tensors:
        del tensor.external_data[1:]
    refused(save_onnx(tmp_path, onnx_model(tensors=tensors)), "bytes with its data, allowed")
    tensors[0].external_data.add(key="offset", value="none")
    monkeypatch.undo()
    refused(save_onnx(tmp_path, onnx_model(tensors=tensors)), "breaks the ONNX standard")


def test_a_file_that_is_too_large_is_refused(exported, monkeypatch):
    monkeypatch.setattr(onnx_file, "MODEL_BYTES", 1000)
    refused(exported / "tiny.onnx", "allowed are up to 1000")


def test_inputs_and_outputs_that_do_not_fit_are_refused(tmp_path):
    state, image = port("state", "n", 12), port("image", "n", 24, 32)
    double = port("image", "n", 24, 32, kind=TensorProto.DOUBLE)
    for inputs, said in (
        ([state, image, port("hidden", "n", 4)], "gives 1 outputs, expected .* action and hidden"),
        ([state, double], r"'image' is tensor\(double\), .* export it as float32"),
    ):
        refused(save_onnx(tmp_path, onnx_model(inputs=inputs)), said)
    proto = onnx_model(inputs=[state, image, port("hidden", "n", 3)])
    proto.graph.node.add(op_type="Identity", input=["hidden"], output=["hidden_next"])
    proto.graph.output.insert(0, port("hidden_next", "n", 3))
    refused(save_onnx(tmp_path, proto), "hidden_next, action; the action must be the first")


def test_a_model_that_breaks_the_standard_is_refused(tmp_path):
    broken = helper.make_node("MatMul", ["state", "nowhere"], ["action"])
    refused(save_onnx(tmp_path, onnx_model([broken], ())), "breaks the ONNX standard")
    for data, said in ((b"\xff" * 100, "not a complete ONNX file"), (b"", "it.onnx")):
        (tmp_path / "it.onnx").write_bytes(data)
        refused(tmp_path / "it.onnx", said)


STATE, IMAGE = ("batch", 12), ("batch", 24, 32)


@pytest.mark.parametrize(
    ("shapes", "found"),
    [
        ({"state": STATE, "image": IMAGE, "hidden": ("batch", 5)}, (64, (5,))),
        ({"state": STATE, "image": IMAGE}, (64, (0,))),
        ({"state": (7, 12), "image": (7, 24, 32), "hidden": ("n", 2, 3)}, (7, (2, 3))),
        ({"state": (1, "any"), "image": (1, "height", "width")}, (1, (0,))),
    ],
)
def test_rows_and_memory_are_told_by_the_shapes(shapes, found):
    assert check_inputs(shapes, PolicySpec(), "here") == found


@pytest.mark.parametrize(
    ("shapes", "said"),
    [
        ({}, "inputs are none; expected state, image, hidden in this order"),
        ({"state": STATE, "picture": IMAGE}, "inputs are state, picture; expected state, image"),
        (dict.fromkeys(("state", "image", "h", "c"), STATE), "h, c; .*; join several memories"),
        ({"state": (2, 12), "image": (3, 24, 32)}, "the first axis of each must be the batch"),
        ({"state": STATE, "image": IMAGE, "hidden": ("batch", "n")}, "must have fixed sizes"),
        ({"state": ("batch", 15), "image": IMAGE}, r"'state' .* expected \(batch, 12\)"),
        ({"state": STATE, "image": ("batch", 32, 24)}, r"'image' .* expected \(batch, 24, 32\)"),
    ],
)
def test_what_is_no_observation_is_refused(shapes, said):
    with pytest.raises(PolicyError, match=f"^here: .*{said}"):
        check_inputs(shapes, PolicySpec(), "here")


def test_the_spec_sets_the_states_size():
    wider = PolicySpec(second_gate=True, gate_axis=True)
    assert check_inputs({"state": ("batch", 18), "image": IMAGE}, wider, "here") == (64, (0,))
    said = r"expected \(batch, 18\); .* second_gate, gate_axis, second_axis, speed"
    with pytest.raises(PolicyError, match=said):
        check_inputs({"state": STATE, "image": IMAGE}, wider, "here")
    rates = PolicySpec(action=ActionSpec("ctbr"))
    with pytest.raises(PolicyError, match="last action has 4 numbers with the kind ctbr"):
        check_inputs({"state": STATE, "image": IMAGE}, rates, "here")


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
def test_a_program_without_memory_and_of_any_batch_flies(tmp_path, rows, free, in_process):
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
            lambda self, state, image: state[:, :4],
            zeros(2),
            "an action depend on action.kind: 3 with acceleration, 4 with ctbr",
        ),
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


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_script_without_the_memory_of_its_contract_is_refused(tmp_path, in_process):
    path = tmp_path / "it.pt"
    text = contract_of(PolicySpec(), (5,)).text
    torch.jit.save(torch.jit.script(Failing()), str(path), _extra_files={contract.KEY: text})
    with pytest.raises(PolicyError, match=r"a memory of shape \[5\], its input 'hidden' has \[0\]"):
        load_policy(path, trust=True)


@pytest.mark.extended
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
