"""The policy network's forward step in numpy; the caller provides its five large layers.

`quantised.py` uses it to measure the layers' input ranges and to compute the outputs that the int8
C file must give. It is independent of the C code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from policies.networks.network import LEAK
from policies.spec import PolicySpec

Layer = Callable[[str, np.ndarray], np.ndarray]
"""A function (name in `arrays.LAYERS`, inputs (..., I)) that returns outputs (..., O)."""


class Observed(NamedTuple):
    """The recorded inputs of a policy over T steps of one or more flights."""

    state: np.ndarray
    """(T, spec.state_size) state observations, float32."""
    image: np.ndarray
    """(T, height, width) encoded depth images, float32."""
    fresh: np.ndarray
    """(T,) bool, steps at which a flight begins."""


def step(
    small: Mapping[str, np.ndarray],
    spec: PolicySpec,
    layer: Layer,
    hidden: np.ndarray,
    state: np.ndarray,
    image: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the action (spec.action.size,) in SI units and the new hidden state of one step.

    Args:
        small: weights and biases of the small layers, from `arrays.small_arrays`.
        spec: the policy's specification.
        layer: function that computes a large layer.
        hidden: recurrent state, zero-padded to whole blocks of `arrays.BLOCK`.
        state: (spec.state_size,) state observation.
        image: (height, width) encoded depth image.
    """
    # The network takes the maximum of 2 x 2 pixels, and its first layer 2 x 2 of these.
    rows, columns, units = spec.camera.height // 4, spec.camera.width // 4, spec.hidden_size
    pooled = image.reshape(2 * rows, 2, 2 * columns, 2).max((1, 3))
    patches = pooled.reshape(rows, 2, columns, 2).swapaxes(1, 2).reshape(rows, columns, 4)
    x = _leaky(patches @ small["conv1_weight"])
    x = _leaky(layer("conv2", _windows(x)))
    x = _leaky(layer("conv3", _windows(x)))
    state_embedding = state @ small["state_weight"] + small["state_bias"][0]
    x = _leaky(layer("image", x.ravel()) + state_embedding)
    from_input = (layer("gru_input", x) + small["gru_input_bias"][0])[: 3 * units]
    from_hidden = (layer("gru_hidden", hidden) + small["gru_hidden_bias"][0])[: 3 * units]
    reset_x, update_x, new_x = np.split(from_input, 3)
    reset_h, update_h, new_h = np.split(from_hidden, 3)
    update = _sigmoid(update_x + update_h)
    new = np.tanh(new_x + _sigmoid(reset_x + reset_h) * new_h)
    next_hidden = np.zeros_like(hidden)
    next_hidden[:units] = new + update * (hidden[:units] - new)
    return _leaky(next_hidden[:units]) @ small["action_weight"], next_hidden


def actions(
    small: Mapping[str, np.ndarray], spec: PolicySpec, layer: Layer, observed: Observed
) -> np.ndarray:
    """Return the actions (T, size) for T observations; memory is cleared where a flight begins."""
    width = small["state_bias"].shape[1]
    hidden, outputs = np.zeros(width, np.float32), []
    for state, image, fresh in zip(*observed, strict=True):
        hidden = np.zeros(width, np.float32) if fresh else hidden
        action, hidden = step(small, spec, layer, hidden, state, image)
        outputs.append(action)
    return np.array(outputs, np.float32)


def _windows(x: np.ndarray) -> np.ndarray:
    """Return the 3 x 3 windows (rows - 2, columns - 2, 9 C) of an array (rows, columns, C)."""
    view = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(0, 1))
    return view.transpose(0, 1, 3, 4, 2).reshape(*view.shape[:2], -1)


def _leaky(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, np.float32(LEAK) * x)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)
