"""Measure the speed of a compiled JAX program, and the best speed of the device for comparison."""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import jax

REPEATS = 4
"""Timed calls of a program; the fastest counts."""


def best_time(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the shortest time of several calls of a compiled program, results awaited [s]."""
    times_s = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        times_s.append(time.perf_counter() - started)
    return min(times_s)


def count_operations(function: Callable[..., Any], *args: Any) -> float:
    """Return the approximate number of floating-point operations of a call.

    Matrix products and convolutions count a multiplication and an addition per term, any other
    operation one per element of its result. A loop counts once per pass, and once if its length is
    unknown. (XLA's own count takes one pass of every loop.)
    """
    return _operations(jax.make_jaxpr(function)(*args).jaxpr)


def _operations(jaxpr: Any) -> float:
    return sum(_equation_operations(equation) for equation in jaxpr.eqns)


def _equation_operations(equation: Any) -> float:
    """Return the operations of one primitive, with those of the functions that it calls."""
    name, params = equation.primitive.name, equation.params
    inner = [
        getattr(item, "jaxpr", item)
        for value in params.values()
        for item in (value if isinstance(value, (tuple, list)) else (value,))
        if hasattr(item, "eqns") or hasattr(getattr(item, "jaxpr", None), "eqns")
    ]
    if inner:
        operations = [_operations(jaxpr) for jaxpr in inner]
        if name == "cond":
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
    """Return the operations per second of a product of float32 matrices in full precision [1/s].

    It is approximately the best speed of the device without rounding to fewer bits.
    """
    matrix = jax.random.normal(jax.random.key(0), (size, size))
    with jax.default_matmul_precision("highest"):
        product = jax.jit(lambda a: a @ a)
        jax.block_until_ready(product(matrix))
        return 2.0 * size**3 / best_time(lambda: product(matrix))


def peak_memory() -> int | None:
    """Return the peak memory of the default device, or on a CPU of this process [bytes]."""
    if jax.default_backend() == "cpu":
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    statistics = jax.devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")
