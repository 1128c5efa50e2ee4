"""Cuts flight logs into windows of 1 s, in which rollouts (simulated stretches) are compared.

A window starts at a row of the log. It holds the start state, the model's inputs on its time steps
(`data/steps.py`), and the measured rows, which are compared at their own times. In the burn-in, a
short time before, the rotors follow the commands, so that their speeds at the start are known.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from eval.effects.interface import GRAVITY, Sample
from eval.effects.log_faults import pose_delay
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.sampling import (
    interpolate,
    longest_gap_s,
    on_every_row,
    own_spacing_s,
    thinned,
    voltage_drop,
)
from suite.diagnose.data.steps import (
    LONGEST_S,
    StepGrid,
    padded_grid,
    rotors_at,
    start_rotor_error,
    step_grid,
    with_lost_rows,
)
from suite.diagnose.data.view import near_ground
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.rotation import quat_to_rot
from tracks.geometry.scene import Array

LENGTH_S = 1.0
"""Length of a window [s]."""
HISTORY_S = 0.1
"""Time before the burn-in from which commands are used, since they act with a delay [s]."""
BURN_IN_S = 0.2
"""Length of the burn-in, in which the rates are as measured [s]."""
STEPS = (512, 704)
"""Numbers of time steps to which windows are padded: for 1 s of 2 ms steps, and for short steps."""
BURN_IN_STEPS = (144,)
"""Numbers of time steps to which burn-ins are padded."""
COMMANDS = (192, 1536)
"""Numbers of commands to which windows are padded: for commands at 100 Hz, and at 1,000 Hz."""
ROWS = 101
"""Largest number of measured rows in a window; a log with more rows is thinned."""
STATE = 12
"""Size of the state at a window's start: pos_w 3, rotation vector 3, vel_w 3, rate_b 3."""
KNOTS = 11
"""Number of knots of a window. A fitted function of time is linear between two knots."""
CHANNELS = 19
"""Number of measured channels: pos_w 3, attitude 3, vel_w 3, rate_b 3, acc_b 3, rotor speeds 4."""
LEAST_ROWS = 12
"""Smallest number of rows of the log in a window."""
RETRY_S = 0.1
"""If no window can start at a row, a start this much later is tried [s]."""
STATE_GROUPS = ("position", "attitude", "velocity", "rates")
"""Groups of the channels of the state, three channels each, in their order."""
SLICES = {
    "position": slice(0, 3),
    "attitude": slice(3, 6),
    "velocity": slice(6, 9),
    "rates": slice(9, 12),
    "accelerometer": slice(12, 15),
    "rotor speed": slice(15, 19),
}
UNITS = {
    "position": "m", "attitude": "rad", "velocity": "m/s", "rates": "rad/s",
    "accelerometer": "m/s^2", "rotor speed": "rad/s",
}  # fmt: skip


class FlightWindows(NamedTuple):
    """W windows of S time steps, after Q steps of burn-in, with N measured rows each.

    All times except `start_s` are relative to the start of the window.
    """

    flight: Array
    """(W,) number of the flight."""
    start_s: Array
    """(W,) start of the window, from the first row of the flight [s]."""
    edge_s: Array
    """(W, Q + S + 1) ends of the steps; edge Q is the start of the window [s]."""
    sample_s: Array
    """(W, Q + S) time until the rate loop's next sample [s], see `StepGrid`."""
    lead_s: Array
    """(W, Q + S) mean delay of the vehicle's samples [s], see `StepGrid`."""
    command_s: Array
    """(W, K) times from which commands act, before any delay [s]."""
    command: Array
    """(W, K, 4) commanded thrust over mass [m/s^2] and body rates [rad/s]."""
    command_sum: Array
    """(W, K, 4) integral of the commands over time, from the first command to each one."""
    burn_in_rate_b: Array
    """(W, Q, 3) measured body rates at the samples of the rate loop in the burn-in [rad/s]."""
    rotor_speed: Array
    """(W, S, 4) measured rotor speeds in the middle of each step [rad/s]; zeros without any."""
    voltage_drop: Array
    """(W, S) fall of the battery voltage since the log's start [V]; zeros without a voltage."""
    start: Motion
    """(W, ...) measured state at the start."""
    row_s: Array
    """(W, N) times of the measured rows [s]."""
    row: Sample
    """(W, N, ...) measured signals; like the rotor speeds, 0 where nothing was measured."""
    row_rotor_speed: Array
    """(W, N, 4) measured rotor speeds [rad/s]."""
    valid: Array
    """(W, N, 19) bool, whether a channel has a measured value that is compared."""
    rotor_valid: Array
    """(W, N, 4) bool, whether a rotor speed was measured, for comparison or as the input."""
    start_rotor_error: Array
    """(W,) error of the rotor speeds after the burn-in [rad/s]; 0 if they are the input."""
    input_error: Array | None = None
    """(W, N, 19, E) change of the simulated values by E independent errors of the commands, of one
    standard deviation each; None if the commands are known."""


def cut(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    rotor_input: bool,
    stride_s: float = LENGTH_S,
    limits: Thresholds = THRESHOLDS,
    integrator: str = "continuous",
    only: Collection[int] | None = None,
    since_s: float = 0.0,
    like: FlightWindows | None = None,
    stride: int = 1,
    between: bool = False,
    jitter: bool = False,
) -> tuple[FlightWindows | None, list[str]]:
    """Return the windows of `logs` (None if no flight has one) and warnings.

    If there are more windows than `limits` allow, an even selection of them is used.

    Args:
        logs: F flights, numbered in their order.
        vehicle: the vehicle; its rotor lag and the frequency of its rate loop are used.
        rotor_input: whether measured rotor speeds are the input; then they are not compared.
        stride_s: time between the starts of two windows [s]; by default windows do not overlap.
        limits: longest hole in a window, and largest numbers of windows.
        integrator: integrator of the model; with "euler" its steps are those that the log states,
            or else the rate loop's periods.
        only: numbers of the flights that are cut; all if not given.
        since_s: earliest start of a window after its log's start [s].
        like: windows of an earlier call, to whose size these are padded.
        stride: factor on the length of the steps, but of Euler's; only every `stride`-th rotor
            speed is used.
        between: half-way from one command to the next, their mean acts as another command.
        jitter: the time of each command is shifted by chance, by the logs' `command_jitter_s`.
    """
    starts, warnings = list[tuple[int, int]](), list[str]()  # (flight, row) each
    states = [on_every_row(log, limits) for log in logs]
    spacings_s = dict[int, float]()
    for number in range(len(logs)) if only is None else only:
        log, state = logs[number], states[number]
        rotors = state.rotor_speed if rotor_input else None
        flown = ~near_ground(state, vehicle, rotors, limits, lasting=True)
        # Each input has rows of its own: a rotor speed, or the commands and the loop's rates.
        table = log.rotor_speed if rotor_input else log.command
        assert table is not None
        if rotor_input:
            spacings_s[number] = own_spacing_s(log.time_s, table)
        parts = [column[:, None] for column in table.T] if rotor_input else [table, log.rate_b]
        inputs = [*(np.isfinite(part).all(axis=1) for part in parts), flown]
        rows = _start_rows(log, state.whole & flown, inputs, since_s, stride_s, limits)
        if not rows:
            shortest_s = LENGTH_S + BURN_IN_S + HISTORY_S
            warnings.append(f"{log.name}: no stretch of {shortest_s:g} s in flight without a hole")
        starts += [(number, row) for row in rows]
    if not starts:
        return None, warnings
    most = min(limits.most_windows, limits.most_rotor_windows if rotor_input else len(starts))
    if len(starts) > most:
        warnings.append(f"{most} stretches of 1 s, evenly spread, are used of {len(starts)}")
        starts = [starts[k] for k in np.linspace(0, len(starts) - 1, most).astype(int)]
    steps_s = [LONGEST_S * stride] * len(logs)
    if integrator == "euler":
        steps_s = [log.step_s or 1.0 / vehicle.controller.frequency for log in logs]
    shifts_s = [command_jitter_s(log) if jitter else 0.0 for log in logs]
    inputs = [
        _input_of(logs[k], row, vehicle, steps_s[k], between, shifts_s[k]) for k, row in starts
    ]
    sizes = _padded_sizes(inputs, like)
    windows = [
        _window(logs[k], states[k], k, row, vehicle, spacings_s.get(k), one, stride, sizes)
        for (k, row), one in zip(starts, inputs, strict=True)
    ]
    return jax.tree.map(lambda *field: np.stack(field), *windows), warnings


def command_jitter_s(log: FlightLog) -> float:
    """Return the standard deviation of the times of commands that `log` states; 0 if none [s]."""
    stated = log.about.get("command_jitter_s")
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not stated > 0.0:
        return 0.0
    return float(stated)


def has_times_of_commands(log: FlightLog) -> bool:
    """Return whether `log` has every command at the time at which it was sent, as it states."""
    return "command_jitter_s" in log.about


def take(data: Any, chosen: Array) -> Any:
    """Return the `chosen` windows (indices, or (W,) bool) of a tree of arrays (W, ...) and None."""
    return jax.tree.map(lambda field: np.asarray(field)[chosen], data)


def _start_rows(
    log: FlightLog,
    complete: np.ndarray,
    inputs: Sequence[np.ndarray],
    since_s: float,
    stride_s: float,
    limits: Thresholds,
) -> list[int]:
    """Return the `complete` rows at which windows without a hole in rows or `inputs` start."""
    time_s = log.time_s
    inputs_s = [time_s[rows] for rows in inputs]
    next_s, starts = time_s[0] + max(BURN_IN_S + HISTORY_S, since_s), []
    while True:
        candidates = np.flatnonzero((time_s >= next_s - 1e-9) & complete)
        if not len(candidates) or time_s[candidates[0]] + LENGTH_S > time_s[-1] + 1e-6:
            return starts
        row = int(candidates[0])
        begin_s, end_s = time_s[row], time_s[row] + LENGTH_S
        inside_s = time_s[(time_s >= begin_s - 1e-9) & (time_s <= end_s + 1e-9)]
        # Inputs are used before the start, too: by the burn-in, and by a delay.
        input_begin_s = begin_s - BURN_IN_S - HISTORY_S
        longest_s = max(
            longest_gap_s(inside_s, begin_s, end_s),
            *(longest_gap_s(rows_s, input_begin_s, end_s) for rows_s in inputs_s),
        )
        if len(inside_s) < LEAST_ROWS or longest_s > limits.longest_hole_s:
            next_s = begin_s + RETRY_S
        else:
            starts.append(row)
            next_s = begin_s + stride_s


class _Input(NamedTuple):
    """Rows of the log, and steps and commands as in `FlightWindows`, of one window."""

    rows: np.ndarray
    burn_in: StepGrid
    window: StepGrid
    command_s: np.ndarray
    command: np.ndarray


def _input_of(
    log: FlightLog, row: int, vehicle: Vehicle, longest_s: float, between: bool, shift_s: float
) -> _Input:
    """Return the inputs of the window at `row`; without commands those of a hover. See `cut`.

    The times of commands are shifted by the standard deviation `shift_s` [s].
    """
    time_s, begin_s, period_s = log.time_s, log.time_s[row], 1.0 / vehicle.controller.frequency
    rows = np.flatnonzero((time_s >= begin_s - 1e-9) & (time_s <= begin_s + LENGTH_S + 1e-9))
    signals = (log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b, log.acc_b, log.rotor_speed)
    logged = [signal[rows] for signal in signals if signal is not None]
    valid = np.stack([np.isfinite(values).all(axis=1) for values in logged], axis=1)
    rows = rows[thinned(valid, time_s[rows], ROWS)]
    length_s = time_s[rows[-1]] - begin_s
    command = np.tile([GRAVITY, 0.0, 0.0, 0.0], (len(time_s), 1))
    given = log.command
    if given is not None and (finite := np.isfinite(given).all(axis=1)).any():
        time_s, command = time_s[finite], given[finite]
    first_s, last_s = begin_s - BURN_IN_S - HISTORY_S - 1e-9, begin_s + length_s + 1e-9
    used = slice(max(np.searchsorted(time_s, first_s) - 1, 0), np.searchsorted(time_s, last_s) + 1)
    time_s, command = time_s[used] - begin_s, command[used]
    if not has_times_of_commands(log):
        time_s, command = with_lost_rows(time_s, command)
    if between:
        time_s, command = (np.repeat(values, 2, axis=0)[:-1] for values in (time_s, command))
        time_s[1::2] += 0.5 * np.diff(time_s[::2])
        command[1::2] += 0.5 * np.diff(command[::2], axis=0)
    if shift_s:
        shift = np.random.default_rng(row).standard_normal(len(time_s))
        time_s = np.sort(time_s + shift_s * shift)

    def grid(since_s: float, until_s: float) -> StepGrid:
        inside_s = time_s[(time_s > since_s + 1e-6) & (time_s < until_s - 1e-6)]
        return step_grid(np.array([since_s, *inside_s, until_s]), period_s, longest_s)

    return _Input(rows, grid(-BURN_IN_S, 0.0), grid(0.0, length_s), time_s, command)


def _padded_sizes(inputs: Sequence[_Input], like: FlightWindows | None) -> tuple[int, ...]:
    """Return the numbers of steps of burn-in and window, and of commands, after padding.

    They are those of `like`, or else some of few, since each makes the model compile again.
    """
    if like is not None:
        return like.burn_in_rate_b.shape[1], like.rotor_speed.shape[1], like.command_s.shape[1]
    lengths = [
        (len(one.burn_in.sample_s), len(one.window.sample_s), len(one.command_s)) for one in inputs
    ]
    counts, allowed = map(max, zip(*lengths, strict=True)), (BURN_IN_STEPS, STEPS, COMMANDS)
    return tuple(
        next((size for size in sizes if size >= count), -(-count // sizes[0]) * sizes[0])
        for count, sizes in zip(counts, allowed, strict=True)
    )


def _window(
    log: FlightLog,
    state: FlightLog,
    number: int,
    row: int,
    vehicle: Vehicle,
    rotor_spacing_s: float | None,
    inputs: _Input,
    stride: int,
    sizes: Sequence[int],
) -> FlightWindows:
    """Return the window (without the axis W) at `row` of `log`, whose `state` is in every row.

    Its inputs are padded to `sizes` (see `_padded_sizes`). If measured rotor speeds are the input,
    they are `rotor_spacing_s` [s] apart, and every `stride`-th is used; else it is None.
    """
    time_s, begin_s = log.time_s, log.time_s[row]
    rows, burn_in_steps, steps, commands = inputs.rows, *sizes
    before = padded_grid(inputs.burn_in, burn_in_steps, at_front=True)
    window = padded_grid(inputs.window, steps)
    sample_s = begin_s + before.edge_s[:-1] + before.lead_s
    middle_s = begin_s + 0.5 * (window.edge_s[:-1] + window.edge_s[1:])
    speed = np.zeros((len(middle_s), 4))
    if log.rotor_speed is not None and rotor_spacing_s is not None:
        speed = rotors_at(middle_s, time_s, log.rotor_speed, vehicle, rotor_spacing_s, stride)
    none = np.full((len(time_s), 4), np.nan)
    acc_b = none[:, :3] if log.acc_b is None else log.acc_b
    rotors = none if log.rotor_speed is None else log.rotor_speed
    vel_w = np.full_like(log.vel_w, np.nan) if log.velocity_derived else log.vel_w
    rot_w = quat_to_rot(log.quat_wxyz[rows])
    measured = [log.pos_w[rows], rot_w, vel_w[rows], log.rate_b[rows], acc_b[rows], rotors[rows]]
    has_attitude = np.isfinite(rot_w.reshape(len(rows), 9).sum(axis=1, keepdims=True))
    valid = [
        np.repeat(has_attitude, 3, axis=1) if values.ndim == 3 else np.isfinite(values)
        for values in measured
    ]
    rotor_valid = valid[5]
    if rotor_spacing_s is not None:
        valid[5] = np.zeros_like(rotor_valid)  # the model's input is not compared
    # Not simulated: the time before the start and after the end, of the accelerometer's first row
    # and of late or early poses.
    valid[4][0] = False
    pose_s = time_s[rows] - begin_s - pose_delay(vehicle.effects)
    for pose in valid[:3]:
        pose[(pose_s < -1e-9) | (pose_s > window.edge_s[-1] + 1e-9)] = False

    def padded(values: np.ndarray) -> np.ndarray:
        padding = np.zeros((ROWS - len(rows), *values.shape[1:]), values.dtype)
        return np.concatenate([np.nan_to_num(values), padding])

    added = np.diff(inputs.command_s)[:, None] * inputs.command[:-1]
    command_sum = np.concatenate([np.zeros((1, 4)), np.cumsum(added, axis=0)])
    later = (0, commands - len(added) - 1)
    rotor_error = 0.0
    if rotor_spacing_s is None:
        burn_in = (time_s > begin_s - BURN_IN_S - 1e-9) & (time_s <= begin_s + 1e-9)
        burn_in &= np.isfinite(log.rate_b).all(axis=1)  # not where rates are interpolated
        rotor_error = start_rotor_error(time_s[burn_in], log.rate_b[burn_in], vehicle)
    return FlightWindows(
        np.asarray(number),
        np.asarray(begin_s - time_s[0]),
        np.concatenate([before.edge_s[:-1], window.edge_s]),
        np.concatenate([before.sample_s, window.sample_s]),
        np.concatenate([before.lead_s, window.lead_s]),
        np.pad(inputs.command_s, later, constant_values=np.inf),
        np.pad(inputs.command, (later, (0, 0))),
        np.pad(command_sum, (later, (0, 0)), mode="edge"),
        interpolate(sample_s, time_s, log.rate_b),
        speed,
        voltage_drop(log, middle_s),
        Motion(
            state.pos_w[row], quat_to_rot(state.quat_wxyz[row]), state.vel_w[row], state.rate_b[row]
        ),
        padded(time_s[rows] - begin_s),
        Sample(*(padded(values) for values in measured[:5])),
        padded(measured[5]),
        valid=padded(np.concatenate(valid, axis=1)),
        rotor_valid=padded(rotor_valid),
        start_rotor_error=np.asarray(rotor_error),
    )
