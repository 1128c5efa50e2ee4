"""Small policies of every kind of file, and a model's engine in the test's own process."""

import importlib

import jax
import numpy as np
from onnx import TensorProto, helper, numpy_helper

from policies.formats.model_process import REMEDIES, Port
from policies.formats.model_server import KINDS
from policies.formats.policy_file import save_policy
from policies.networks import network
from policies.spec import NoAnswer, PolicyError, PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=33.0, camera=Camera(pitch_deg=20.0), hidden_size=64)


def lively(spec, seed):
    """Return fresh parameters whose actions are of the size that racing has."""
    scale = {"action.weight": 20.0, "state.bias": 5.0}
    made = network.init(jax.random.key(seed), spec)
    return {name: np.asarray(value) * scale.get(name, 1.0) for name, value in made.items()}


def small_checkpoint(folder):
    """Write the checkpoint of a small policy into `folder`/tiny and return its path."""
    return save_policy(folder / "tiny", lively(SPEC, 2), SPEC, seed=1)


def action_of(policy, state):
    """Return the actions of rows of states, of images of nothing and without a memory."""
    image = np.zeros((len(state), 24, 32), np.float32)
    none = np.zeros(len(state), bool)
    return policy.act(policy.start(len(state)), np.asarray(state, np.float32), image, none)[0]


WEIGHT = numpy_helper.from_array(np.eye(12, 3, dtype=np.float32), "w")
PRODUCT = helper.make_node("MatMul", ["state", "w"], ["action"])
"""An action of the state's first three numbers."""


def port(name, *shape, kind=TensorProto.FLOAT):
    """Return an input or an output of an ONNX graph."""
    return helper.make_tensor_value_info(name, kind, shape)


def onnx_model(nodes=(PRODUCT,), tensors=(WEIGHT,), inputs=None, rows="n", domains=(), calls=()):
    """Return an ONNX model whose output is an action."""
    inputs = inputs or [port("state", rows, 12), port("image", rows, 24, 32)]
    graph = helper.make_graph(nodes, "g", inputs, [port("action", rows, 3)], list(tensors))
    opsets = [helper.make_opsetid("", 17), *(helper.make_opsetid(name, 1) for name in domains)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8, functions=list(calls))


def save_onnx(folder, proto):
    """Save an ONNX model, whether it keeps to the standard or not."""
    path = folder / "it.onnx"
    path.write_bytes(proto.SerializeToString())
    return path


class InProcess:
    """Stands for `ModelProcess`, with its answers and its words where the engine refuses."""

    def __init__(self, model, where, kind, labels=()):
        name, load = KINDS[kind]
        engine = importlib.import_module(name)
        self._where = where
        try:
            about, self._run = load(engine, model, labels)
        except Exception as error:
            raise PolicyError(
                f"{where}: {name} {engine.__version__} cannot load it ({error}); {REMEDIES[name]}"
            ) from None
        self.labels = about.get("labels", {})
        self.inputs, self.outputs = (
            [Port(port, number, tuple(shape)) for port, number, shape in about[side]]
            for side in ("inputs", "outputs")
        )

    def run(self, feed):
        arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in feed.items()}
        try:
            return [np.ascontiguousarray(value) for value in self._run(arrays)]
        except Exception as error:
            raise NoAnswer(f"{self._where}: fails while it runs ({error})") from None
