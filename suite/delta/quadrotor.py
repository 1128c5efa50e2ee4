"""Replay recorded actions in the trainer's quadrotor, with or without a Delta Action Model.

The replay of a window starts from the measured state; this includes the rotor speeds and the
commands that are delayed and still to act. Each row of the log is one step of the attitude loop.
The commanded yaw rate is the recorded one, because an action does not set the heading.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.logs.flight_log import FlightLog
from eval.quadrotor.stepper import hover_state
from policies.networks import delta_network
from suite.delta.windows import (
    BURN_IN_S,
    BurnIn,
    burn_in_before,
    decision_period,
    log_decisions,
    stack_windows,
    state_after,
)
from suite.train.config import QuadrotorConfig
from suite.train.dynamics.quadrotor import (
    QuadrotorState,
    Substeps,
    fly_period,
    plant_of,
    whole_steps,
)
from tracks.geometry.rotation import to_local

LEAST_PHYSICS_HZ = 250.0
"""Approximate lowest physics rate of a replay, even if training steps are longer [Hz]."""


class QuadrotorWindows(NamedTuple):
    """N windows of T rows of the log; the replay starts at row 0, at a decision of the policy."""

    pos_w: np.ndarray
    """(N, T + 1, 3) measured positions [m]."""
    vel_w: np.ndarray
    """(N, T + 1, 3) measured velocities [m/s]."""
    rot_w: np.ndarray
    """(N, 3, 3) measured attitude at the window's start, body to world."""
    rate_b: np.ndarray
    """(N, 3) measured body rates at the window's start [rad/s]."""
    rotor_speed: np.ndarray
    """(N, 4) measured rotor speeds at the window's start; NaN if not measured [rad/s]."""
    past: np.ndarray
    """(N, L, 4) commanded thrust and body rates in the L physics steps before the window, newest
    first [m/s^2, rad/s]."""
    start_s: np.ndarray
    """(N,) start of the window, from the start of the flight [s]."""
    action_b: np.ndarray
    """(N, T, 3) the policy's action that holds in each row [m/s^2]."""
    decides: np.ndarray
    """(N, T) 1 in rows in which the policy decided on a new action, else 0."""
    yaw_rate: np.ndarray
    """(N, T) commanded rate about body z [rad/s]."""
    burn_in: BurnIn


def row_period(logs: Sequence[FlightLog]) -> float:
    """Return the median time between rows of all `logs` [s]."""
    return float(np.median(np.concatenate([np.diff(log.time_s) for log in logs])))


def cut_quadrotor_windows(
    logs: Sequence[FlightLog],
    config: QuadrotorConfig,
    duration_s: float,
    stride_s: float,
    row_s: float | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> tuple[QuadrotorWindows, Substeps]:
    """Return windows of all flights, and the physics steps of one row.

    A window is left out if a value is missing or a row is not `row_s` long (within 20 %), and
    `warn` is called with a text about each flight without a window. Windows are `duration_s` long,
    and start about `stride_s` apart [s]. The default of `row_s` [s] is `row_period` of these logs.

    Raises:
        ValueError: if a log has no actions, or no flight has a window.
    """
    for log in logs:
        log_decisions(log)
        if log.rate_cmd_b is None or log.thrust_cmd is None:
            raise ValueError(
                f"{log.name}: columns cmd_thrust and cmd_rate_x, cmd_rate_y, cmd_rate_z are needed "
                "to fit the Delta Action Model of a quadrotor; record flights with suite collect"
            )
    row_s = row_period(logs) if row_s is None else row_s
    # A row is one step of the attitude loop.
    physics = whole_steps(row_s * max(config.physics_hz, LEAST_PHYSICS_HZ))
    substeps = Substeps(1, physics, row_s / physics)
    plant = plant_of(config, {}, substeps.dt, varies=False)
    delay_steps = plant.delay_weight.shape[-1]
    windows = [
        _flight_windows(log, substeps, delay_steps, row_s, duration_s, stride_s) for log in logs
    ]
    return stack_windows(windows, logs, duration_s, warn), substeps


def _flight_windows(
    log: FlightLog,
    substeps: Substeps,
    delay_steps: int,
    row_s: float,
    duration_s: float,
    stride_s: float,
) -> list[QuadrotorWindows]:
    """Return the windows of one flight; `delay_steps` is the longest delay in physics steps."""
    action, decides = log_decisions(log)
    commands = log.command
    assert commands is not None
    rows, time_s, rot_w = round(duration_s / row_s), log.time_s, log.rot_w
    # Middle of each physics step before a window, as time before its start.
    ages_s = substeps.dt * (np.arange(delay_steps) + 0.5)
    speed = np.full((len(time_s), 4), np.nan) if log.rotor_speed is None else log.rotor_speed
    # Rows with a complete state, command and action.
    whole = log.whole & np.isfinite(action).all(axis=1)
    decision_rows = np.flatnonzero(decides)
    if len(decision_rows) < 2:
        return []
    burn_in_count = round(BURN_IN_S / decision_period(time_s[decision_rows], row_s))
    rows_before = int(np.ceil(delay_steps * substeps.dt / row_s - 1e-9))
    windows, next_s = [], time_s[0]
    for number, first in enumerate(decision_rows.tolist()):
        if time_s[first] < next_s or first < rows_before or first + rows >= len(time_s):
            continue
        # The rows of the window, with those whose commands are still delayed at its start.
        used = slice(first - rows_before, first + rows + 1)
        is_steady = np.abs(np.diff(time_s[used]) - row_s) < 0.2 * row_s
        if not (whole[used].all() and is_steady.all()):
            continue
        # The next window starts at the first decision from this time on.
        next_s = time_s[first] + stride_s
        span = slice(first, first + rows + 1)
        delayed_rows = np.searchsorted(time_s, time_s[first] - ages_s, side="right") - 1
        # With jitter a step may begin before the rows that were checked.
        delayed_rows = np.maximum(delayed_rows, used.start)
        burn_in = burn_in_before(
            rot_w[decision_rows],
            log.vel_w[decision_rows],
            action[decision_rows],
            number,
            burn_in_count,
        )
        windows.append(
            QuadrotorWindows(
                log.pos_w[span],
                log.vel_w[span],
                rot_w[first],
                log.rate_b[first],
                speed[first],
                commands[delayed_rows],
                np.asarray(time_s[first] - time_s[0]),
                action[span][:-1],
                decides[span][:-1],
                commands[span][:-1, 3],
                burn_in,
            )
        )
    return windows


def replay_quadrotor(
    config: QuadrotorConfig,
    substeps: Substeps,
    windows: QuadrotorWindows,
    delta: delta_network.Params | None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return pos_w [m] and vel_w [m/s] after every row, and the corrections of the actions [m/s^2].

    Each is (N, T, 3). The vehicle's randomisation is not used. Without `delta`, the parameters of
    the Delta Action network, there is no correction.
    """
    plant = plant_of(config, {}, substeps.dt, varies=False)
    count = windows.pos_w.shape[0]
    # Rotor speeds that are not measured start as in hover.
    hover = hover_state(plant, (count,), jnp)
    speed = jnp.asarray(windows.rotor_speed)
    state = hover._replace(
        rotor_speed=jnp.where(jnp.isfinite(speed), speed, hover.rotor_speed),
        past_commands=jnp.swapaxes(jnp.asarray(windows.past), 1, 2),
    )
    zero = jnp.zeros((count, 3))
    body = QuadrotorState(
        pos_w=jnp.asarray(windows.pos_w)[:, 0],
        vel_w=jnp.asarray(windows.vel_w)[:, 0],
        acc_w=zero,
        rot_w=jnp.asarray(windows.rot_w),
        rate_b=jnp.asarray(windows.rate_b),
        heading_w=zero.at[:, 0].set(1.0),  # any: the recorded yaw rate replaces the heading
        plant=state,
        time_s=jnp.asarray(windows.start_s),
    )

    @jax.checkpoint
    def step(carry: Any, row: tuple[jax.Array, ...]) -> tuple[Any, tuple[jax.Array, ...]]:
        body, hidden, correction = carry
        action, decides, yaw_rate = row
        # The correction changes at decisions only and holds until the next one, like the action.
        if delta is not None:
            vel_b = to_local(body.rot_w, body.vel_w)
            new_correction, new_hidden = delta_network.step(
                delta, hidden, vel_b, body.rot_w[:, 2], action
            )
            is_decision = decides[:, None] > 0
            correction = jnp.where(is_decision, new_correction, correction)
            hidden = jnp.where(is_decision, new_hidden, hidden)
        body = fly_period(
            config.vehicle,
            plant,
            substeps,
            body,
            action + correction,
            lambda heading_w, _: heading_w,
            yaw_rate=yaw_rate,
        )
        return (body, hidden, correction), (body.pos_w, body.vel_w, correction)

    hidden = state_after(delta, windows.burn_in)
    by_row = (windows.action_b, windows.decides, windows.yaw_rate)
    by_row = tuple(jnp.swapaxes(jnp.asarray(x), 0, 1) for x in by_row)
    _, results = jax.lax.scan(step, (body, hidden, zero), by_row)
    pos_w, vel_w, correction_b = (jnp.swapaxes(x, 0, 1) for x in results)
    return pos_w, vel_w, correction_b
