"""The network's numbers as C arrays, laid out for its kernels (templates/float32.c, int8.c).

A layer's weights stand in blocks of 32 outputs, input after input, so that the inner loop runs over
outputs that lie side by side in memory; layers of `hidden_size` are filled up with zeros.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from policies.spec import CHANNEL_BLOCK, PolicySpec

BLOCK = CHANNEL_BLOCK
"""Outputs of a block."""
LAYERS = ("conv2", "conv3", "image", "gru_input", "gru_hidden")
"""Layers with nearly all weights; the others are floats for every type."""


def padded(size: int) -> int:
    """Return the next multiple of `BLOCK`."""
    return -(-size // BLOCK) * BLOCK


def matrices(params: Mapping[str, np.ndarray], spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return each of `LAYERS` as a matrix (inputs, outputs), both filled up with zeros."""
    wide, gates = padded(spec.hidden_size), padded(3 * spec.hidden_size)
    plain = {name: np.asarray(value, np.float32) for name, value in params.items()}
    return {
        "conv2": plain["conv2.weight"].reshape(-1, spec.channels[1]),
        "conv3": plain["conv3.weight"].reshape(-1, spec.channels[2]),
        "image": fill(plain["image.weight"], len(plain["image.weight"]), wide),
        "gru_input": fill(plain["gru.weight_input"], wide, gates),
        "gru_hidden": fill(plain["gru.weight_hidden"], wide, gates),
    }


def small_arrays(params: Mapping[str, np.ndarray], spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return the arrays that are floats for every type: first layer, state, biases, action."""
    wide, gates = padded(spec.hidden_size), padded(3 * spec.hidden_size)
    plain = {name: np.asarray(value, np.float32) for name, value in params.items()}
    return {
        "conv1_weight": plain["conv1.weight"].reshape(4, -1),
        "state_weight": fill(plain["state.weight"], spec.state_size, wide),
        "state_bias": fill(plain["state.bias"][None], 1, wide),
        "gru_input_bias": fill(plain["gru.bias_input"][None], 1, gates),
        "gru_hidden_bias": fill(plain["gru.bias_hidden"][None], 1, gates),
        "action_weight": plain["action.weight"],
    }


def fill(weight: np.ndarray, inputs: int, outputs: int) -> np.ndarray:
    """Return a matrix filled up with zeros to (inputs, outputs)."""
    whole = np.zeros((inputs, outputs), weight.dtype)
    whole[: weight.shape[0], : weight.shape[1]] = weight
    return whole


def blocked(weight: np.ndarray) -> np.ndarray:
    """Return a matrix (inputs, outputs) flat, block of outputs by block, input by input."""
    inputs, outputs = weight.shape
    return weight.reshape(inputs, outputs // BLOCK, BLOCK).transpose(1, 0, 2).ravel()


def array_text(name: str, values: np.ndarray) -> str:
    """Return an array's C definition; read back, the numbers are the same to the bit."""
    flat = np.asarray(values).ravel()
    if flat.dtype == np.float32:
        kind, texts = "float", [float_text(value) for value in flat.tolist()]
    else:
        kind, texts = "signed char", [str(value) for value in flat.tolist()]
    per_line = 8 if kind == "float" else 24
    lines = (", ".join(texts[k : k + per_line]) for k in range(0, len(texts), per_line))
    body = ",\n    ".join(lines)
    return f"static const {kind} {name}[{len(flat)}] = {{\n    {body}}};\n"


def float_text(value: float) -> str:
    """Return a float32 as a C literal of nine digits, which name exactly one float32."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def multiply_adds(spec: PolicySpec) -> int:
    """Return the multiply-adds of one step, the filled-up rows left out."""
    rows, columns, hidden = spec.camera.height // 4, spec.camera.width // 4, spec.hidden_size
    first, second, third = spec.channels
    count = rows * columns * 4 * first
    count += (rows - 2) * (columns - 2) * 9 * first * second
    count += (rows - 4) * (columns - 4) * third * (9 * second + hidden)
    return count + hidden * (spec.state_size + 6 * hidden + 3)
