"""Build the policy network as an ONNX graph of standard operators, node by node.

Opset 17 and IR version 8 (2022) are old enough for the runtimes on companion computers. The
exporters of torch (2.13) cannot produce this graph from `torch_twin`. The TorchScript exporter
(`dynamo=False`) splits the GRU into fifteen operators and is deprecated. The exporter based on
`torch.export` splits it too, writes IR version 10 and needs the package onnxscript.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from policies.networks.network import LEAK
from policies.networks.tree_arrays import image_weight, kernel_oihw, rows_are_outputs
from policies.spec import PolicySpec

OPSET = 17
"""Version of the operators."""
IR_VERSION = 8
"""Version of the file format."""


def onnx_model(
    params: Mapping[str, np.ndarray], spec: PolicySpec, metadata: Mapping[str, str]
) -> onnx.ModelProto:
    """Return the network from (state, image, hidden) to (action, hidden_next), for any batch size.

    `metadata` are texts for the file, by key.
    """
    camera, width = spec.camera, spec.hidden_size
    inputs = [
        _value("state", "batch", spec.state_size),
        _value("image", "batch", camera.height, camera.width),
        _value("hidden", "batch", width),
    ]
    outputs = [_value("action", "batch", spec.action.size), _value("hidden_next", "batch", width)]
    tensors = [
        numpy_helper.from_array(value, name) for name, value in _initializers(params, spec).items()
    ]
    graph = helper.make_graph(_nodes(width), "policy", inputs, outputs, tensors)
    model = helper.make_model(
        graph,
        producer_name="diffracing-suite",
        ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model


def _initializers(params: Mapping[str, np.ndarray], spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return the graph's constants, weights in ONNX's layouts."""
    width = spec.hidden_size
    biases = [_gates(params[f"gru.bias_{side}"], width) for side in ("input", "hidden")]
    return {
        "channel_axis": np.array([1], np.int64),
        "time_axis": np.array([0], np.int64),
        **{f"conv{i}.weight": kernel_oihw(params[f"conv{i}.weight"]) for i in (1, 2, 3)},
        "image.weight": image_weight(params, spec),
        "state.weight": rows_are_outputs(params["state.weight"]),
        "state.bias": np.array(params["state.bias"]),
        "gru.input": _gates(rows_are_outputs(params["gru.weight_input"]), width)[None],
        "gru.hidden": _gates(rows_are_outputs(params["gru.weight_hidden"]), width)[None],
        "gru.bias": np.concatenate(biases)[None],
        "action.weight": np.array(params["action.weight"]),
    }


def _gates(rows: np.ndarray, width: int) -> np.ndarray:
    """Return rows in the suite's gate order (reset, update, new) as ONNX's (update, reset, new)."""
    rows = np.asarray(rows)
    return np.concatenate([rows[width : 2 * width], rows[:width], rows[2 * width :]])


def _nodes(width: int) -> list[onnx.NodeProto]:
    """Return the operators in order of execution, with the names of their inputs and outputs."""
    node = helper.make_node
    return [
        node("Unsqueeze", ["image", "channel_axis"], ["picture"]),
        node("MaxPool", ["picture"], ["pooled"], kernel_shape=[2, 2], strides=[2, 2]),
        node("Conv", ["pooled", "conv1.weight"], ["c1"], kernel_shape=[2, 2], strides=[2, 2]),
        node("LeakyRelu", ["c1"], ["a1"], alpha=LEAK),
        node("Conv", ["a1", "conv2.weight"], ["c2"], kernel_shape=[3, 3]),
        node("LeakyRelu", ["c2"], ["a2"], alpha=LEAK),
        node("Conv", ["a2", "conv3.weight"], ["c3"], kernel_shape=[3, 3]),
        node("LeakyRelu", ["c3"], ["a3"], alpha=LEAK),
        node("Flatten", ["a3"], ["features"], axis=1),
        node("Gemm", ["features", "image.weight"], ["image_embedding"], transB=1),
        node("Gemm", ["state", "state.weight", "state.bias"], ["state_embedding"], transB=1),
        node("Add", ["image_embedding", "state_embedding"], ["sum"]),
        node("LeakyRelu", ["sum"], ["embedding"], alpha=LEAK),
        node("Unsqueeze", ["embedding", "time_axis"], ["sequence"]),
        node("Unsqueeze", ["hidden", "time_axis"], ["before"]),
        node(
            "GRU",
            ["sequence", "gru.input", "gru.hidden", "gru.bias", "", "before"],
            ["", "after"],
            hidden_size=width,
            # The reset gate multiplies the recurrent bias of the new gate too, as in torch.
            linear_before_reset=1,
        ),
        node("Squeeze", ["after", "time_axis"], ["hidden_next"]),
        node("LeakyRelu", ["hidden_next"], ["leaked"], alpha=LEAK),
        node("MatMul", ["leaked", "action.weight"], ["action"]),
    ]


def _value(name: str, *shape: str | int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
