"""Linearises models of flights by JAX: one function for rollouts, forces and torques.

Numbers of pieces of flights (windows or rows) and of directions in one call are fixed, so that each
model is compiled once for all vehicles and flights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Constants
from eval.quadrotor.loops import Loop, loop_of
from eval.quadrotor.plant import Nominal, nominal_quadrotor
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import take
from suite.diagnose.estimate.parameters import ParameterSpace

BATCH = 12
"""Number of windows in one call."""
DIRECTIONS = 8
"""Number of slopes in one call. To compile a second, wider program takes longer than it saves,
unless there are more than some 150 windows."""


class VehicleArrays(NamedTuple):
    """Contents of a vehicle file as arrays, so that one compiled model serves every vehicle."""

    nominal: Nominal
    constants: Constants
    base: dict[str, Any]
    """Values of every effect that depends on the state alone."""
    loop: Loop | None
    """A firmware's rate loop."""


def arrays_of(vehicle: Vehicle, space: ParameterSpace) -> VehicleArrays:
    """Return the arrays of `vehicle` with the effects of `space`."""
    base = {name: values for name, values in space.base.items() if EFFECTS[name].by_state}
    return VehicleArrays(*nominal_quadrotor(vehicle), base, loop_of(vehicle))


def linearised(
    compiled: Callable[..., Any],
    given: VehicleArrays,
    theta: np.ndarray,
    offset: np.ndarray,
    data: Any,
    indices: Sequence[int] | None,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (N, ...) of a model for N pieces of `data`, and their slopes (N, ..., K).

    `compiled` is a jitted function of `slopes_along`, which takes `size` pieces at a time. `theta`
    (P,) are parameters, `offset` (N, F) nuisance parameters of each piece, and `indices` K places
    among both (parameters first), or None for all.
    """
    directions = np.eye(len(theta) + offset.shape[1])
    directions = directions if indices is None else directions[list(indices)]
    count = len(directions)
    padding = -count % DIRECTIONS if count else DIRECTIONS
    groups = np.pad(directions, ((0, padding), (0, 0))).reshape(-1, DIRECTIONS, directions.shape[1])
    values, slopes = [], []
    with jax.enable_x64(True):
        for *batch, own in batches(offset, data, size):
            results = [compiled(given, theta, *batch, group) for group in groups]
            values.append(np.asarray(results[0][0])[:own])
            slopes.append(np.concatenate([np.asarray(r[1])[:own] for r in results], axis=-1))
    return np.concatenate(values), np.concatenate(slopes)[..., :count]


def batches(
    offset: np.ndarray, data: Any, size: int = BATCH
) -> Iterator[tuple[np.ndarray, Any, int]]:
    """Yield (offsets, data, number) by `size`; pieces after `number` repeat the last one."""
    count = len(offset)
    for first in range(0, count, size):
        rows = np.minimum(np.arange(first, first + size), count - 1)
        yield offset[rows], take(data, rows), min(size, count - first)


def slopes_along(model: Callable[..., Any]) -> Callable[..., Any]:
    """Return `model` (vehicle, theta, offset, data) with slopes along a fifth argument.

    These are K directions (K, P + F): of parameters, then of nuisance parameters of every piece.
    """

    def linear(given: VehicleArrays, theta: Any, offset: Any, data: Any, directions: Any) -> Any:
        def along(direction: Any) -> Any:
            of_theta, of_offset = direction[: len(theta)], direction[len(theta) :]
            tangent = (of_theta, jnp.tile(of_offset, (len(offset), 1)))
            return jax.jvp(lambda t, x: model(given, t, x, data), (theta, offset), tangent)

        return jax.vmap(along, out_axes=(None, -1))(directions)

    return linear
