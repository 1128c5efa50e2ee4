"""Cut recorded flights into windows that start at a policy's decision, for replay in simulation.

A window is a short part of a flight. In fine-tuning a Delta Action Model runs for seconds, so its
memory is not empty in most steps. Therefore it first runs over the measurements before a window
(burn-in). Some windows start without memory, like the trainer's flights that start between two
gates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from eval.logs.flight_log import FlightLog
from policies.networks import delta_network
from suite.delta.log_rows import take_rows
from tracks.geometry.rotation import quat_to_rot, to_local
from tracks.geometry.scene import Array

T = TypeVar("T")
RATE_SHARE = 0.05
"""Largest relative difference of decision rates that count as equal."""
COMPLETE = "has all values, decisions and rows"
"""What is necessary for a window, for messages."""
HISTORY = 2
"""Number of decisions before a window whose commands may still act in it, because of the delay."""


class PointMassWindows(NamedTuple):
    """N windows of T decisions; the replay starts at row 0."""

    pos_w: np.ndarray
    """(N, T + 1, 3) measured positions [m]."""
    vel_w: np.ndarray
    """(N, T + 1, 3) measured velocities [m/s]."""
    acc_w: np.ndarray
    """(N, 3) measured acceleration at the window's start [m/s^2]."""
    rot_w: np.ndarray
    """(N, 3, 3) measured attitude at the window's start, body to world."""
    heading_w: np.ndarray
    """(N, T + 1, 3) measured heading, horizontal unit vectors."""
    action_b: np.ndarray
    """(N, T, 3) the policy's actions in the flight [m/s^2]."""
    commands_w: np.ndarray
    """(N, HISTORY, 3) actions before the window in world axes, latest first [m/s^2]."""
    time_step: np.ndarray
    """(N, T) time between a decision and the next one [s]."""
    burn_in: BurnIn


def _heading(rot_w: np.ndarray) -> np.ndarray:
    """Return the heading (..., 3) from which `point_mass.attitude` computes the same attitude.

    It is horizontal and perpendicular to body y. If the body is rolled, it differs from the
    horizontal projection of body x.
    """
    # Columns of R: the axes y and z of the body, in world axes.
    left, up = rot_w[..., 1], rot_w[..., 2]
    forward = np.stack([left[..., 1], -left[..., 0], np.zeros_like(left[..., 0])], axis=-1)
    forward = np.where(up[..., 2:] < 0, -forward, forward)
    size = np.linalg.norm(forward, axis=-1, keepdims=True)
    return np.where(size > 1e-3, forward / np.maximum(size, 1e-3), [1.0, 0.0, 0.0])


def cut_windows(
    logs: Sequence[FlightLog],
    duration_s: float,
    stride_s: float,
    warn: Callable[[str], None] = lambda text: None,
) -> PointMassWindows:
    """Return windows of `duration_s`, about one per `stride_s` of every flight.

    A window with a missing value is left out, and `warn` is called with a text about each flight
    without a window. The acceleration at the start is the change of the measured velocity from the
    first row to the next, divided by the time between them.

    Raises:
        ValueError: if a log has no actions, or no flight has a window.
    """
    windows = [_flight_windows(log, duration_s, stride_s) for log in logs]
    return stack_windows(windows, logs, duration_s, warn)


def stack_windows(
    by_flight: Sequence[Sequence[T]],
    logs: Sequence[FlightLog],
    duration_s: float,
    warn: Callable[[str], None],
) -> T:
    """Return the windows of each of `logs` along a new first axis, as 32-bit numbers.

    They are truncated to the number of decisions that all have, and so are their burn-ins, since
    flights with slightly shorter periods have more decisions in the same time. `warn` is called
    with a text about each flight without a window.

    Raises:
        ValueError: if no flight has a window of `duration_s` [s].
    """
    items: Sequence[Any] = [window for windows in by_flight for window in windows]
    if not items:
        names = ", ".join(log.name for log in logs[:3])
        raise ValueError(
            f"no window of {duration_s} s in {len(logs)} flights ({names}, ...) {COMPLETE}; record "
            "longer flights with suite collect"
        )
    for log, windows in zip(logs, by_flight, strict=True):
        if not windows:
            warn(f"{log.name}: not used, no window of {duration_s} s {COMPLETE}")
    count = min(len(item.burn_in.seen) for item in items)
    items = [
        item._replace(burn_in=BurnIn(*(array[len(array) - count :] for array in item.burn_in)))
        for item in items
    ]

    def stacked(*arrays: Any) -> np.ndarray:
        if np.ndim(arrays[0]):
            steps = min(map(len, arrays))
            arrays = tuple(array[:steps] for array in arrays)
        return np.stack(arrays).astype(np.float32)

    return jax.tree.map(stacked, *items)


def on_state_rows(log: FlightLog) -> FlightLog:
    """Return `log` without rows that lack a state, with the commands from each state to the next.

    `suite fly` logs a set point when it was sent, some milliseconds after the state it answers. A
    state gets the first command before the next state, or else the one before goes on.
    """
    state = np.concatenate([log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b], axis=1)
    has_state = np.isfinite(state).all(axis=1)
    command = log.command
    if has_state.all() or command is None:
        return log
    rows, sent = np.flatnonzero(has_state), np.flatnonzero(np.isfinite(command).all(axis=1))
    if not len(sent):
        return log
    # Places in `sent` of the first command from each state on, and of the last one before the next.
    last = np.searchsorted(sent, np.append(rows[1:], len(command))) - 1
    place = np.minimum(np.searchsorted(sent, rows), last)
    moved = np.where(place[:, None] >= 0, command[sent[place]], np.nan)
    return take_rows(log, rows, thrust_cmd=moved[:, 0], rate_cmd_b=moved[:, 1:])


def log_decisions(log: FlightLog) -> tuple[np.ndarray, np.ndarray]:
    """Return a log's actions (T, 3) [m/s^2], and (T,) bool: rows in which the policy decided.

    Only rows with a complete state, command and action count.

    Raises:
        ValueError: if the log has no actions.
    """
    if {"action_thrust", "action_rotor_1"} & log.extra.keys():
        raise ValueError(
            f"{log.name}: its policy commands thrust and body rates, or rotors, and a Delta Action "
            "Model corrects accelerations; record flights of a policy of kind acceleration"
        )
    if log.action_b is None or log.policy_step is None:
        raise ValueError(
            f"{log.name}: columns action_x, action_y, action_z and policy_step are needed to fit "
            "the Delta Action Model; record flights with suite collect"
        )
    return log.action_b, log.policy_step & log.whole & np.isfinite(log.action_b).all(axis=1)


def decision_period(time_s: np.ndarray, row_s: float) -> float:
    """Return the time between a policy's decisions [s], NaN for fewer than two decisions.

    It is a mean, because decisions are marked at a log's rows: with rows every 10 ms and 15
    decisions a second, periods are 60 or 70 ms. Periods with a lost decision do not count.

    Args:
        time_s: (T,) times of the rows with a decision [s].
        row_s: time between rows [s].
    """
    gaps_s = np.diff(time_s)
    if not len(gaps_s):
        return float("nan")
    return float(gaps_s[are_consecutive(gaps_s, float(np.median(gaps_s)), row_s)].mean())


def decision_rate(logs: Sequence[FlightLog]) -> float:
    """Return the median rate of the policy's decisions over the flights [Hz].

    Raises:
        ValueError: if the rates differ, since the network makes one step per decision, or a log has
            no decisions.
    """
    rates_hz = []
    for log in logs:
        rows = np.flatnonzero(log_decisions(log)[1])
        row_s = float(np.median(np.diff(log.time_s)))
        rates_hz.append(1.0 / decision_period(log.time_s[rows], row_s))
    if np.isnan(rates_hz).all():
        raise ValueError(
            f"{logs[0].name}: column policy_step marks fewer than two decisions, as in all other "
            "flights; record longer flights with suite collect"
        )
    median = float(np.nanmedian(rates_hz))
    for log, rate in zip(logs, rates_hz, strict=True):
        if abs(rate - median) > RATE_SHARE * median:
            raise ValueError(
                f"{log.name} has {rate:.3g} decisions a second, and most flights {median:.3g}: the "
                "memory of the Delta Action network is updated at each decision; fit to flights of "
                "one rate"
            )
    return median


def are_consecutive(gaps_s: np.ndarray, period_s: float, row_s: float) -> np.ndarray:
    """Return (T,) bool: whether no decision was lost between two recorded ones.

    Args:
        gaps_s: (T,) times between recorded decisions [s].
        period_s: usual time between decisions [s].
        row_s: time between rows; a decision may be marked this much late [s].
    """
    return gaps_s < 1.5 * period_s + row_s


def _flight_windows(log: FlightLog, duration_s: float, stride_s: float) -> list[PointMassWindows]:
    action, decides = log_decisions(log)
    # Rows with a decision, and with a next row for the acceleration.
    rows = np.flatnonzero(decides)
    rows = rows[rows + 1 < len(log.time_s)]
    decision_s, rot_w = log.time_s[rows], quat_to_rot(log.quat_wxyz[rows])
    time_to_next = (log.time_s[rows + 1] - decision_s)[:, None]
    acc_w = (log.vel_w[rows + 1] - log.vel_w[rows]) / time_to_next
    command_w = (rot_w @ action[rows][:, :, None])[:, :, 0]
    heading_w = _heading(rot_w)
    row_s = float(np.median(np.diff(log.time_s)))
    period_s = decision_period(decision_s, row_s)
    if np.isnan(period_s):
        return []
    steps, stride = round(duration_s / period_s), max(1, round(stride_s / period_s))
    burn_in_count = round(BURN_IN_S / period_s)
    windows = []
    for first in range(HISTORY, len(rows) - steps, stride):
        span = slice(first, first + steps + 1)
        gaps_s = np.diff(decision_s[first - HISTORY : first + steps + 1])
        # A window with a lost decision, also in its history, is left out.
        if (
            not are_consecutive(gaps_s, period_s, row_s).all()
            or not np.isfinite(acc_w[first]).all()
        ):
            continue
        windows.append(
            PointMassWindows(
                log.pos_w[rows[span]],
                log.vel_w[rows[span]],
                acc_w[first],
                rot_w[first],
                heading_w[span],
                action[rows[span]][:-1],
                command_w[first - HISTORY : first][::-1],
                np.diff(decision_s[span]),
                burn_in_before(rot_w, log.vel_w[rows], action[rows], first, burn_in_count),
            )
        )
    return windows


BURN_IN_S = 3.0
"""Longest burn-in before a window [s]."""


class BurnIn(NamedTuple):
    """The network's inputs at the W decisions before each of N windows."""

    inputs: Array
    """(N, W, 9) velocity in body axes [m/s], world z in body axes, action [m/s^2]; the oldest
    decision is the first."""
    seen: Array
    """(N, W) 1 where the network gets the inputs; 0 before the flight's start, and in a window that
    starts without memory."""


def burn_in_before(
    rot_w: np.ndarray, vel_w: np.ndarray, action_b: np.ndarray, first: int, count: int
) -> BurnIn:
    """Return the burn-in of one window: `inputs` (W, 9) and `seen` (W,).

    Args:
        rot_w: (T, 3, 3) measured attitude at all decisions of the flight.
        vel_w: (T, 3) measured velocity at them [m/s].
        action_b: (T, 3) the policy's actions [m/s^2].
        first: index of the decision at which the window starts.
        count: number W of decisions before it; those before the flight's start have zeros.
    """
    inputs, seen = np.zeros((count, 9)), np.zeros(count)
    start = max(0, first - count)
    rows = slice(start, first)
    if first > start:
        columns = [to_local(rot_w[rows], vel_w[rows]), rot_w[rows, 2], action_b[rows]]
        inputs[count - (first - start) :] = np.concatenate(columns, axis=-1)
        seen[count - (first - start) :] = 1.0
    return BurnIn(inputs, seen)


def without_memory(burn_in: BurnIn, share: float) -> BurnIn:
    """Return the burn-ins, with those of the first `share` (0 to 1) of the windows removed."""
    count = len(burn_in.seen)
    has_memory = (jnp.arange(count) >= round(share * count))[:, None]
    return burn_in._replace(seen=jnp.where(has_memory, jnp.asarray(burn_in.seen), 0.0))


def state_after(params: delta_network.Params | None, burn_in: BurnIn) -> jax.Array:
    """Return the network's recurrent state (N, 32) after a burn-in; zero without a network."""
    zero = delta_network.start(len(burn_in.seen))
    if params is None:
        return zero
    inputs, seen = (jnp.swapaxes(jnp.asarray(array), 0, 1) for array in burn_in)

    def step(hidden: jax.Array, decision: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        values, in_flight = decision
        after = delta_network.step(params, hidden, values[:, :3], values[:, 3:6], values[:, 6:])[1]
        return jnp.where(in_flight[:, None] > 0, after, hidden), None

    return jax.lax.scan(step, zero, (inputs, seen))[0]
