"""The network with weights and activations of 8 bits.

Weights have a scale for each output (symmetric), activations one for each layer with a zero point,
so that their smallest and largest values measured on flights are the smallest and largest bytes.
After Jacob et al. 2018, "Quantization and Training of Neural Networks for Efficient
Integer-Arithmetic-Only Inference"; all operations between the layers use floats.
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
    """A layer of 8 bits: out = (bytes(x) @ weight) * scale + offset."""

    weight: np.ndarray
    """(inputs, outputs) int8, at least -127."""
    scale: np.ndarray
    """(outputs,) float32, value of one unit of the integer sum."""
    offset: np.ndarray
    """(outputs,) float32, correction for the inputs' zero point."""
    inverse: float
    """Bytes in one unit of the input."""
    zero: int
    """The byte for an input of 0."""


def quantise(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> dict[str, Quantised]:
    """Return each of `arrays.LAYERS` with 8 bits, scaled by its inputs for `observed`.

    Raises:
        PolicyError: where a sum of products may leave 32 bits.
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

    Args:
        name: of the layer.
        weight: (inputs, outputs) int8.

    Raises:
        PolicyError: naming the layer, its inputs and what to do.
    """
    # The sum of the sizes bounds every partial sum as well; a byte of an input is -128 at most.
    largest = 128 * int(np.abs(weight.astype(np.int64)).sum(0).max())
    if largest > SUM_MOST:
        raise PolicyError(
            f"layer {name!r}: the sum over its {len(weight)} inputs may reach {largest}, and int8 "
            f"adds up to {SUM_MOST} at most; export it as float32, or train with a smaller image"
        )


def input_ranges(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> dict[str, tuple[float, float]]:
    """Return the smallest and largest input of each large layer over observations."""
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
    largest = np.abs(weight).max(0)
    steps = np.where(largest > 0, largest, 1.0).astype(np.float32) / np.float32(127)
    whole = np.rint(weight / steps).clip(-127, 127).astype(np.int8)
    inverse = float(np.float32(255.0 / max(high - low, 1e-6)))
    zero = int(np.clip(np.rint(-128.0 - low * inverse), -128, 127))
    scale = (steps / np.float32(inverse)).astype(np.float32)
    offset = (-zero * whole.sum(0, dtype=np.int64) * scale.astype(np.float64)).astype(np.float32)
    return Quantised(whole, scale, offset, inverse, zero)


def answers(
    params: Mapping[str, np.ndarray],
    spec: PolicySpec,
    layers: Mapping[str, Quantised],
    observed: Observed,
) -> np.ndarray:
    """Return the actions (T, 3) of the quantised network."""
    small = small_arrays(params, spec)

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        return products(layers[name], x)

    return forward.actions(small, spec, layer, observed)


def products(layer: Quantised, x: np.ndarray) -> np.ndarray:
    """Return a quantised layer's outputs (..., O) for inputs (..., I)."""
    scaled = (x.astype(np.float32) * np.float32(layer.inverse) + layer.zero).clip(-128, 127)
    whole = np.trunc(scaled + np.copysign(0.5, scaled))
    # Exact in doubles, and many times as fast as numpy's product of integers.
    sums = whole.astype(np.float64) @ layer.weight.astype(np.float64)
    return sums.astype(np.float32) * layer.scale + layer.offset
