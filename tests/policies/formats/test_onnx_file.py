"""ONNX from elsewhere: standard operators, data inside the folder, the observation's inputs."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from policies.block_policy import BlockPolicy
from policies.formats import onnx_file
from policies.formats.onnx_file import files_of
from policies.formats.program_inputs import check_inputs
from policies.policy import load_policy
from policies.spec import PolicyError, PolicySpec

FLOAT = TensorProto.FLOAT


def value(name, *shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def model(nodes, inputs=None, outputs=None, tensors=(), domains=("",), functions=()):
    inputs = inputs or [value("state", "n", 12), value("image", "n", 24, 32)]
    outputs = outputs or [value("action", "n", 3)]
    graph = helper.make_graph(nodes, "g", inputs, outputs, list(tensors))
    opsets = [helper.make_opsetid(domain, 17 if domain == "" else 1) for domain in domains]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8, functions=list(functions))


MATRIX = numpy_helper.from_array(np.eye(12, 3, dtype=np.float32), "w")

PRODUCT = helper.make_node("MatMul", ["state", "w"], ["action"])


def save(folder, proto):
    onnx.save(proto, folder / "it.onnx")
    return folder / "it.onnx"


def refused(path, said):
    with pytest.raises(PolicyError, match=said) as caught:
        load_policy(path)
    assert str(path) in str(caught.value)


def test_an_input_that_the_exporter_dropped_is_reported_and_the_policy_flies(tmp_path):
    policy = load_policy(
        save(tmp_path, model([PRODUCT], [value("state", "n", 12)], None, [MATRIX]))
    )
    state = np.ones((1, 12), np.float32)
    action, _ = policy.act(policy.start(1), state, np.zeros((1, 24, 32)), np.zeros(1, bool))
    assert isinstance(policy, BlockPolicy)
    assert (action == 1).all() and "no input 'image'" in str(policy.notes)


@pytest.mark.parametrize("rows", ["n", 5, 1])
def test_a_policy_without_memory_and_of_any_batch_flies(tmp_path, rows):
    inputs = [value("image", rows, 24, 32), value("state", rows, 12)]
    path = save(tmp_path, model([PRODUCT], inputs, [value("u", rows, 3)], [MATRIX]))
    proto = onnx.load(path)
    proto.graph.output[0].name = proto.graph.node[0].output[0] = "u"
    policy = load_policy(save(tmp_path, proto))
    state = np.random.default_rng(0).normal(size=(7, 12)).astype(np.float32)
    image = np.zeros((7, 24, 32), np.float32)
    action, _ = policy.act(policy.start(7), state, image, np.zeros(7, bool))
    np.testing.assert_array_equal(action, state[:, :3])


def test_custom_operators_are_refused_also_inside_branches(tmp_path):
    custom = helper.make_node("Evil", ["state"], ["action"], domain="com.evil")
    refused(save(tmp_path, model([custom], domains=("", "com.evil"))), "domain 'com.evil'")
    inner = helper.make_graph([custom], "inner", [], [value("action", "n", 3)])
    branch = helper.make_node("If", ["flag"], ["action"], then_branch=inner, else_branch=inner)
    flag = numpy_helper.from_array(np.array(True), "flag")
    refused(save(tmp_path, model([branch], tensors=[flag], domains=("", "com.evil"))), "'com.evil'")
    refused(save(tmp_path, model([helper.make_node("Evil", ["state"], ["action"])])), "standard")


def function(name, op, domain=""):
    nodes = [helper.make_node(op, ["x"], ["y"], domain=domain)]
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("local", 1)]
    return helper.make_function("local", name, ["x"], ["y"], nodes, opsets)


def test_local_functions_are_inlined_and_endless_ones_refused(tmp_path):
    nodes = [helper.make_node("F", ["state"], ["up"], domain="local"),
             helper.make_node("MatMul", ["up", "w"], ["action"])]  # fmt: skip

    def with_functions(*functions):
        return model(nodes, tensors=[MATRIX], domains=("", "local"), functions=functions)

    policy = load_policy(save(tmp_path, with_functions(function("F", "Abs"))))
    state = np.full((1, 12), -2.0, np.float32)
    action, _ = policy.act(policy.start(1), state, np.zeros((1, 24, 32)), np.zeros(1, bool))
    np.testing.assert_array_equal(action, [[2, 2, 2]])
    loop = with_functions(function("F", "G", "local"), function("G", "F", "local"))
    refused(write_raw(tmp_path / "it.onnx", loop), "calls itself")
    doubling = [function(f"F{k}", f"F{k + 1}", "local") for k in range(20)]
    for each in doubling:
        each.node.append(helper.make_node(each.node[0].op_type, ["y"], ["z"], domain="local"))
    doubling[0].name = "F"
    proto = with_functions(*doubling, function("F20", "Abs"))
    refused(write_raw(tmp_path / "it.onnx", proto), "more than 100000 operators")


def external(*locations, **entries):
    """A model whose one tensor lies at the last of `locations`, with more `entries` of where."""
    tensor = TensorProto()
    tensor.CopyFrom(MATRIX)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for location in locations:
        tensor.external_data.add(key="location", value=location)
    for key, entry in entries.items():
        tensor.external_data.add(key=key, value=str(entry))
    return model([PRODUCT], tensors=[tensor])


def write_raw(path, proto):
    path.write_bytes(proto.SerializeToString())
    return path


def test_data_beside_the_file_is_read_and_outside_it_is_refused(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for place in (folder / "w.bin", tmp_path / "w.bin"):
        place.write_bytes(MATRIX.raw_data)
    path = write_raw(folder / "it.onnx", external("w.bin"))
    policy = load_policy(path)
    state = np.ones((1, 12), np.float32)
    action, _ = policy.act(policy.start(1), state, np.zeros((1, 24, 32)), np.zeros(1, bool))
    np.testing.assert_array_equal(action, [[1, 1, 1]])
    for location in ("../w.bin", str(tmp_path / "w.bin"), ""):
        refused(write_raw(path, external(location)), "outside the file's folder")
    refused(write_raw(path, external("none.bin")), "missing")
    assert files_of(write_raw(path, external("w.bin"))) == [path, folder / "w.bin"]
    (folder / "link.bin").symlink_to(tmp_path / "w.bin")
    refused(write_raw(path, external("link.bin")), "outside the file's folder")


def test_of_a_place_that_stands_twice_the_last_is_taken_as_by_onnx(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "w.bin").write_bytes(MATRIX.raw_data)
    path = write_raw(folder / "it.onnx", external("none.bin", "w.bin"))
    assert files_of(path) == [path, folder / "w.bin"]
    assert load_policy(path).name == "it.onnx"
    (tmp_path / "w.bin").write_bytes(MATRIX.raw_data)
    refused(write_raw(path, external("w.bin", "../w.bin")), "outside the file's folder")


def test_a_file_of_many_tensors_counts_once_and_bytes_of_many_tensors_count_each(
    tmp_path, monkeypatch
):
    tensors = []
    for k in range(8):
        (tensor,) = external("w.bin", offset=k * len(MATRIX.raw_data),
                             length=len(MATRIX.raw_data)).graph.initializer  # fmt: skip
        tensor.name = "w" if k == 0 else f"w{k}"
        tensors.append(tensor)
    data = MATRIX.raw_data * len(tensors)
    (tmp_path / "w.bin").write_bytes(data)
    path = write_raw(tmp_path / "it.onnx", model([PRODUCT], tensors=tensors))
    monkeypatch.setattr(onnx_file, "MODEL_BYTES", path.stat().st_size + len(data))
    assert load_policy(path).name == "it.onnx"
    for tensor in tensors:
        del tensor.external_data[1:]
    refused(write_raw(path, model([PRODUCT], tensors=tensors)), "bytes with its data, allowed")
    tensors[0].external_data.add(key="offset", value="none")
    monkeypatch.undo()
    refused(write_raw(path, model([PRODUCT], tensors=tensors)), "breaks the ONNX standard")


def test_a_file_that_is_too_large_is_refused(exported, monkeypatch):
    monkeypatch.setattr(onnx_file, "MODEL_BYTES", 1000)
    refused(exported / "tiny.onnx", "allowed are up to 1000")


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ([value("obs", "n", 12)], "inputs are obs; expected state, image, hidden"),
        ([value("state", "n", 12), value("image", "n", 1, 24, 32)], "24, 32"),
        (
            [value("state", "n", 12), value("image", "n", 24, 32), value("hidden", "n", 4)],
            "outputs are action; expected the action and",
        ),
        (
            [value("state", "n", 12), value("image", "n", 24, 32, kind=TensorProto.DOUBLE)],
            r"'image' is tensor\(double\)",
        ),
    ],
)
def test_inputs_that_are_no_observation_are_refused(tmp_path, inputs, said):
    node = helper.make_node("MatMul", [inputs[0].name, "w"], ["action"])
    refused(save(tmp_path, model([node], inputs, tensors=[MATRIX])), said)


def test_a_model_that_breaks_the_standard_is_refused(tmp_path):
    broken = helper.make_node("MatMul", ["state", "nowhere"], ["action"])
    refused(write_raw(tmp_path / "it.onnx", model([broken])), "breaks the ONNX standard")
    (tmp_path / "it.onnx").write_bytes(b"\xff" * 100)
    refused(tmp_path / "it.onnx", "not a complete ONNX file")
    (tmp_path / "it.onnx").write_bytes(b"")
    refused(tmp_path / "it.onnx", "it.onnx")


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
        ({"state": (2, 12), "image": (3, 24, 32)}, "the first axis of each must be the batch"),
        ({"state": STATE, "image": IMAGE, "hidden": ("batch", "n")}, "must have fixed sizes"),
        ({"state": STATE, "image": IMAGE, "hidden": ("batch",)}, "must have fixed sizes"),
        ({"state": ("batch", 15), "image": IMAGE}, r"'state' .* expected \(batch, 12\)"),
        ({"state": STATE, "image": ("batch", 32, 24)}, r"'image' .* expected \(batch, 24, 32\)"),
        ({"state": STATE, "image": ("batch", 768)}, r"expected \(batch, 24, 32\)"),
    ],
)
def test_what_is_no_observation_is_refused(shapes, said):
    with pytest.raises(PolicyError, match=f"^here: .*{said}"):
        check_inputs(shapes, PolicySpec(), "here")


def test_the_spec_sets_the_states_size():
    wider = PolicySpec(second_gate=True, gate_axis=True)
    assert check_inputs({"state": ("batch", 18), "image": IMAGE}, wider, "here") == (64, (0,))
    with pytest.raises(
        PolicyError, match=r"expected \(batch, 18\); .* second_gate, gate_axis, second_axis, speed"
    ):
        check_inputs({"state": STATE, "image": IMAGE}, wider, "here")
