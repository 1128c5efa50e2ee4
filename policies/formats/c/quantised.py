"""Quantise the policy network: weights and activations of its large layers get 8 bits.

Weights have one scale for each output and no zero point. Activations have one scale and zero point
for each layer: the smallest and largest values in recorded flights become the smallest and largest
bytes. The method is that of Jacob et al. 2018, "Quantization and Training of Neural Networks for
Efficient Integer-Arithmetic-Only Inference", but the operations between layers use floats.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from policies.formats.c import forward
from policies.formats.c.arrays import LAYERS, matrices, small_arrays
from policies.formats.c.forward import Observed
from policies.spec import PolicyError, PolicySpec

SUM_MOST = 2**31 - 1
"""Limit of a layer's integer sums, which C computes in 32 bits."""


class Quantised(NamedTuple):
    """A layer of 8 bits: out = (round(x * inverse + zero) @ weight) * scale + offset."""

    weight: np.ndarray
    """(inputs, outputs) weights, int8, from -127 to 127."""
    scale: np.ndarray
    """(outputs,) output per unit of the integer sum, float32."""
    offset: np.ndarray
    """(outputs,) offset that cancels the contribution of the inputs' zero point, float32."""
    inverse: float
    """Inverse of the inputs' scale: steps of a byte per unit of the input."""
    zero: int
    """Zero point: the byte that represents an input of 0."""


def quantise(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> dict[str, Quantised]:
    """Return each of `arrays.LAYERS` with 8 bits; the range of its inputs in `observed` scales it.

    Raises:
        PolicyError: where a sum of products may exceed 32 bits.
    """
    ranges = input_ranges(params, spec, observed)
    layers = {
        name: _quantised(weight, *ranges[name]) for name, weight in matrices(params, spec).items()
    }
    for name, layer in layers.items():
        check_sums(name, layer.weight)
    return layers


def check_sums(name: str, weight: np.ndarray) -> None:
    """Refuse a layer whose integer sums may exceed 32 bits, as for a large image.

    The weights are (inputs, outputs) int8.

    Raises:
        PolicyError: naming the layer, its inputs and what to do.
    """
    # The sum of magnitudes also bounds every partial sum; the magnitude of an input is 128 at most.
    largest = 128 * int(np.abs(weight.astype(np.int64)).sum(0).max())
    if largest > SUM_MOST:
        raise PolicyError(
            f"layer {name!r}: the sum over its {len(weight)} inputs may reach {largest}, allowed "
            f"for int8 is up to {SUM_MOST}; export it as float32, or train with a smaller image"
        )


def input_ranges(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> dict[str, tuple[float, float]]:
    """Return (smallest, largest) input of each large layer over the observations."""
    weights = matrices(params, spec)
    ranges: dict[str, tuple[float, float]] = dict.fromkeys(LAYERS, (0.0, 0.0))

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        low, high = ranges[name]
        ranges[name] = min(low, float(x.min())), max(high, float(x.max()))
        return x @ weights[name]

    forward.actions(small_arrays(params, spec), spec, layer, observed)
    # The hidden state is a convex combination of tanh values, from -1 to 1.
    return {**ranges, "gru_hidden": (-1.0, 1.0)}


def _quantised(weight: np.ndarray, low: float, high: float) -> Quantised:
    """Return a layer with float weights (inputs, outputs) and inputs from `low` to `high`."""
    largest = np.abs(weight).max(0)
    step = np.where(largest > 0, largest, 1.0).astype(np.float32) / np.float32(127)
    weight_int8 = np.rint(weight / step).clip(-127, 127).astype(np.int8)
    inverse = float(np.float32(255.0 / max(high - low, 1e-6)))
    zero = int(np.clip(np.rint(-128.0 - low * inverse), -128, 127))
    scale = (step / np.float32(inverse)).astype(np.float32)
    column_sum = weight_int8.sum(0, dtype=np.int64)
    offset = (-zero * column_sum * scale.astype(np.float64)).astype(np.float32)
    return Quantised(weight_int8, scale, offset, inverse, zero)


def actions(
    params: Mapping[str, np.ndarray],
    spec: PolicySpec,
    layers: Mapping[str, Quantised],
    observed: Observed,
) -> np.ndarray:
    """Return the actions (T, size) of the quantised network for T observations."""
    return forward.actions(
        small_arrays(params, spec), spec, lambda name, x: layer_outputs(layers[name], x), observed
    )


def layer_outputs(layer: Quantised, x: np.ndarray) -> np.ndarray:
    """Return a quantised layer's outputs (..., O) for inputs (..., I)."""
    scaled = (x.astype(np.float32) * np.float32(layer.inverse) + layer.zero).clip(-128, 127)
    rounded = np.trunc(scaled + np.copysign(0.5, scaled))
    # A product of float64 is exact here, and many times as fast as numpy's product of integers.
    sums = rounded.astype(np.float64) @ layer.weight.astype(np.float64)
    return sums.astype(np.float32) * layer.scale + layer.offset
