"""Recorded actions flown again in the trainer's quadrotor, corrected or not.

A window starts from everything that was measured, rotor speeds and the commands on their way
among it, and goes along the rows of the log, which are the steps of the attitude loop. The
commanded yaw rate follows the record: where the nose points is not the action's to say.
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
"""Records are flown again at about this rate even where training steps are longer [Hz]."""


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
    """(N, 4) measured at the start [rad/s]; NaN where it was not."""
    past: np.ndarray
    """(N, L, 4) thrust and rates commanded in the physics steps before, newest first."""
    start_s: np.ndarray
    """(N,) since the flight's start [s]."""
    action_b: np.ndarray
    """(N, T, 3) the action in use [m/s^2]."""
    decides: np.ndarray
    """(N, T) 1 where a new action begins."""
    yaw_rate: np.ndarray
    """(N, T) commanded about body z [rad/s]."""
    burn_in: BurnIn
    """What the network saw before each window."""


def row_substeps(config: QuadrotorConfig, row_s: float) -> Substeps:
    """Return how a row's period is cut: one step of the attitude loop."""
    physics = whole_steps(row_s * max(config.physics_hz, LEAST_PHYSICS_HZ))
    return Substeps(1, physics, row_s / physics)


def row_period(logs: Sequence[FlightLog]) -> float:
    """Return the time between rows, the median over all of `logs` [s]."""
    return float(np.median(np.concatenate([np.diff(log.time_s) for log in logs])))


def cut_quadrotor_windows(
    logs: Sequence[FlightLog],
    config: QuadrotorConfig,
    duration_s: float,
    stride_s: float,
    row_s: float | None = None,
) -> tuple[QuadrotorWindows, Substeps]:
    """Return windows of `duration_s`, about one every `stride_s` of every flight, and their grid.

    A window with a missing value or a row of another length than `row_s` is left out; `row_s` [s]
    is these logs' own where it is not given.

    Raises:
        ValueError: where a log has no actions, or no flight is as long as a window.
    """
    for log in logs:
        if log.action_b is None or log.policy_step is None or log.rate_cmd_b is None:
            raise ValueError(
                f"{log.name}: columns action_x, action_y, action_z, policy_step and cmd_* are "
                "needed to fit the Delta Action Model; record flights with suite collect"
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
    action, decides = log.action_b, log.policy_step
    assert action is not None and decides is not None and log.rate_cmd_b is not None
    assert log.thrust_cmd is not None
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
        config: the vehicle, without anything that varies.
        cut: the grid of a row.
        windows: the record.
        delta: parameters of the Delta Action network; None leaves the actions as they are.
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
