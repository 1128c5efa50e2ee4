"""Measure the speed of a compiled JAX program, and the best speed of the device for comparison."""

from __future__ import annotations

import math
import resource
import sys
from collections.abc import Callable
from typing import Any

import jax

from suite.experiments.bench.compare import in_turn


def best_time(call: Callable[[], Any]) -> float:
    """Return the shortest of four times of a program, from its call to its results [s]."""
    return min(in_turn({"": lambda: jax.block_until_ready(call())}, rounds=4)[""])


def count_operations(function: Callable[..., Any], *args: Any) -> float:
    """Return the approximate number of floating-point operations of a call.

    A matrix product or a convolution counts a multiplication and an addition per term. Any other
    operation counts one per element of its result. The body of a loop counts once per pass, or once
    if the number of passes is unknown. (XLA's own count always takes one pass.)
    """
    return _operations(jax.make_jaxpr(function)(*args).jaxpr)


def _operations(jaxpr: Any) -> float:
    """Return the operations of a jaxpr, JAX's list of the primitive operations of a function."""
    return sum(_equation_operations(equation) for equation in jaxpr.eqns)


def _equation_operations(equation: Any) -> float:
    """Return the operations of one primitive, with those of the functions that it calls."""
    name, params = equation.primitive.name, equation.params
    # Functions inside the primitive, such as the body of a loop; a closed jaxpr wraps a jaxpr.
    inner = [
        getattr(item, "jaxpr", item)
        for value in params.values()
        for item in (value if isinstance(value, (tuple, list)) else (value,))
        if hasattr(item, "eqns") or hasattr(getattr(item, "jaxpr", None), "eqns")
    ]
    if inner:
        operations = [_operations(jaxpr) for jaxpr in inner]
        if name == "cond":  # one of the branches runs; the longest is assumed
            return max(operations)
        return params.get("length", 1) * sum(operations)
    size = sum(math.prod(out.aval.shape) for out in equation.outvars)
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        return 2.0 * size * math.prod(equation.invars[0].aval.shape[k] for k in contracted)
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        outputs = kernel[params["dimension_numbers"].rhs_spec[0]]
        return 2.0 * size * math.prod(kernel) / outputs
    return float(size)


def multiplying_rate(size: int) -> float:
    """Return the operations per second of a product of float32 matrices of `size` rows [1/s].

    Returns:
        Approximately the best speed of the device without rounding to fewer bits.
    """
    matrix = jax.random.normal(jax.random.key(0), (size, size))
    with jax.default_matmul_precision("highest"):
        product = jax.jit(lambda a: a @ a)
        return 2.0 * size**3 / best_time(lambda: product(matrix))


def peak_memory() -> int | None:
    """Return the peak memory of the accelerator, or of this process if there is only a CPU [bytes].

    None: the accelerator does not report it.
    """
    if jax.default_backend() == "cpu":
        # The operating systems differ: macOS counts bytes, Linux kibibytes.
        bytes_per_count = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * bytes_per_count
    statistics = jax.devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")
