"""What the model says of a window, and how that changes with every number of the catalogue."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.interface import Constants
from eval.quadrotor.plant import Nominal, assemble, nominal_quadrotor
from eval.quadrotor.stepper import Feedback
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import Windows, step_s
from suite.diagnose.fit.parameters import Layout, Space, effects_at
from suite.diagnose.fit.rollout import KNOTS, STATE, Flown, difference, fly_windows

BATCH = 12
"""Windows a call: one shape, compiled once."""
FEW = 8
"""Directions of the cheaper call."""


class Linear(NamedTuple):
    """Residuals of W windows and their slopes along K directions."""

    residual: np.ndarray
    """(W, N, 19) measured - simulated; zero where nothing was measured."""
    slope: np.ndarray
    """(W, N, 19, K) of the simulated values."""
    offset: np.ndarray
    """(W, F) of what is free in each window, where the residuals were taken."""


class Response(NamedTuple):
    """What a push at each knot of W windows does, and where the model is then."""

    slope: np.ndarray
    """(W, N, 19, KNOTS * 6) of the simulated values, per m/s^2 and rad/s^2 in body axes."""
    knot: Flown
    """(W, KNOTS, ...) the state at the knots."""


class Given(NamedTuple):
    """What a vehicle file fixes, as arrays, so that one compiled rollout serves every vehicle."""

    nominal: Nominal
    constants: Constants
    base: dict[str, Any]
    """Values of every effect."""


class Model:
    """A vehicle's compiled rollout: residuals of windows and their slopes."""

    def __init__(
        self, vehicle: Vehicle, space: Space, driven_by_rotors: bool, voltage: bool
    ) -> None:
        """Prepare the rollout.

        Args:
            vehicle: its nominal values.
            space: what may change.
            driven_by_rotors: measured rotor speeds are the input, not the commands.
            voltage: the windows have a voltage.
        """
        self.space = space
        self.size = len(space.entries)
        self.free = STATE + (4 * KNOTS if driven_by_rotors else 0)
        """Numbers F that are free in each window: its start, and the rotor speeds' errors."""
        self.starts = list(range(self.size, self.size + self.free))
        """Places of the free numbers among all directions."""
        base = {name: value for name, value in space.base.items() if name != "gusts"}
        self.given = Given(*nominal_quadrotor(vehicle), base)
        self.dt = step_s(vehicle)
        """Length of a step [s]."""
        self._kind = (space.layout, self.dt, driven_by_rotors, voltage)
        self._linear = _slopes(*self._kind)
        self.fly: Callable[..., Any] = partial(_flight(*self._kind), self.given)
        """(theta, offset, windows, push, feedback) -> (simulated - measured, the flight), to be
        compiled by who needs it."""

    def residual(self, theta: np.ndarray, offset: np.ndarray, windows: Windows) -> np.ndarray:
        """Return measured - simulated (W, N, 19) from starts moved by `offset` (W, F)."""
        return self.linearise(theta, offset, windows, []).residual

    def respond(self, theta: np.ndarray, offset: np.ndarray, windows: Windows) -> Response:
        """Return what further forces and torques along each window would do to its rows."""
        pushed = _responses(*self._kind)
        with jax.enable_x64(True):
            parts = [
                jax.tree.map(lambda x, n=count: np.asarray(x)[:n], pushed(self.given, theta, x, w))
                for x, w, count in _batches(offset, windows)
            ]
        return jax.tree.map(lambda *p: np.concatenate(p), *parts)

    def linearise(
        self, theta: np.ndarray, offset: np.ndarray, windows: Windows, indices: list[int] | None
    ) -> Linear:
        """Return residuals and slopes along the numbers at `indices`, or along all and the start.

        With `indices` None the directions are all numbers and then the F free ones, whose places
        are `starts`.
        """
        with jax.enable_x64(True):
            return self._linearise(theta, offset, windows, indices)

    def _linearise(
        self, theta: np.ndarray, offset: np.ndarray, windows: Windows, indices: list[int] | None
    ) -> Linear:
        everything = np.eye(self.size + self.free)
        if indices is None:
            groups = [everything]
        else:
            chosen = everything[indices]
            groups = []
            for first in range(0, max(len(indices), 1), FEW):
                rows = np.zeros((FEW, self.size + self.free))
                part = chosen[first : first + FEW]
                rows[: len(part)] = part
                groups.append(rows)
        values, slopes = [], []
        for x, w, count in _batches(offset, windows):
            answers = [self._linear(self.given, theta, x, w, group) for group in groups]
            values.append(np.asarray(answers[0][0])[:count])
            slopes.append(np.concatenate([np.asarray(a[1])[:count] for a in answers], axis=-1))
        width = self.size + self.free if indices is None else len(indices)
        return Linear(-np.concatenate(values), np.concatenate(slopes)[..., :width], offset)


def _batches(offset: np.ndarray, windows: Windows) -> Any:
    count = len(windows.flight)
    for first in range(0, count, BATCH):
        rows = np.minimum(np.arange(first, first + BATCH), count - 1)
        yield offset[rows], Windows(*(f[rows] for f in windows)), min(BATCH, count - first)


@cache
def _slopes(layout: Layout, dt: float, driven_by_rotors: bool, voltage: bool) -> Callable[..., Any]:
    """Return the compiled slopes: XLA takes longer over them than a diagnosis does."""
    fly = _flight(layout, dt, driven_by_rotors, voltage)

    def linear(given: Given, theta: Any, offset: Any, windows: Windows, directions: Any) -> Any:
        size = len(layout)

        def along(direction: Any) -> Any:
            tangent = (direction[:size], jnp.tile(direction[size:], (BATCH, 1)))
            return jax.jvp(lambda t, x: fly(given, t, x, windows)[0], (theta, offset), tangent)

        values, slopes = jax.vmap(along, out_axes=(None, -1))(directions)
        return values, slopes

    return jax.jit(linear)


@cache
def _responses(
    layout: Layout, dt: float, driven_by_rotors: bool, voltage: bool
) -> Callable[..., Any]:
    fly = _flight(layout, dt, driven_by_rotors, voltage)

    def respond(given: Given, theta: Any, offset: Any, windows: Windows) -> Response:
        none = jnp.zeros((BATCH, KNOTS, 6))

        def along(direction: Any) -> Any:
            tangent = jnp.broadcast_to(direction.reshape(KNOTS, 6), none.shape)
            return jax.jvp(lambda p: fly(given, theta, offset, windows, p)[0], (none,), (tangent,))

        slopes = jax.vmap(lambda d: along(d)[1], out_axes=-1)(jnp.eye(KNOTS * 6))
        _, flown = fly(given, theta, offset, windows)
        ends = np.linspace(0, flown.rotor_speed.shape[1] - 1, KNOTS).round().astype(int)
        return Response(slopes, jax.tree.map(lambda x: x[:, ends], flown))

    return jax.jit(respond)


def _flight(
    layout: Layout, dt: float, driven_by_rotors: bool, voltage: bool
) -> Callable[..., tuple[Any, Flown]]:
    """Return the function that flies windows: simulated - measured, and the flight itself."""

    def fly(
        given: Given,
        theta: Any,
        offset: Any,
        windows: Windows,
        push: Any = None,
        feedback: Feedback | None = None,
    ) -> tuple[Any, Flown]:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, dt, 0.0)
        flown = fly_windows(
            plant, values, driven_by_rotors, voltage, offset, windows, push, feedback
        )
        return difference(plant, values, flown, windows), flown

    return fly
