"""Replay of recorded actions in the trainer's quadrotor, with or without corrections.

A window starts from the measured state, with rotor speeds and commands that are still delayed. Each
row of the log is one step of the attitude loop. The commanded yaw rate is the recorded one, because
an action does not set the heading.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    decisions_of,
    refuse_none,
    stacked,
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
"""Lowest physics rate of a replay, about, even if training steps are longer [Hz]."""


class QuadrotorWindows(NamedTuple):
    """N windows of T rows; row 0 is where the replay starts, at a decision."""

    pos_w: np.ndarray
    """(N, T + 1, 3) measured [m]."""
    vel_w: np.ndarray
    """(N, T + 1, 3) measured [m/s]."""
    rot_w: np.ndarray
    """(N, 3, 3) measured at the start, body to world."""
    rate_b: np.ndarray
    """(N, 3) measured at the start [rad/s]."""
    rotor_speed: np.ndarray
    """(N, 4) measured at the start [rad/s]; NaN if not measured."""
    past: np.ndarray
    """(N, L, 4) thrust and rates commanded in the L physics steps before it, newest first."""
    start_s: np.ndarray
    """(N,) since the flight's start [s]."""
    action_b: np.ndarray
    """(N, T, 3) the action that holds in each row [m/s^2]."""
    decides: np.ndarray
    """(N, T) 1 where a new action begins."""
    yaw_rate: np.ndarray
    """(N, T) commanded about body z [rad/s]."""
    burn_in: BurnIn
    """Inputs of the network before each window."""


def row_substeps(config: QuadrotorConfig, row_s: float) -> Substeps:
    """Return the physics steps of one row, which is one step of the attitude loop."""
    physics = whole_steps(row_s * max(config.physics_hz, LEAST_PHYSICS_HZ))
    return Substeps(1, physics, row_s / physics)


def row_period(logs: Sequence[FlightLog]) -> float:
    """Return the median time between rows of all `logs` [s]."""
    return float(np.median(np.concatenate([np.diff(log.time_s) for log in logs])))


def cut_quadrotor_windows(
    logs: Sequence[FlightLog],
    config: QuadrotorConfig,
    duration_s: float,
    stride_s: float,
    row_s: float | None = None,
) -> tuple[QuadrotorWindows, Substeps]:
    """Return windows of `duration_s`, about one per `stride_s` of each flight, and `row_substeps`.

    A window is left out if a value is missing or a row is not `row_s` long. `row_s` [s] is by
    default `row_period` of these logs.

    Raises:
        ValueError: if a log has no actions, or all flights are shorter than a window.
    """
    for log in logs:
        decisions_of(log)
        if log.rate_cmd_b is None or log.thrust_cmd is None:
            raise ValueError(
                f"{log.name}: columns cmd_thrust and cmd_rate_x, cmd_rate_y, cmd_rate_z are needed "
                "to fit the Delta Action Model of a quadrotor; record flights with suite collect"
            )
    row_s = row_period(logs) if row_s is None else row_s
    cut = row_substeps(config, row_s)
    plant = plant_of(config, {}, cut.dt, varies=False)
    length = plant.delay_weight.shape[-1]
    found = [
        window
        for log in logs
        for window in _flight_windows(log, cut, length, row_s, duration_s, stride_s)
    ]
    refuse_none(found, logs, duration_s)
    return stacked(found), cut


def _flight_windows(
    log: FlightLog, cut: Substeps, length: int, row_s: float, duration_s: float, stride_s: float
) -> list[QuadrotorWindows]:
    action, decides = decisions_of(log)
    assert log.rate_cmd_b is not None and log.thrust_cmd is not None
    rows, time = round(duration_s / row_s), log.time_s
    rot_w = log.rot_w
    commanded = np.concatenate([log.thrust_cmd[:, None], log.rate_cmd_b], axis=1)
    ages_s = cut.dt * (np.arange(length) + 0.5)
    speed = np.full((len(time), 4), np.nan) if log.rotor_speed is None else log.rotor_speed
    at = np.flatnonzero(decides & log.whole)
    if len(at) < 2:
        return []
    before = round(BURN_IN_S / decision_period(time[at], row_s))
    back = int(np.ceil(length * cut.dt / row_s - 1e-9))
    found, next_s = [], time[0]
    for number, first in enumerate(at.tolist()):
        span = slice(first, first + rows + 1)
        if time[first] < next_s or first < back or first + rows >= len(time):
            continue
        steady = np.abs(np.diff(time[first - back : first + rows + 1]) - row_s) < 0.2 * row_s
        if not (log.whole[first - back : first + rows + 1].all() and steady.all()):
            continue
        next_s = time[first] + stride_s
        held = np.searchsorted(time, time[first] - ages_s, side="right") - 1
        found.append(
            QuadrotorWindows(
                log.pos_w[span],
                log.vel_w[span],
                rot_w[first],
                log.rate_b[first],
                speed[first],
                commanded[held],
                np.asarray(time[first] - time[0]),
                action[span][:-1],
                decides[span][:-1],
                log.rate_cmd_b[span][:-1, 2],
                burn_in_before(rot_w[at], log.vel_w[at], action[at], number, before),
            )
        )
    return found


def replay_quadrotor(
    config: QuadrotorConfig,
    cut: Substeps,
    windows: QuadrotorWindows,
    delta: delta_network.Params | None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return pos_w, vel_w (N, T, 3) after every row, and the corrections (N, T, 3).

    Args:
        config: the vehicle; its randomisation is not used.
        cut: physics steps of one row.
        windows: the recorded flights.
        delta: parameters of the Delta Action network; None for no correction.
    """
    plant = plant_of(config, {}, cut.dt, varies=False)
    count = windows.pos_w.shape[0]
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
        heading_w=zero.at[:, 0].set(1.0),
        plant=state,
        time_s=jnp.asarray(windows.start_s),
    )

    @jax.checkpoint
    def step(carry: Any, row: tuple[jax.Array, ...]) -> tuple[Any, tuple[jax.Array, ...]]:
        body, hidden, correction = carry
        action, decides, yaw_rate = row
        if delta is not None:
            vel_b = to_local(body.rot_w, body.vel_w)
            fresh, after = delta_network.step(delta, hidden, vel_b, body.rot_w[:, 2], action)
            now = decides[:, None] > 0
            correction = jnp.where(now, fresh, correction)
            hidden = jnp.where(now, after, hidden)
        body = fly_period(
            config.vehicle,
            plant,
            cut,
            body,
            action + correction,
            lambda heading_w, _: heading_w,
            yaw_rate=yaw_rate,
        )
        return (body, hidden, correction), (body.pos_w, body.vel_w, correction)

    hidden = state_after(delta, windows.burn_in)
    by_row = (windows.action_b, windows.decides, windows.yaw_rate)
    by_row = tuple(jnp.swapaxes(jnp.asarray(x), 0, 1) for x in by_row)
    _, flown = jax.lax.scan(step, (body, hidden, zero), by_row)
    pos_w, vel_w, correction_b = (jnp.swapaxes(x, 0, 1) for x in flown)
    return pos_w, vel_w, correction_b
