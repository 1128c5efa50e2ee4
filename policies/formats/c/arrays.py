"""Lay out the policy network's weights as C arrays for the C code (templates/float32.c, int8.c).

A layer's weights are stored in blocks of 32 outputs. Within a block they are ordered by input, so
the inner loop runs over outputs that are neighbours in memory. Layers of `hidden_size` are padded
with zeros to whole blocks.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from policies.spec import CHANNEL_BLOCK, PolicySpec

BLOCK = CHANNEL_BLOCK
"""Number of outputs in a block."""
DTYPES = ("float32", "int8")
"""Types of the weights."""
LAYERS = ("conv2", "conv3", "image", "gru_input", "gru_hidden")
"""Names of the large layers, which have nearly all weights. Int8 quantises them; the other layers
are always float."""


def padded(size: int) -> int:
    """Return the next multiple of `BLOCK`."""
    return -(-size // BLOCK) * BLOCK


def matrices(params: Mapping[str, np.ndarray], spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return each of `LAYERS` as a matrix (inputs, outputs), padded with zeros."""
    hidden_padded, gates = padded(spec.hidden_size), padded(3 * spec.hidden_size)
    float_params = {name: np.asarray(value, np.float32) for name, value in params.items()}
    image = float_params["image.weight"]
    return {
        "conv2": float_params["conv2.weight"].reshape(-1, spec.channels[1]),
        "conv3": float_params["conv3.weight"].reshape(-1, spec.channels[2]),
        "image": zero_pad(image, len(image), hidden_padded),
        "gru_input": zero_pad(float_params["gru.weight_input"], hidden_padded, gates),
        "gru_hidden": zero_pad(float_params["gru.weight_hidden"], hidden_padded, gates),
    }


def small_arrays(params: Mapping[str, np.ndarray], spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return the arrays that are always float32: first layer, state, biases, action."""
    hidden_padded, gates = padded(spec.hidden_size), padded(3 * spec.hidden_size)
    float_params = {name: np.asarray(value, np.float32) for name, value in params.items()}
    return {
        "conv1_weight": float_params["conv1.weight"].reshape(4, -1),
        "state_weight": zero_pad(float_params["state.weight"], spec.state_size, hidden_padded),
        "state_bias": zero_pad(float_params["state.bias"][None], 1, hidden_padded),
        "gru_input_bias": zero_pad(float_params["gru.bias_input"][None], 1, gates),
        "gru_hidden_bias": zero_pad(float_params["gru.bias_hidden"][None], 1, gates),
        "action_weight": float_params["action.weight"],
    }


def zero_pad(weight: np.ndarray, inputs: int, outputs: int) -> np.ndarray:
    """Return a matrix padded with zeros to (inputs, outputs)."""
    padded_weight = np.zeros((inputs, outputs), weight.dtype)
    padded_weight[: weight.shape[0], : weight.shape[1]] = weight
    return padded_weight


def blocked(weight: np.ndarray) -> np.ndarray:
    """Return a matrix (inputs, outputs) as a flat array: by block of outputs, then by input."""
    inputs, outputs = weight.shape
    return weight.reshape(inputs, outputs // BLOCK, BLOCK).transpose(1, 0, 2).ravel()


def array_text(name: str, values: np.ndarray) -> str:
    """Return the C definition of an array; the compiler reads the same numbers, to the bit."""
    flat = np.asarray(values).ravel()
    if flat.dtype == np.float32:
        kind, texts = "float", [float_text(value) for value in flat.tolist()]
    else:
        kind, texts = "signed char", [str(value) for value in flat.tolist()]
    per_line = 8 if kind == "float" else 24
    rows = (", ".join(texts[k : k + per_line]) for k in range(0, len(texts), per_line))
    body = ",\n    ".join(rows)
    return f"static const {kind} {name}[{len(flat)}] = {{\n    {body}}};\n"


def float_text(value: float) -> str:
    """Return a float32 as a C literal of nine digits, which identify exactly one float32."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def multiply_adds(spec: PolicySpec) -> int:
    """Return the number of multiply-adds of one step, without those of the padding."""
    rows, columns, hidden = spec.camera.height // 4, spec.camera.width // 4, spec.hidden_size
    first, second, third = spec.channels
    count = rows * columns * 4 * first
    count += (rows - 2) * (columns - 2) * 9 * first * second
    count += (rows - 4) * (columns - 4) * third * (9 * second + hidden)
    return count + hidden * (spec.state_size + 6 * hidden + spec.action.size)
