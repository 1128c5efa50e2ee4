"""Models that do not come to an end, abort or ask for all memory end themselves and not us."""

import gc
import os
import signal
import subprocess
import sys
import time

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from policies.formats import model_process as process
from policies.formats.model_process import ModelProcess
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError

FLOAT = TensorProto.FLOAT


def _proto(nodes, tensors=(), outputs=None, rows="n"):
    inputs = [
        helper.make_tensor_value_info("state", FLOAT, (rows, 12)),
        helper.make_tensor_value_info("image", FLOAT, (rows, 24, 32)),
    ]
    outputs = outputs or [helper.make_tensor_value_info("action", FLOAT, (rows, 3))]
    graph = helper.make_graph(nodes, "g", inputs, outputs, list(tensors))
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


W = numpy_helper.from_array(np.eye(12, 3, dtype=np.float32), "w")

PLAIN = _proto([helper.make_node("MatMul", ["state", "w"], ["action"])], [W])


def _endless(start, rounds="rounds"):
    """Return nodes and tensors of a loop of 2^62 rounds over `start`, added to the action."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go_in"], ["go_out"]),
            helper.make_node("Sin", ["x_in"], ["x_out"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, ()),
            helper.make_tensor_value_info("go_in", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("x_in", FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_out", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("x_out", FLOAT, None),
        ],
    )
    nodes = [
        helper.make_node("MatMul", ["state", "w"], ["u"]),
        helper.make_node("Loop", [rounds, "go", start], ["x"], body=body),
        helper.make_node("ReduceMax", ["x"], ["most"], keepdims=0),
        helper.make_node("Add", ["u", "most"], ["action"]),
    ]
    tensors = [
        W,
        numpy_helper.from_array(np.array(2**62, np.int64), "rounds"),
        numpy_helper.from_array(np.array(True), "go"),
        numpy_helper.from_array(np.ones(3, np.float32), "constant"),
    ]
    return _proto(nodes, tensors)


def _save(folder, proto):
    path = folder / "it.onnx"
    onnx.save(proto, path)
    return path


@pytest.mark.parametrize("start", ["constant", "state"])
def test_a_loop_without_an_end_is_refused_in_time(start, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "LOAD_S", 2.0)
    monkeypatch.setattr(process, "ANSWER_S", 1.0)
    path = _save(tmp_path, _endless(start))
    began = time.monotonic()
    with pytest.raises(PolicyError, match="it.onnx: onnxruntime does not come to an end with it"):
        load_policy(path)
    assert time.monotonic() - began < 8.0


def test_the_process_ends_itself_where_its_parent_is_gone(monkeypatch):
    monkeypatch.setattr(process, "GRACE_S", -1.5)
    monkeypatch.setattr(process, "ANSWER_S", 2.0)
    model = ModelProcess(_endless("state").SerializeToString(), "it", "onnx")
    with pytest.raises(PolicyError, match="it ended by SIGALRM"):
        model.run({"state": np.ones((1, 12)), "image": np.ones((1, 24, 32))})


@pytest.mark.parametrize("rows", [0, 10**6])
def test_a_batch_of_none_or_of_millions_is_refused(rows, tmp_path):
    path = _save(tmp_path, _proto(PLAIN.graph.node, [W], rows=rows))
    with pytest.raises(PolicyError, match="allowed are batches of 1 to 4096 rows|cannot load it"):
        load_policy(path)


def test_a_model_that_wants_all_memory_is_refused(tmp_path):
    """2^34 numbers, worked out of two small ones."""
    nodes = [
        helper.make_node("Expand", ["state", "large"], ["x"]),
        helper.make_node("ReduceMax", ["x"], ["most"], keepdims=0),
        helper.make_node("MatMul", ["state", "w"], ["u"]),
        helper.make_node("Add", ["u", "most"], ["action"]),
    ]
    large = numpy_helper.from_array(np.array([2**24, 1, 12], np.int64), "large")
    with pytest.raises(PolicyError, match="it.onnx: .*(fails while it runs|come to an end)"):
        load_policy(_save(tmp_path, _proto(nodes, [W, large])))


def test_a_limit_that_this_process_is_under_stays_the_models(tmp_path):
    path = tmp_path / "policy.onnx"
    onnx.save(PLAIN, path)
    # Below what the engine has already and may have besides.
    script = (
        "import resource, sys\n"
        "from policies.formats.model_process import ModelProcess, MEMORY_BYTES\n"
        "resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))\n"
        "print(ModelProcess(open(sys.argv[1], 'rb').read(), 'here', 'onnx').inputs[0].name)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["state"], done.stderr


def test_a_model_that_fails_while_it_runs_is_one_line(tmp_path):
    nodes = [
        helper.make_node("Reshape", ["state", "shape"], ["x"]),
        helper.make_node("MatMul", ["x", "w"], ["action"]),
    ]
    shape = numpy_helper.from_array(np.array([7, 12], np.int64), "shape")
    with pytest.raises(PolicyError, match="it.onnx: fails while it runs") as refused:
        load_policy(_save(tmp_path, _proto(nodes, [W, shape])))
    assert len(str(refused.value).splitlines()) == 1


def test_a_process_that_dies_is_told_of_and_one_that_is_not_needed_ends():
    model = ModelProcess(PLAIN.SerializeToString(), "it", "onnx")
    feed = {"state": np.ones((2, 12)), "image": np.ones((2, 24, 32))}
    np.testing.assert_array_equal(model.run(feed)[0], np.ones((2, 3)))
    child = model._process.pid
    os.kill(child, signal.SIGABRT)
    with pytest.raises(PolicyError, match="it ended by SIGABRT"):
        model.run(feed)
    other = ModelProcess(PLAIN.SerializeToString(), "it", "onnx")
    child = other._process.pid
    del other
    gc.collect()
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_after_a_question_without_an_answer_the_next_goes_to_a_fresh_process(monkeypatch):
    monkeypatch.setattr(process, "ANSWER_S", 0.5)
    model = ModelProcess(PLAIN.SerializeToString(), "it", "onnx")
    feed = {"state": np.ones((2, 12)), "image": np.ones((2, 24, 32))}
    stopped = model._process.pid
    os.kill(stopped, signal.SIGSTOP)
    with pytest.raises(NoAnswer, match="was not answered within 0.5 s"):
        model.run(feed)
    with pytest.raises(ProcessLookupError):
        os.kill(stopped, 0)
    np.testing.assert_array_equal(model.run(feed)[0], np.ones((2, 3)))
