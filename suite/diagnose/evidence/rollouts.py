"""Rollouts (simulated stretches of 1 s) as evidence on the model's parameters.

`RolloutModel` computes the errors of rollouts and their Jacobian. `RolloutEvidence` divides both by
the measurement noise, and removes what a change of the unknown start numbers could explain: 12
numbers of the state, and errors of the rotor speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.log_faults import pose_delay
from eval.logs.flight_log import FlightLog
from eval.quadrotor.continuous import Flight
from eval.quadrotor.plant import assemble
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.noise import Linearisation, Noise, measured_noise, residual_as_noise
from suite.diagnose.data.steps import LONGEST_S, step_s
from suite.diagnose.data.whitening import Whitening, block_of, make_whitening, slow_energy
from suite.diagnose.data.windows import KNOTS, LENGTH_S, SLICES, STATE, FlightWindows, cut, take
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.gauss_newton import gauss_newton_step
from suite.diagnose.estimate.parameters import (
    Candidate,
    ParameterLayout,
    ParameterSpace,
    effects_at,
    make_space,
)
from suite.diagnose.evidence.evidence import Evaluation, Evidence, flights_agree
from suite.diagnose.evidence.linearise import (
    BATCH,
    VehicleArrays,
    arrays_of,
    batches,
    linearised,
    slopes_along,
)
from suite.diagnose.evidence.rollout import at_knots, difference, fly_windows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

ACC_ROW = 9
"""Row, of those with a velocity, to which the acceleration at a window's start is computed."""
COMPILED = {"xla_cpu_use_fusion_emitters": False}
"""Options of the compiler XLA: its newer code for loops is no faster, and compiles half as fast."""


@dataclass(frozen=True)
class RolloutEvidence(Evidence):
    """Errors of the rollouts of W windows, in units of their noise."""

    model: RolloutModel
    windows: FlightWindows
    """The windows at full length."""
    trusted: FlightWindows
    """The same windows, each shortened to the time in which the linearisation holds."""
    noise: Noise
    whitening: Whitening

    @property
    def space(self) -> ParameterSpace:
        """The parameters of all effects in the catalogue."""
        return self.model.space

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        """Return the block at `at`, with slopes along `indices`; see `Evidence`."""
        linear = self.model.linearise(at, self.trusted, indices)
        along = range(self.model.size) if indices is None else indices
        return block_of(self.whitening, linear, along)

    def estimate_noise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence with its noise estimated at `at`; see `Evidence`."""
        # The trusted windows are chosen again, as a better model stays near the flight for longer.
        linear = self.model.linearise(at, self.windows)
        new, block = rollout_evidence(self.model, linear, self.limits)
        return Evaluation(new, at, block)

    def relinearise(self, at: Estimate) -> Evaluation:
        """Evaluate this evidence with its noise unchanged; see `Evidence`."""
        linear = self.model.linearise(at, self.windows)
        new, block = rollout_evidence(self.model, linear, self.limits, self.noise)
        return Evaluation(replace(new, misfit_is_noise=self.misfit_is_noise), at, block)

    def misfit_as_noise(self, best: Evaluation) -> RolloutEvidence | None:
        """Return this evidence with its whole residual as noise; see `Evidence`."""
        slow, expected = self.slow_errors(best.block)
        if slow.sum() <= self.limits.structure_rotor_input * expected.sum():
            return None
        linear = self.model.linearise(best.at, self.windows)._replace(windows=self.trusted)
        noise = residual_as_noise(linear, self.limits)
        whitening = make_whitening(linear, noise, self.limits)
        return replace(self, noise=noise, whitening=whitening, misfit_is_noise=True)

    def accepts(
        self, before: Block, after: Evaluation, candidate: Candidate, gains: np.ndarray
    ) -> bool:
        """Return whether a candidate may be named; see `Evidence`."""
        return not self.misfit_is_noise or flights_agree(gains)

    def slow_errors(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy (W, 12) of slow errors of the state, and that by noise alone."""
        energy = slow_energy(self.whitening, block.residual)
        return energy[:, :STATE], self.whitening.slow_freedom[:, :STATE]


def start_estimate(
    model: RolloutModel, windows: FlightWindows, theta: np.ndarray | None = None
) -> Estimate:
    """Return the parameters `theta` (P,), or the vehicle file's, with the true start states.

    Logged poses have a delay, an effect (the clock offset) in `theta`. Over it, position and
    attitude change by velocity and rates, and the velocity by the acceleration.
    """
    theta = model.space.array("start") if theta is None else theta
    delay_s = pose_delay(model.space.effects(theta))
    offset = np.zeros((len(windows.flight), model.free))
    offset[:, :3] = delay_s * windows.start.vel_w
    offset[:, 3:6] = delay_s * windows.start.rate_b
    has_vel = np.asarray(windows.valid)[:, :, SLICES["velocity"].start]
    row_rank = np.minimum(ACC_ROW, has_vel.sum(axis=1))[:, None]
    row = (has_vel & (np.cumsum(has_vel, axis=1) == row_rank)).argmax(axis=1)
    window = np.arange(len(row))
    span_s = np.asarray(windows.row_s)[window, row][:, None]
    gained_w = np.asarray(windows.row.vel_w)[window, row] - windows.start.vel_w
    acc_w = gained_w / np.maximum(span_s, 1e-3)
    offset[:, 6:9] = delay_s * np.where(has_vel.any(axis=1, keepdims=True), acc_w, 0.0)
    return Estimate(theta, offset)


def rollouts_along(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    rotor_input: bool,
    voltage: bool = False,
    integrator: str = "continuous",
    stride_s: float = LENGTH_S,
    limits: Thresholds = THRESHOLDS,
) -> tuple[RolloutModel, FlightWindows, Estimate]:
    """Return the model of rollouts of `vehicle` along `logs`, the windows, and the start of a fit.

    Raises:
        ValueError: if no flight has a window.
    """
    windows, warnings = cut(logs, vehicle, rotor_input, stride_s, limits, integrator)
    if windows is None:
        raise ValueError("; ".join(warnings))
    model = RolloutModel(vehicle, rotor_input, voltage, integrator)
    return model, windows, start_estimate(model, windows)


def trusted(windows: FlightWindows, residual: np.ndarray, limits: Thresholds) -> FlightWindows:
    """Return `windows`, each shortened to the time in which the model stays near the flight.

    Further away the linearisation does not hold: the model may have tipped over or be below the
    ground. `residual` (W, N, 19) is measured - simulated.
    """
    error = np.abs(residual)
    height = np.maximum(np.asarray(windows.row.pos_w)[..., 2], 0.0)
    far = (error[..., SLICES["position"]].max(axis=-1) > limits.trusted_m) | (
        error[..., SLICES["attitude"]].max(axis=-1) > limits.trusted_rad
    )
    far |= (error[..., 2] > limits.trusted_height_share * height) & (height > 0.0)
    row_s = np.asarray(windows.row_s)
    until_s = np.full(len(row_s), limits.trusted_horizons_s[-1])
    for horizon_s in reversed(limits.trusted_horizons_s):
        stays_near = ~(far & (row_s <= horizon_s)).any(axis=1)
        until_s = np.where(stays_near, horizon_s, until_s)
    in_time = (row_s <= until_s[:, None] + 1e-9)[..., None]
    return windows._replace(valid=np.asarray(windows.valid) & in_time)


def rollout_evidence(
    model: RolloutModel,
    linear: Linearisation,
    limits: Thresholds = THRESHOLDS,
    noise: Noise | None = None,
    along: Sequence[int] | None = None,
) -> tuple[RolloutEvidence, Block]:
    """Return the evidence of linearised windows, and its block there.

    The slopes of `linear` are along the parameters `along` (default: all), then along the start
    numbers. If no `noise` is given, it is estimated from `linear`.
    """
    near = linear._replace(windows=trusted(linear.windows, linear.residual, limits))
    noise = noise or measured_noise(near, limits)
    whitening = make_whitening(near, noise, limits)
    evidence = RolloutEvidence(
        model, linear.windows, near.windows, noise, whitening, limits=limits, misfit_is_noise=False
    )
    indices = range(model.size) if along is None else along
    return evidence, block_of(whitening, linear, indices)


def is_hopeless(model: RolloutModel, linear: Linearisation, limits: Thresholds) -> bool:
    """Return whether even a fit of all parameters leaves the rollouts far from the flights.

    It uses `linear`, along all parameters. If its error is too large, which may be because effects
    are large, some windows are fitted with the full model. Without noise in the logs any error is
    many times the noise: positions within a small distance are near enough.
    """
    evidence, block = rollout_evidence(model, linear, limits)

    def is_far(chi2: float) -> bool:
        return chi2 > limits.hopeless_chi2 * max(int(evidence.trusted.valid.sum()), 1)

    equations, start = block.equations, model.space.array("start")
    informed = np.flatnonzero(np.einsum("bkk->k", equations.hessian) > 1e-9).tolist()
    _, fall = gauss_newton_step(equations.take(informed), start, model.space)
    if not is_far(float(equations.chi2.sum()) - fall):
        return False
    few = np.unique(np.linspace(0, len(linear.offset) - 1, limits.hopeless_windows).astype(int))
    evidence, block = rollout_evidence(model, take(linear, few), limits)
    at = Estimate(start, linear.offset[few])
    best = evidence.fitted(at, informed, limits.hopeless_rounds, block)
    if not is_far(float((best.block.residual**2).sum())):
        return False
    position = SLICES["position"]
    has_position = np.asarray(evidence.windows.valid)[..., position].all(axis=-1)
    error_w = model.residual(best.at, evidence.windows)[..., position][has_position]
    return float(np.sqrt((error_w**2).sum(axis=-1).mean())) > limits.hopeless_m


class RolloutModel:
    """Simulation of windows with one vehicle: their residuals and slopes, compiled."""

    def __init__(
        self, vehicle: Vehicle, rotor_input: bool, voltage: bool, integrator: str = "continuous"
    ) -> None:
        """Prepare the rollout of `vehicle`; for the other arguments see `fly_windows`."""
        self.space = space = make_space(vehicle)
        self.size = len(space.entries)
        self.free = STATE + 4 * (KNOTS if rotor_input else 1)
        """Number F of start numbers of each window, which are fitted, too: 12 of its state, and 4
        errors of rotor speeds (4 at each knot if measured speeds are the input)."""
        self.starts = list(range(self.size, self.size + self.free))
        """Places of the start numbers among all directions, after the parameters."""
        self.given = arrays_of(vehicle, space)
        self.dt = step_s(vehicle)
        """About the length of a step [s]."""
        _, self._linear, self._respond = compiled(space.layout, rotor_input, voltage, integrator)

    def residual(self, at: Estimate, windows: FlightWindows) -> np.ndarray:
        """Return measured - simulated (W, N, 19) at the estimate `at`."""
        return self.linearise(at, windows, []).residual

    def respond(
        self, at: Estimate, windows: FlightWindows, knots: int = KNOTS
    ) -> tuple[Linearisation, Flight]:
        """Return residuals and slopes along disturbances, and the states (W, KNOTS, ...) at knots.

        These are a force [m/s^2] and torque [rad/s^2] in body axes at one of K `knots` each.
        """
        with jax.enable_x64(True):
            parts = [
                jax.tree.map(
                    lambda x, n=own: np.asarray(x)[:n],
                    self._respond(self.given, at.theta, x, w, knots),
                )
                for x, w, own in batches(at.free, windows._replace(input_error=None))
            ]
        residual, slope, knot = jax.tree.map(lambda *p: np.concatenate(p), *parts)
        return Linearisation(residual, slope, at.free, windows), knot

    def linearise(
        self, at: Estimate, windows: FlightWindows, indices: Sequence[int] | None = None
    ) -> Linearisation:
        """Return residuals and slopes at the estimate `at`.

        The slopes are along the parameters at `indices`; places in `starts` mean start numbers.
        With None they are along all parameters and then all start numbers.
        """
        known = windows._replace(input_error=None)  # no part of the simulation
        values, slope = linearised(self._linear, self.given, *at, known, indices, BATCH)
        return Linearisation(-values, slope, at.free, windows)


@cache
def compiled(
    layout: ParameterLayout, rotor_input: bool, voltage: bool, integrator: str
) -> tuple[Callable[..., Any], ...]:
    """Return three functions of (vehicle, theta, offset, windows), kept as compiling is slow.

    The first gives simulated - measured and the simulated states (and takes a disturbance), the
    second that of `slopes_along`, the third the response to disturbances at the knots.
    """

    def fly(
        given: VehicleArrays, theta: Any, offset: Any, windows: FlightWindows, push: Any = None
    ) -> tuple[Any, Flight]:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, LONGEST_S, 0.0, given.loop)
        flown = fly_windows(plant, values, rotor_input, voltage, integrator, offset, windows, push)
        return difference(values, integrator, flown, windows), flown

    def respond(
        given: VehicleArrays, theta: Any, offset: Any, windows: FlightWindows, knots: int
    ) -> tuple[Any, Any, Flight]:
        none = jnp.zeros((BATCH, knots, 6))

        def along(direction: Any) -> Any:
            tangent = jnp.broadcast_to(direction.reshape(knots, 6), none.shape)
            pushed = partial(fly, given, theta, offset, windows)
            return jax.jvp(pushed, (none,), (tangent,), has_aux=True)

        error, slopes, flown = jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(knots * 6))
        return -error, slopes, at_knots(flown, windows)

    linear = slopes_along(lambda *inputs: fly(*inputs)[0])
    compile_ = partial(jax.jit, compiler_options=COMPILED)
    return fly, compile_(linear), compile_(respond, static_argnums=4)
