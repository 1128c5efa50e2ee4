"""Models that do not come to an end, abort or ask for all memory end themselves and not us."""

import gc
import os
import signal
import time

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from policies.formats import model_process as process
from policies.formats.model_process import ModelProcess
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError
from tests.support.marks import more
from tests.support.policy_files import WEIGHT, onnx_model, port, save_onnx
from tests.support.tools import python

PRODUCT = helper.make_node("MatMul", ["state", "w"], ["u"])
FEED = {"state": np.ones((2, 12)), "image": np.ones((2, 24, 32))}


def plain():
    return ModelProcess(onnx_model().SerializeToString(), "it", "onnx")


def tensor(name, value):
    return numpy_helper.from_array(np.array(value), name)


def endless(start):
    """Return a model with a loop of 2^62 rounds over `start`, added to the action."""
    number, flag = TensorProto.INT64, TensorProto.BOOL
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go_in"], ["go_out"]),
            helper.make_node("Sin", ["x_in"], ["x_out"]),
        ],
        "body",
        [port("i", kind=number), port("go_in", kind=flag), no_shape("x_in")],
        [port("go_out", kind=flag), no_shape("x_out")],
    )
    nodes = [
        PRODUCT,
        helper.make_node("Loop", ["rounds", "go", start], ["x"], body=body),
        helper.make_node("ReduceMax", ["x"], ["most"], keepdims=0),
        helper.make_node("Add", ["u", "most"], ["action"]),
    ]
    constant = tensor("constant", np.ones(3, np.float32))
    return onnx_model(nodes, [WEIGHT, tensor("rounds", 2**62), tensor("go", True), constant])


def no_shape(name):
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, None)


@pytest.mark.parametrize("start", [more("constant"), "state"])
def test_a_loop_without_an_end_is_refused_in_time(start, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "LOAD_S", 2.0)
    monkeypatch.setattr(process, "ANSWER_S", 1.0)
    path = save_onnx(tmp_path, endless(start))
    began = time.monotonic()
    with pytest.raises(PolicyError, match="it.onnx: .*gave no answer within .* loops"):
        load_policy(path)
    assert time.monotonic() - began < 8.0


def test_the_process_ends_itself_where_its_parent_is_gone(monkeypatch):
    monkeypatch.setattr(process, "GRACE_S", -1.5)
    monkeypatch.setattr(process, "ANSWER_S", 2.0)
    model = ModelProcess(endless("state").SerializeToString(), "it", "onnx")
    with pytest.raises(PolicyError, match="onnxruntime ended by SIGALRM"):
        model.run({"state": np.ones((1, 12)), "image": np.ones((1, 24, 32))})


@pytest.mark.parametrize("rows", [0, 10**6])
def test_a_batch_of_none_or_of_millions_is_refused(rows, tmp_path):
    path = save_onnx(tmp_path, onnx_model(rows=rows))
    with pytest.raises(PolicyError, match="allowed are batches of 1 to 4096 rows|cannot load it"):
        load_policy(path)


def test_a_model_that_wants_all_memory_is_refused(tmp_path):
    """6.4 GB of numbers, worked out of two small ones, where 4 GB are allowed."""
    nodes = [
        helper.make_node("Expand", ["state", "large"], ["x"]),
        helper.make_node("ReduceMax", ["x"], ["most"], keepdims=0),
        PRODUCT,
        helper.make_node("Add", ["u", "most"], ["action"]),
    ]
    path = save_onnx(tmp_path, onnx_model(nodes, [WEIGHT, tensor("large", [2**21, 1, 12])]))
    with pytest.raises(PolicyError, match="it.onnx: .*(fails while it runs|ended by|ended with)"):
        load_policy(path)


def test_a_limit_that_this_process_is_under_stays_the_models(tmp_path):
    path = save_onnx(tmp_path, onnx_model())
    # Below what the engine has already and may have besides.
    script = (
        "import resource, sys\n"
        "from policies.formats.model_process import ModelProcess, MEMORY_BYTES\n"
        "resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))\n"
        "print(ModelProcess(open(sys.argv[1], 'rb').read(), 'here', 'onnx').inputs[0].name)"
    )
    done = python(script, path)
    assert done.stdout.split() == ["state"], done.stderr


def test_after_a_death_or_no_answer_the_next_question_goes_to_a_fresh_process(monkeypatch):
    model = plain()
    np.testing.assert_array_equal(model.run(FEED)[0], np.ones((2, 3)))
    os.kill(model._process.pid, signal.SIGABRT)
    with pytest.raises(PolicyError, match="the process that runs it .*ended by SIGABRT; repeat"):
        model.run(FEED)
    np.testing.assert_array_equal(model.run(FEED)[0], np.ones((2, 3)))
    monkeypatch.setattr(process, "ANSWER_S", 0.5)
    stopped = model._process.pid
    os.kill(stopped, signal.SIGSTOP)
    with pytest.raises(NoAnswer, match="no answer within 0.5 s: the machine is busy, or"):
        model.run(FEED)
    with pytest.raises(ProcessLookupError):
        os.kill(stopped, 0)


def test_a_process_that_is_not_needed_ends():
    model = plain()
    child = model._process.pid
    del model
    gc.collect()
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
