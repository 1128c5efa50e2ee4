"""One step of the network in numpy, its five large layers handed in: to measure and to quantise.

It shares no line with the C code: what the int8 file must answer is worked out here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from policies.networks.network import LEAK
from policies.spec import PolicySpec

Layer = Callable[[str, np.ndarray], np.ndarray]
"""(name in `arrays.LAYERS`, inputs (..., I)) to outputs (..., O)."""


class Observed(NamedTuple):
    """The inputs of a policy in flights, one after another."""

    state: np.ndarray
    """(T, spec.state_size) float32."""
    image: np.ndarray
    """(T, height, width) float32, encoded."""
    fresh: np.ndarray
    """(T,) bool, where a flight begins."""


def step(
    small: Mapping[str, np.ndarray],
    spec: PolicySpec,
    layer: Layer,
    hidden: np.ndarray,
    state: np.ndarray,
    image: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (action_b (3,) [m/s^2], hidden' (filled up)) of one observation.

    Args:
        small: from `arrays.small_arrays`.
        spec: the policy's.
        layer: what the large layers do.
        hidden: recurrent state, filled up.
        state: (spec.state_size,).
        image: (height, width) encoded.
    """
    rows, columns, units = spec.camera.height // 4, spec.camera.width // 4, spec.hidden_size
    pooled = image.reshape(2 * rows, 2, 2 * columns, 2).max((1, 3))
    patches = pooled.reshape(rows, 2, columns, 2).swapaxes(1, 2).reshape(rows, columns, 4)
    x = _leaky(patches @ small["conv1_weight"])
    x = _leaky(layer("conv2", _windows(x)))
    x = _leaky(layer("conv3", _windows(x)))
    felt = state @ small["state_weight"] + small["state_bias"][0]
    x = _leaky(layer("image", x.ravel()) + felt)
    from_input = (layer("gru_input", x) + small["gru_input_bias"][0])[: 3 * units]
    from_hidden = (layer("gru_hidden", hidden) + small["gru_hidden_bias"][0])[: 3 * units]
    reset_x, update_x, fresh_x = np.split(from_input, 3)
    reset_h, update_h, fresh_h = np.split(from_hidden, 3)
    update = _sigmoid(update_x + update_h)
    fresh = np.tanh(fresh_x + _sigmoid(reset_x + reset_h) * fresh_h)
    after = np.zeros_like(hidden)
    after[:units] = fresh + update * (hidden[:units] - fresh)
    return _leaky(after[:units]) @ small["action_weight"], after


def actions(
    small: Mapping[str, np.ndarray], spec: PolicySpec, layer: Layer, observed: Observed
) -> np.ndarray:
    """Return the actions (T, 3) for observations in turn, the memory cleared where one is fresh."""
    width = small["state_bias"].shape[1]
    hidden, answers = np.zeros(width, np.float32), []
    for state, image, fresh in zip(*observed, strict=True):
        before = np.zeros(width, np.float32) if fresh else hidden
        action, hidden = step(small, spec, layer, before, state, image)
        answers.append(action)
    return np.array(answers, np.float32)


def _windows(x: np.ndarray) -> np.ndarray:
    """Return (rows, columns, C) as its windows of 3 x 3 pixels (rows - 2, columns - 2, 9 C)."""
    view = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(0, 1))
    return view.transpose(0, 1, 3, 4, 2).reshape(*view.shape[:2], -1)


def _leaky(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, np.float32(LEAK) * x)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)
