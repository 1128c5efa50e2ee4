"""Fit a Delta Action Model by gradients through the dynamics that it corrects.

A fit replays windows (short parts of measured flights) in simulation and makes the difference
small. The model is compared with the trainer's point mass, and with a point mass whose lag (rate at
which the acceleration follows the command), drag and delay are fitted to the same flights. A
network is only useful if it is better than this plain system identification.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from policies.networks import delta_network
from suite.delta.replay import PointMassModel, nominal_model, replay_point_mass
from suite.delta.windows import PointMassWindows, without_memory
from suite.train.config import PointMassConfig
from tracks.input.ranges import Iterations, Range, Seed

IDENTIFY_RATE = 3e-2
"""Least learning rate for lag, drag and delay, which change more than a network's weights."""
CURVE_WINDOWS = 512
"""Approximate number of fitted windows, evenly selected, from which the learning curve's fit error
is computed."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of the fit."""

    horizon_s: Annotated[float, Range(0.01, 60.0)] = 1.0
    """Length of a replayed window [s]."""
    stride_s: Annotated[float, Range(0.001, 60.0)] = 0.2
    """Time between the starts of windows [s]."""
    held_out: Annotated[float, Range(0.0, 1.0, above=True, below=True)] = 0.25
    """Share of the flights that are held out: the fit does not use them."""
    iterations: Iterations = 1500
    """Gradient steps."""
    batch: Annotated[int, Range(1, 10**6)] = 256
    """Windows per gradient step."""
    rate: Annotated[float, Range(0.0, 10.0)] = 5e-3
    """Peak learning rate, with cosine decay to zero."""
    velocity_weight: Annotated[float, Range(0.0, 1e6)] = 0.3
    """Weight of the velocity error in the loss; the position error has weight 1 [s]."""
    blank_share: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Share of a batch's windows in which the network starts with an empty memory, as in simulated
    flights of the trainer that start between two gates."""
    size_weight: Annotated[float, Range(0.0, 1e6)] = 1e-3
    """Weight of the correction's size, which keeps it small [s^2]."""
    seed: Seed = 0
    """Seed of the network, the split and the batches."""


class ReplayErrors(NamedTuple):
    """Differences of the replayed and the measured state at a window's end, means over windows."""

    position_m: float
    """Distance of the positions [m]."""
    velocity_m_s: float
    """Size of the velocities' difference [m/s]."""


@dataclass(frozen=True)
class DeltaFit:
    """A fitted network and the errors of the models on held-out flights."""

    params: dict[str, np.ndarray]
    """Parameters of the Delta Action network."""
    errors: dict[str, ReplayErrors]
    """Errors on held-out flights by model, a key of `suite.delta.run.MODEL_NAMES`. The first are
    those of the dynamics without the network, the last those with it."""
    curve: list[dict[str, float]]
    """Learning curve. Each row has the iteration and the position errors on fitted and on held-out
    windows [m]."""
    identified: PointMassModel | None = None
    """The point mass whose lag, drag and delay were fitted for comparison, if the network was
    fitted through the point mass."""


Replay = Callable[[Any, Any], tuple[jax.Array, jax.Array, jax.Array]]
"""(windows, network or None) -> pos_w [m] and vel_w [m/s] after each step, and the corrections of
the actions [m/s^2], (N, T, 3) each. The network is given by its parameters."""


def window_errors(replay: Replay, windows: Any, delta: Any) -> tuple[jax.Array, jax.Array]:
    """Return the position [m] and velocity [m/s] errors at the end of every window, (N,) each.

    `delta` are the network's parameters; None replays without a network.
    """
    pos, vel, _ = replay(windows, delta)
    return (
        jnp.linalg.norm(pos[:, -1] - windows.pos_w[:, -1], axis=1),
        jnp.linalg.norm(vel[:, -1] - windows.vel_w[:, -1], axis=1),
    )


def _loss(config: FitConfig, replay: Replay, windows: Any, delta: Any) -> jax.Array:
    """Return the loss [m]: the mean error over all steps, plus a penalty on large corrections.

    The error is that of the position, plus the weighted one of the velocity. The penalty is the
    weighted mean of the corrections' squared lengths.
    """
    pos, vel, correction = replay(windows, delta)

    def mean_norm(vector: jax.Array) -> jax.Array:
        # The small number keeps the gradient finite at zero.
        return jnp.sqrt((vector * vector).sum(-1) + 1e-8).mean()

    error = mean_norm(pos - windows.pos_w[:, 1:])
    error += config.velocity_weight * mean_norm(vel - windows.vel_w[:, 1:])
    return error + config.size_weight * (correction * correction).sum(-1).mean()


def _descend(
    config: FitConfig,
    loss: Callable[[Any, Any], jax.Array],
    start: Any,
    windows: Any,
    iterations: int,
    after_step: Callable[[int, Any], None],
) -> Any:
    """Return the variables that minimise `loss` on batches of `windows`, by Adam.

    `loss` maps the variables and a batch of windows to the loss. `after_step` is called with the
    iteration and the variables after every gradient step.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(config.rate, iterations))

    @jax.jit
    def update(variables: Any, state: Any, batch: Any) -> tuple[Any, Any]:
        gradient = jax.grad(loss)(variables, batch)
        change, state = optimizer.update(gradient, state)
        return optax.apply_updates(variables, change), state

    rng = np.random.default_rng(config.seed)
    count = len(windows.pos_w)
    # Without weak types, which an update would change, so that `update` is compiled once.
    variables = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), start)
    state = optimizer.init(variables)
    for iteration in range(iterations):
        chosen = rng.choice(count, min(config.batch, count), replace=False)
        batch = jax.tree.map(itemgetter(chosen), windows)
        variables, state = update(variables, state, batch)
        after_step(iteration, variables)
    return variables


def identify(
    config: FitConfig, physics: PointMassConfig, windows: PointMassWindows
) -> PointMassModel:
    """Return the point mass whose lag, drag and delay replay `windows` best."""
    nominal = nominal_model(physics)
    # The logarithm keeps the lag positive.
    start = (jnp.log(nominal.lag), nominal.drag, nominal.delay)

    def as_model(variables: Any) -> PointMassModel:
        lag, drag, delay = variables
        return PointMassModel(jnp.exp(lag), drag, jnp.clip(delay, 0.0, 2.0))

    def loss(variables: Any, batch: PointMassWindows) -> jax.Array:
        return _loss(config, partial(replay_point_mass, as_model(variables)), batch, None)

    # A few parameters need fewer steps than a network.
    iterations = max(1, config.iterations // 3)
    faster = replace(config, rate=max(config.rate, IDENTIFY_RATE))
    best = _descend(faster, loss, start, windows, iterations, lambda *_: None)
    return as_model(best)


def fit_network(
    config: FitConfig,
    replay: Replay,
    fit_windows: Any,
    held_out: Any,
    show: Callable[[int, str], None] = lambda *_: None,
) -> DeltaFit:
    """Fit a network by gradients through `replay` to `fit_windows`; evaluate it on `held_out`.

    The `replay` is differentiable. `show` is called with the iteration and a text.
    """
    errors = jax.jit(partial(window_errors, replay))
    # Division that rounds up: at most CURVE_WINDOWS windows are selected.
    stride = -(-len(fit_windows.pos_w) // CURVE_WINDOWS)
    curve_windows = jax.tree.map(itemgetter(slice(None, None, stride)), fit_windows)
    curve: list[dict[str, float]] = []
    period = max(1, config.iterations // 50)  # about 50 rows

    def add_to_curve(iteration: int, params: delta_network.Params) -> None:
        if iteration % period and iteration + 1 < config.iterations:
            return
        row = {
            "iteration": iteration,
            "fit_m": float(errors(curve_windows, params)[0].mean()),
            "held_out_m": float(errors(held_out, params)[0].mean()),
        }
        curve.append(row)
        label = f"error after {config.horizon_s:g} s"
        show(iteration + 1, f"{label} {row['fit_m']:.3f} m, held out {row['held_out_m']:.3f} m")

    start = delta_network.init(jax.random.key(config.seed))

    def loss(params: delta_network.Params, batch: Any) -> jax.Array:
        # Some windows start without memory. Batches are in random order, so the first windows of a
        # batch are a random selection.
        burn_in = without_memory(batch.burn_in, config.blank_share)
        return _loss(config, replay, batch._replace(burn_in=burn_in), params)

    params = _descend(config, loss, start, fit_windows, config.iterations, add_to_curve)
    return DeltaFit(
        params={name: np.asarray(value) for name, value in params.items()},
        errors={
            "without": _means(errors(held_out, None)),
            "delta_action": _means(errors(held_out, params)),
        },
        curve=curve,
    )


def _means(errors: tuple[jax.Array, jax.Array]) -> ReplayErrors:
    """Return the means over windows of what `window_errors` returns."""
    return ReplayErrors(*(float(error.mean()) for error in errors))


def fit_point_mass(
    config: FitConfig,
    physics: PointMassConfig,
    fit_windows: PointMassWindows,
    held_out: PointMassWindows,
    show: Callable[[int, str], None] = lambda *_: None,
) -> DeltaFit:
    """Fit the Delta Action Model of the point mass, and a point mass for comparison.

    The network corrects the middle of the ranges of `physics`, the trainer's point mass. `show` is
    called with the iteration and a text.
    """
    nominal = partial(replay_point_mass, nominal_model(physics))
    network = fit_network(config, nominal, fit_windows, held_out, show)
    identified = identify(config, physics, fit_windows)
    errors = jax.jit(partial(window_errors, partial(replay_point_mass, identified)))
    found = {
        "point_mass": network.errors["without"],
        "fitted_point_mass": _means(errors(held_out, None)),
        "delta_action": network.errors["delta_action"],
    }
    return replace(network, errors=found, identified=identified)
