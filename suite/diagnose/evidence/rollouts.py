"""Rollouts (simulated stretches of 1 s) as evidence: whitened, start states projected out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Constants
from eval.quadrotor.loops import Loop, loop_of
from eval.quadrotor.plant import Nominal, assemble, nominal_quadrotor
from eval.quadrotor.stepper import Feedback
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.colour import Noise, left_as_noise, measured_noise
from suite.diagnose.data.sampling import LONGEST_S
from suite.diagnose.data.whitening import (
    Linearisation,
    Whitening,
    make_whitening,
    slow_energy,
    whiten,
    whitened_residual,
)
from suite.diagnose.data.windows import KNOTS, STATE, FlightWindows, step_s, take, trusted
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.gauss_newton import fit, gauss_newton_step
from suite.diagnose.estimate.parameters import (
    Candidate,
    ParameterLayout,
    ParameterSpace,
    effects_at,
)
from suite.diagnose.evidence.evidence import Evidence, flights_agree
from suite.diagnose.evidence.rollout import Flown, at_knots, difference, fly_windows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class RolloutEvidence(Evidence):
    """Rollouts of W stretches, weighted by their noise."""

    model: RolloutModel
    windows: FlightWindows
    """At full length."""
    trusted: FlightWindows
    """As long as the linearisation holds."""
    noise: Noise
    whitening: Whitening
    limits: Thresholds = THRESHOLDS
    off: bool = False
    """Whether the whole residual counts as noise."""

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's numbers."""
        return self.model.space

    @property
    def draws(self) -> float:
        """1 where the model is off, as its error is the same all along a flight; else 0."""
        return 1.0 if self.off else 0.0

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return the block along these numbers, see `Evidence`."""
        linear = self.model.linearise(at.theta, at.free, self.trusted, indices)
        along = range(self.model.size) if indices is None else indices
        return block_of(self.whitening, linear, along, self.windows)

    def weighed(self, at: Estimate) -> tuple[RolloutEvidence, Block]:
        """Return this with its noise as it is there, see `Evidence`."""
        # The noise estimate is best where the model fits best; the linearisation holds for longer.
        return weighed_by(self.model, self.windows, self._everything(at), self.limits)

    def again(self, at: Estimate) -> tuple[RolloutEvidence, Block]:
        """Return this with the noise that it has, see `Evidence`."""
        linear = self._everything(at)
        found, block = weighed_by(self.model, self.windows, linear, self.limits, self.noise)
        return replace(found, off=self.off), block

    def misfit(self, at: Estimate, block: Block) -> tuple[RolloutEvidence, Block] | None:
        """Return this where more than noise is left, see `Evidence`."""
        slow, expected = self.slow_errors(block)
        if slow.sum() <= self.limits.structure_rotor_input * expected.sum():
            return None
        linear = self._everything(at)
        noise = left_as_noise(linear.residual, linear.start_slope, self.trusted, self.limits)
        whitening = make_whitening(linear, noise, self.trusted, self.limits)
        found = replace(self, noise=noise, whitening=whitening, off=True)
        return found, block_of(whitening, linear, range(self.model.size), self.windows)

    def share(
        self, now: Block, at: Estimate, then: Block, candidate: Candidate, gains: np.ndarray
    ) -> float | None:
        """Return what a candidate takes, see `Evidence`."""
        if self.off and not flights_agree(gains):
            return None
        return super().share(now, at, then, candidate, gains)

    def slow_errors(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy (W, 12) of slow errors of the state, and what noise gives of it."""
        energy = slow_energy(self.whitening, block.residual)
        return energy[:, :STATE], self.whitening.slow_freedom[:, :STATE]

    def _everything(self, at: Estimate) -> Linearisation:
        return self.model.linearise(at.theta, at.free, self.windows, None)


def start_estimate(model: RolloutModel, windows: FlightWindows) -> Estimate:
    """Return the vehicle file's numbers and the measured starts."""
    return Estimate(model.space.array("start"), np.zeros((len(windows.flight), model.free)))


def weighed_by(
    model: RolloutModel,
    windows: FlightWindows,
    linear: Linearisation,
    limits: Thresholds = THRESHOLDS,
    noise: Noise | None = None,
    along: Sequence[int] | None = None,
) -> tuple[RolloutEvidence, Block]:
    """Return the evidence of `windows` whose noise is that of the slopes `linear`, and its block.

    Args:
        model: the rollout.
        windows: W of them.
        linear: slopes along all numbers and what is free.
        limits: of every step.
        noise: where it is known already.
        along: the numbers of the first slopes; all numbers if not given.
    """
    view = trusted(windows, linear.residual, limits)
    noise = noise or measured_noise(linear.residual, linear.start_slope, view, limits)
    whitening = make_whitening(linear, noise, view, limits)
    found = RolloutEvidence(model, windows, view, noise, whitening, limits)
    numbers = range(model.size) if along is None else along
    return found, block_of(whitening, linear, numbers, windows)


def block_of(
    whitening: Whitening, linear: Linearisation, along: Sequence[int], windows: FlightWindows
) -> Block:
    """Return the block of `linear`, whose first columns are `along` these numbers."""
    residual = whitened_residual(whitening, linear)
    slope = whiten(whitening, linear.slope[..., : len(along)])
    turned = np.swapaxes(whitening.start, 1, 2)
    by_start = turned @ np.concatenate([residual, slope], axis=2)
    moved = np.linalg.solve(whitening.upper, by_start)
    return Block(
        (residual - whitening.start @ by_start[..., :1])[..., 0],
        slope - whitening.start @ by_start[..., 1:],
        tuple(along),
        np.asarray(windows.flight),
        np.asarray(windows.start_s),
        moved[..., 0],
        moved[..., 1:],
    )


def information(
    linear: Linearisation, windows: FlightWindows, size: int, limits: Thresholds = THRESHOLDS
) -> np.ndarray:
    """Return the information of each window on each of the first `size` numbers, (W, K)."""
    noise = measured_noise(linear.residual, linear.start_slope, windows, limits)
    whitening = make_whitening(linear, noise, windows, limits)
    block = block_of(whitening, linear, range(size), windows)
    return np.asarray((block.slope**2).sum(axis=1))


def least_left(
    model: RolloutModel,
    windows: FlightWindows,
    linear: Linearisation,
    limits: Thresholds,
    enough: float = 0.0,
) -> float:
    """Return the mean squared error, 1 for noise, after a fit of all numbers of the catalogue.

    It is linear about `linear`, the slopes of `windows` along all numbers. Large effects are not
    linear: where more than `enough` remains, some windows are fitted with the full model.
    """
    evidence, block = weighed_by(model, windows, linear, limits)

    def left(chi2: float) -> float:
        return chi2 / max(int(np.asarray(evidence.trusted.seen).sum()), 1)

    equations = block.equations
    some = np.flatnonzero(np.einsum("bkk->k", equations.hessian) > 1e-9).tolist()
    start = model.space.array("start")
    _, fall = gauss_newton_step(equations.take(some), start, model.space)
    first = left(float(equations.chi2.sum()) - fall)
    if first <= enough:
        return first
    few = np.linspace(0, len(windows.flight) - 1, limits.hopeless_windows).astype(int)
    few = np.unique(few)
    part = Linearisation(*(field[few] for field in linear))
    evidence, block = weighed_by(model, take(windows, few), part, limits)
    at = Estimate(start, linear.offset[few])
    _, block = fit(evidence, at, some, limits.hopeless_rounds, block, limits)
    return min(first, left(float((block.residual**2).sum())))


BATCH = 12
"""Windows a call: one shape, compiled once."""
DIRECTIONS = 8
"""Slopes a call, compiled once. A second, wider program would take longer to compile than it saves
below some 150 stretches."""
COMPILED = {"xla_cpu_use_fusion_emitters": False}
"""XLA's options for the model: its newer code for loops is no faster, and compiles half as fast."""


class KnotResponse(NamedTuple):
    """Response of W windows to a disturbance at each knot, and the model's state there."""

    slope: np.ndarray
    """(W, N, 19, KNOTS * 6) of the simulated values, per m/s^2 and rad/s^2 in body axes."""
    knot: Flown
    """(W, KNOTS, ...) the state at the knots."""


class VehicleArrays(NamedTuple):
    """What a vehicle file fixes, as arrays, so that one compiled rollout serves every vehicle."""

    nominal: Nominal
    constants: Constants
    base: dict[str, Any]
    """Values of every effect."""
    loop: Loop | None = None
    """A firmware's rate loop."""


class RolloutModel:
    """A vehicle's compiled rollout: residuals of windows and their slopes."""

    def __init__(
        self,
        vehicle: Vehicle,
        space: ParameterSpace,
        rotor_input: bool,
        voltage: bool,
        integrator: str = "continuous",
    ) -> None:
        """Prepare the rollout of `vehicle` with the numbers of `space`.

        With `rotor_input` measured rotor speeds are the input, not the commands; `voltage` is
        whether the windows have one; `integrator` is that of `fly_windows`.
        """
        self.space = space
        self.size = len(space.entries)
        self.free = STATE + 4 * (KNOTS if rotor_input else 1)
        """Numbers F that are free in each window: its start, and the rotor speeds' errors, where
        they are the input all along it."""
        self.starts = list(range(self.size, self.size + self.free))
        """Places of the free numbers among all directions."""
        base = {name: v for name, v in space.base.items() if EFFECTS[name].by_state}
        self.given = VehicleArrays(*nominal_quadrotor(vehicle), base, loop_of(vehicle))
        self.dt = step_s(vehicle)
        """About the length of a step [s]."""
        self.integrator = integrator
        self._kind = (space.layout, rotor_input, voltage, integrator)
        self._linear = _slopes(*self._kind)
        self.fly: Callable[..., Any] = partial(_flight(*self._kind), self.given)
        """(theta, offset, windows, push, feedback) -> (simulated - measured, the flight), to be
        compiled by who needs it."""

    def residual(self, theta: np.ndarray, offset: np.ndarray, windows: FlightWindows) -> np.ndarray:
        """Return measured - simulated (W, N, 19) from starts moved by `offset` (W, F)."""
        return self.linearise(theta, offset, windows, []).residual

    def respond(
        self, theta: np.ndarray, offset: np.ndarray, windows: FlightWindows
    ) -> KnotResponse:
        """Return the response of each window's rows to additional forces and torques along it."""
        pushed = _responses(*self._kind)
        with jax.enable_x64(True):
            parts = [
                jax.tree.map(lambda x, n=count: np.asarray(x)[:n], pushed(self.given, theta, x, w))
                for x, w, count in batches(offset, windows)
            ]
        return jax.tree.map(lambda *p: np.concatenate(p), *parts)

    def linearise(
        self,
        theta: np.ndarray,
        offset: np.ndarray,
        windows: FlightWindows,
        indices: Sequence[int] | None,
    ) -> Linearisation:
        """Return residuals and slopes along the numbers at `indices`.

        With None the directions are all numbers and then the F free ones, whose places are
        `starts`.
        """
        everything = np.eye(self.size + self.free)
        count = len(everything if indices is None else indices)
        groups = grouped(everything, indices)
        values, slopes = [], []
        with jax.enable_x64(True):
            for x, w, whole in batches(offset, windows):
                answers = [self._linear(self.given, theta, x, w, group) for group in groups]
                values.append(np.asarray(answers[0][0])[:whole])
                slopes.append(np.concatenate([np.asarray(a[1])[:whole] for a in answers], axis=-1))
        slope = np.concatenate(slopes)[..., :count]
        return Linearisation(-np.concatenate(values), slope, offset)


def grouped(everything: np.ndarray, indices: Sequence[int] | None) -> list[np.ndarray]:
    """Return `DIRECTIONS` rows at a time, at least once, of `everything` or those at `indices`."""
    rows = everything if indices is None else everything[list(indices)]
    parts = [rows[k : k + DIRECTIONS] for k in range(0, max(len(rows), 1), DIRECTIONS)]
    return [np.pad(part, ((0, DIRECTIONS - len(part)), (0, 0))) for part in parts]


def batches(
    offset: np.ndarray, windows: FlightWindows
) -> Iterator[tuple[np.ndarray, FlightWindows, int]]:
    """Yield `BATCH` offsets and windows at a time, and how many of them are no repetition."""
    count = len(windows.flight)
    for first in range(0, count, BATCH):
        rows = np.minimum(np.arange(first, first + BATCH), count - 1)
        yield offset[rows], take(windows, rows), min(BATCH, count - first)


@cache
def _slopes(
    layout: ParameterLayout, rotor_input: bool, voltage: bool, integrator: str
) -> Callable[..., Any]:
    """Return the compiled slopes: XLA takes longer over them than a diagnosis does."""
    fly = _flight(layout, rotor_input, voltage, integrator)

    def linear(
        given: VehicleArrays, theta: Any, offset: Any, windows: FlightWindows, directions: Any
    ) -> Any:
        size = len(layout)

        def along(direction: Any) -> Any:
            tangent = (direction[:size], jnp.tile(direction[size:], (BATCH, 1)))
            return jax.jvp(lambda t, x: fly(given, t, x, windows)[0], (theta, offset), tangent)

        values, slopes = jax.vmap(along, out_axes=(None, -1))(directions)
        return values, slopes

    return jax.jit(linear, compiler_options=COMPILED)


@cache
def _responses(
    layout: ParameterLayout, rotor_input: bool, voltage: bool, integrator: str
) -> Callable[..., Any]:
    fly = _flight(layout, rotor_input, voltage, integrator)

    def respond(
        given: VehicleArrays, theta: Any, offset: Any, windows: FlightWindows
    ) -> KnotResponse:
        none = jnp.zeros((BATCH, KNOTS, 6))

        def along(direction: Any) -> Any:
            tangent = jnp.broadcast_to(direction.reshape(KNOTS, 6), none.shape)
            return jax.jvp(lambda p: fly(given, theta, offset, windows, p)[0], (none,), (tangent,))

        slopes = jax.vmap(lambda d: along(d)[1], out_axes=-1)(jnp.eye(KNOTS * 6))
        _, flown = fly(given, theta, offset, windows)
        return KnotResponse(slopes, at_knots(flown, windows))

    return jax.jit(respond, compiler_options=COMPILED)


def _flight(
    layout: ParameterLayout, rotor_input: bool, voltage: bool, integrator: str
) -> Callable[..., tuple[Any, Flown]]:
    """Return the function that flies windows: simulated - measured, and the flight itself."""

    def fly(
        given: VehicleArrays,
        theta: Any,
        offset: Any,
        windows: FlightWindows,
        push: Any = None,
        feedback: Feedback | None = None,
    ) -> tuple[Any, Flown]:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, LONGEST_S, 0.0, given.loop)
        flown = fly_windows(
            plant, values, rotor_input, voltage, integrator, offset, windows, push, feedback
        )
        return difference(values, integrator, flown, windows), flown

    return fly
