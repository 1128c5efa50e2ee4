"""Compares named effects with a black box, on held-out flights and at speeds above the fitted ones.

A black box is a regression without physics. This one is a Delta Action Model: a network that adds a
correction to the simulated quadrotor. The network of Su et al. 2026 (Sec. III-D) takes the velocity
in body axes, the attitude and the commanded net acceleration. Its output is added to the body's
linear acceleration. Here three further outputs are added to the angular acceleration, because the
commands contain body rates, too. The network is fitted by gradients through rollouts (simulated
stretches of 1 s), to the same errors as the named effects.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion
from eval.quadrotor.stepper import Feedback, Inputs
from policies.networks import delta_network
from suite.diagnose.data.colour import Noise
from suite.diagnose.data.windows import (
    LENGTH_S,
    STATE,
    FlightWindows,
    take,
)
from suite.diagnose.estimate.gauss_newton import fit
from suite.diagnose.evidence.rollouts import (
    BATCH,
    RolloutModel,
    batches,
    rollout_evidence,
    start_estimate,
)
from suite.diagnose.sources.rollout_source import of_rollouts
from suite.diagnose.sources.source import Finding
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.gap import Gap
from suite.diagnose.verdict.rollout_gap import (
    Rollouts,
    gap_of,
    measure,
    noise_floor,
    start_noise,
    true_starts,
)
from tracks.geometry.rotation import to_local


class BlackBoxComparison(NamedTuple):
    """Gaps (held-out errors) of three models, on windows (1 s stretches) that no fit has used."""

    judged_on: str
    """Description of the windows on which the gaps are computed, for people."""
    fitted: int
    """Number of windows to which the models were fitted."""
    judged: int
    """Number of windows on which the gaps are computed."""
    before: Gap
    """With the vehicle file as it is."""
    named: Gap | None
    """With the named effects, fitted to the same windows as the black box; None without any."""
    black_box: Gap
    """With the network's correction."""


@dataclass(frozen=True)
class BlackBoxComparisons:
    """The comparisons on held-out flights and at higher speeds."""

    held_out: BlackBoxComparison
    """Comparison on the flights that the diagnosis held out."""
    outside: BlackBoxComparison | None
    """Comparison of models that are fitted to slow windows and tested on fast ones; None where
    there are too few of either."""
    split_m_s: float
    """Speed between slow and fast [m/s]."""
    seconds: float
    """Duration of all fits [s]."""


def compare_black_box(
    flown: Rollouts,
    finding: Finding,
    config: BlackBoxConfig,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> BlackBoxComparisons:
    """Fit the black box twice and compare it with the named effects.

    Args:
        flown: the flights as rollouts.
        finding: the named effects and the gaps that the diagnosis found with these rollouts.
        config: settings of the fits.
        progress: called with the share that is done, 0 to 1, and a line for people.

    Raises:
        FloatingPointError: where a fit diverges.
    """
    began = time.monotonic()
    limits, search, model, held = flown.limits, finding.search, flown.model, flown.held
    noise = of_rollouts(search.last).noise

    def show(fit_number: int) -> Callable[[int, str], None]:
        return lambda step, words: progress(0.5 * (fit_number + step / config.iterations), words)

    # First comparison: fitted to the flights that are not held out, tested on the held-out ones.
    training = _not_held_out(flown.cut(limits.check_stride_s), held)
    params = fit_black_box(model, training, noise, config, show(0))
    held_out = BlackBoxComparison(
        judged_on="flights left out",
        fitted=len(training.flight),
        judged=len(held.flight),
        before=finding.before,
        named=finding.after if search.named else None,
        black_box=black_box_gap(model, params, held, noise, limits),
    )
    # Second comparison: fitted to slow windows, tested on faster ones.
    windows = flown.cut(LENGTH_S)
    top, mean = _speeds(flown.logs, windows)
    split = float(np.quantile(top, limits.slow_share))
    slow, fast = take(windows, top <= split), take(windows, mean > split)
    outside = None
    if min(len(slow.flight), len(fast.flight)) >= limits.least_judged:
        params = fit_black_box(model, slow, noise, replace(config, seed=config.seed + 1), show(1))
        named = None
        if search.named:
            start = start_estimate(model, slow)
            linear = model.linearise(start.theta, start.free, slow, None)
            evidence, block = rollout_evidence(model, slow, linear, limits, noise)
            best, _ = fit(evidence, start, search.indices, known=block, limits=limits)
            named = measure(model, best.theta, fast, noise, limits)
        outside = BlackBoxComparison(
            judged_on=f"speeds above {split:.1f} m/s, fitted below",
            fitted=len(slow.flight),
            judged=len(fast.flight),
            before=measure(model, flown.start, fast, noise, limits),
            named=named,
            black_box=black_box_gap(model, params, fast, noise, limits),
        )
    return BlackBoxComparisons(held_out, outside, split, time.monotonic() - began)


def _not_held_out(windows: FlightWindows, held: FlightWindows) -> FlightWindows:
    """Return those of `windows` that do not overlap the windows `held` out."""
    training = ~np.isin(windows.flight, held.flight)
    if not training.any():  # of a single flight only the end is held out
        training = np.asarray(windows.start_s) + LENGTH_S <= float(np.min(held.start_s)) + 1e-6
    return take(windows, training)


def _speeds(logs: Sequence[FlightLog], windows: FlightWindows) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest speed in each window (W,) and the mean speed in each (W,) [m/s]."""
    speeds = []
    for flight, start_s in zip(windows.flight, windows.start_s, strict=True):
        log = logs[int(flight)]
        time_s = log.time_s - log.time_s[0]
        inside = (time_s >= start_s - 1e-6) & (time_s <= start_s + LENGTH_S + 1e-6)
        speed = log.speed[inside]
        speed = speed[np.isfinite(speed)]
        speeds.append((speed.max(), speed.mean()))
    top, mean = np.array(speeds).T
    return top, mean


PERIOD_S = 0.02
"""Period at which the network runs; its correction is held in between [s]."""
OUTPUT_SCALE = (1.0, 1.0, 1.0, 5.0, 5.0, 5.0)
"""Units of the network's outputs: linear [m/s^2] and angular [rad/s^2] acceleration."""


@dataclass(frozen=True)
class BlackBoxConfig:
    """Settings of the fit of the black box."""

    iterations: int = 300
    """Number of gradient steps. Each uses a dozen windows."""
    rate: float = 5e-3
    """Peak learning rate; it falls to zero as a cosine."""
    seed: int = 0
    """Seed of the network's start and of the batches."""


def fit_black_box(
    model: RolloutModel,
    windows: FlightWindows,
    noise: Noise,
    config: BlackBoxConfig,
    show: Callable[[int, str], None] = lambda *_: None,
) -> dict[str, np.ndarray]:
    """Return the network's weights, fitted to `windows` with the vehicle file's parameters.

    Args:
        model: the simulation that the network corrects.
        windows: W stretches to fit.
        noise: measurement noise of the channels, by which errors are weighted.
        config: settings of the fit.
        show: called after each step with the number of steps and a line for people.

    Raises:
        FloatingPointError: where the fit diverges.
    """
    theta = model.space.array("start")
    offset = true_starts(model, theta, windows)
    slope = model.linearise(theta, offset, windows, model.starts).slope[..., :STATE, :STATE]
    weight = 1.0 / (noise_floor(slope, start_noise(noise.sigma, windows, STATE)) + 1e-9)
    optimizer = optax.adam(optax.cosine_decay_schedule(config.rate, config.iterations))

    def loss(params: Any, offset: Any, windows: FlightWindows, weight: Any) -> Any:
        over_noise = _errors(model, theta, params, offset, windows)[..., :STATE] * weight
        # A pseudo-Huber loss: with squares one diverging window would dominate.
        return (jnp.sqrt(1.0 + over_noise**2) - 1.0).mean()

    @jax.jit
    def update(params: Any, state: Any, *batch: Any) -> tuple[Any, Any, Any]:
        value, gradient = jax.value_and_grad(loss)(params, *batch)
        change, state = optimizer.update(gradient, state)
        return optax.apply_updates(params, change), state, value

    rng = np.random.default_rng(config.seed)
    with jax.enable_x64(True):
        params = _initial_weights(config.seed)
        state = optimizer.init(params)
        for iteration in range(config.iterations):
            rows = rng.choice(len(offset), BATCH, replace=len(offset) < BATCH)
            batch = (offset[rows], take(windows, rows), weight[rows])
            params, state, value = update(params, state, *batch)
            if not np.isfinite(value):
                raise FloatingPointError(f"the black box's fit diverged at step {iteration + 1}")
            show(iteration + 1, f"error {float(value):.2f}")
        return {name: np.asarray(value) for name, value in params.items()}


def black_box_gap(
    model: RolloutModel,
    params: dict[str, np.ndarray],
    windows: FlightWindows,
    noise: Noise,
    limits: Thresholds = THRESHOLDS,
) -> Gap:
    """Return the gap on `windows` with the network whose fitted weights are `params`."""
    theta = model.space.array("start")
    offset = true_starts(model, theta, windows)
    linear = model.linearise(theta, offset, windows, model.starts)
    fly = jax.jit(lambda start_offset, batch: _errors(model, theta, params, start_offset, batch))
    with jax.enable_x64(True):
        errors = [
            np.asarray(fly(start_offset, batch))[:count]
            for start_offset, batch, count in batches(offset, windows)
        ]
    return gap_of(linear._replace(residual=-np.concatenate(errors)), windows, noise, limits)


def _initial_weights(seed: int) -> dict[str, Any]:
    """Return random weights, but with a last layer of zeros, so that the correction begins at 0."""
    params = {k: jnp.asarray(v, float) for k, v in delta_network.init(jax.random.key(seed)).items()}
    params["output.weight"] = jnp.zeros((delta_network.HIDDEN, len(OUTPUT_SCALE)))
    params["output.bias"] = jnp.zeros(len(OUTPUT_SCALE))
    return params


def _errors(
    model: RolloutModel, theta: Any, params: Any, offset: Any, windows: FlightWindows
) -> Any:
    """Return simulated - measured (B, N, 19) with the correction of the network `params`.

    The start states are corrected by `offset`.
    """
    count, network_steps = len(offset), max(1, round(PERIOD_S / model.dt))
    scale, body_z = jnp.asarray(OUTPUT_SCALE), jnp.array([0.0, 0.0, 1.0])

    def correct(carry: Any, motion: Motion, inputs: Inputs, index: Any) -> tuple[Any, Any]:
        assert inputs.command is not None
        thrust = inputs.command.thrust
        # Where measured rotor speeds are the input there may be no command: their thrust is used.
        if inputs.rotor_speed is not None:
            nominal = model.given.nominal
            force = nominal.thrust_coefficient * (inputs.rotor_speed**2).sum(-1)
            thrust = force / nominal.mass

        def run_network(_: Any) -> Any:
            up_b = motion.rot_w[:, 2]  # world z in body axes
            action_b = thrust[:, None] * body_z - GRAVITY * up_b
            vel_b = to_local(motion.rot_w, motion.vel_w)
            correction, memory = delta_network.step(params, carry[0], vel_b, up_b, action_b)
            return memory, scale * correction

        carry = jax.lax.cond(index % network_steps == 0, run_network, lambda _: carry, None)
        return carry, carry[1]

    # Carried from step to step: the memory of the network, and its last correction.
    initial_carry = (
        jnp.zeros((count, delta_network.HIDDEN)),
        jnp.zeros((count, len(OUTPUT_SCALE))),
    )
    return model.fly(theta, offset, windows, None, Feedback(initial_carry, correct))[0]
