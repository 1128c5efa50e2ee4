"""Simulates windows (1 s stretches of flights) with the model, and compares them with the logs.

Each window starts from its measured state. Its inputs are the logged commands, which pass through
the rate loop, or the measured rotor speeds. All functions are JAX and take many windows at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from eval.effects.interface import Sample
from eval.effects.log_faults import pose_delay, to_logged, to_true
from eval.quadrotor.continuous import Carry, Flight, Steps, fly, turn_rotors, update_loop
from eval.quadrotor.plant import Motion, Plant, Wrench, unpack_command
from eval.quadrotor.stepper import Inputs, wanted_speed
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.data.windows import CHANNELS, KNOTS, LENGTH_S, STATE, FlightWindows
from tracks.geometry.rotation import exp_rot


def fly_windows(
    plant: Plant,
    values: Mapping[str, Any],
    rotor_input: bool,
    voltage: bool,
    integrator: str,
    offset: Any,
    windows: FlightWindows,
    push: Any = None,
) -> Flight:
    """Simulate B windows from their measured start states.

    Returned are the states (B, S + 1, ...) at the S + 1 ends of their steps. The specific force at
    the start is that at the end of the first step.

    Args:
        plant: model of the vehicle (rotors, delays and rate loop), with the effects `values`.
        values: values of all effects by name; faults of the log are taken from them.
        rotor_input: whether measured rotor speeds are the input, not the commands.
        voltage: whether the windows have a battery voltage.
        integrator: one of `eval.quadrotor.continuous.INTEGRATORS`.
        offset: (B, F) corrections of the start numbers: 12 of the measured start state, then those
            of the rotor speeds, at the knots if these are the input, else at the start.
        windows: B windows.
        push: (B, K, 6) additional force and torque at K knots, see `Inputs.push_b`.
    """
    burn_in = windows.burn_in_rate_b.shape[1]
    edge_s, sample_s = jnp.asarray(windows.edge_s), jnp.asarray(windows.sample_s)
    spans = Steps(jnp.diff(edge_s), sample_s > 0.0, jnp.asarray(windows.lead_s))
    # Time becomes the first axis here and below, as the simulation scans along it.
    spans, command = jax.tree.map(
        lambda field: jnp.swapaxes(field, 0, 1),
        (spans, _acting_commands(windows, plant.constants.delay)),
    )
    start = to_true(values, Sample(*windows.start, jnp.zeros_like(windows.start.rate_b)))
    motion = Motion(
        start.pos_w + offset[:, :3],
        jnp.matmul(start.rot_w, exp_rot(offset[:, 3:6])),
        start.vel_w + offset[:, 6:9],
        start.rate_b + offset[:, 9:STATE],
    )
    # Rotor speeds: as measured, or those in which the burn-in ends.
    middle_s = 0.5 * (edge_s[:, burn_in:-1] + edge_s[:, burn_in + 1 :])
    rotor_speed = None
    if rotor_input:
        error = offset[:, STATE:].reshape(-1, KNOTS, 4)
        rotor_speed = jnp.asarray(windows.rotor_speed) - jnp.matmul(_hats(middle_s, KNOTS), error)
        rotor_speed = jnp.swapaxes(rotor_speed, 0, 1)
        begin_speed = rotor_speed[0]
    else:
        before = jax.tree.map(lambda field: field[:burn_in], spans)
        begin_speed = _speeds_after_burn_in(plant, values, before, command[:burn_in], windows)
        begin_speed = begin_speed + offset[:, STATE:]
    inputs = Inputs(
        unpack_command(command[burn_in:]),
        rotor_speed,
        voltage_drop=jnp.swapaxes(jnp.asarray(windows.voltage_drop), 0, 1) if voltage else None,
        push_b=None if push is None else _push_at(middle_s, push),
    )
    spans = jax.tree.map(lambda field: field[burn_in:], spans)
    begin_s = jnp.asarray(windows.start_s)
    flown = fly(plant, motion, spans, inputs, begin_speed, begin_s, integrator)
    flown = flown._replace(acc_b=jnp.concatenate([flown.acc_b[:1], flown.acc_b]))
    return jax.tree.map(lambda field: jnp.moveaxis(field, 0, 1), flown)


def difference(
    values: Mapping[str, Any], integrator: str, flown: Flight, windows: FlightWindows
) -> Any:
    """Return simulated - measured (B, N, 19), zero where nothing was measured.

    See `fly_windows`, of which `flown` is the result.
    """
    motion, speeds, forces_b = flown
    edge_s = jnp.asarray(windows.edge_s)[:, windows.burn_in_rate_b.shape[1] :]
    pose = _places(windows.row_s - pose_delay(values), edge_s)
    now = _places(jnp.asarray(windows.row_s), edge_s)
    rate_b, force_b = _interpolated(motion.rate_b, now), _interpolated(forces_b, now)
    logged = to_logged(values, Sample(*_pose(motion, pose, integrator), rate_b, force_b))
    # The attitude's error is the vector of the rotation between both attitudes, for small angles.
    row = windows.row
    rotation = jnp.matmul(jnp.swapaxes(row.rot_w, -1, -2), logged.rot_w)
    attitude = 0.5 * jnp.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    errors = [
        logged.pos_w - row.pos_w,
        attitude,
        logged.vel_w - row.vel_w,
        logged.rate_b - row.rate_b,
        logged.acc_b - row.acc_b,
        _interpolated(speeds, now) - windows.row_rotor_speed,
    ]
    error = jnp.concatenate(errors, axis=-1)
    assert error.shape[-1] == CHANNELS
    return jnp.where(windows.valid, error, 0.0)


def at_knots(flown: Flight, windows: FlightWindows) -> Flight:
    """Return the state `flown` at the knots (at the nearest ends of steps), (B, KNOTS, ...)."""
    edge_s = jnp.asarray(windows.edge_s)[:, windows.burn_in_rate_b.shape[1] :]
    knot_s = jnp.linspace(0.0, LENGTH_S, KNOTS)
    ends = jnp.abs(edge_s[:, None] - knot_s[:, None]).argmin(axis=-1)
    rows = jnp.arange(len(ends))[:, None]
    return jax.tree.map(lambda field: field[rows, ends], flown)


def _speeds_after_burn_in(
    plant: Plant, values: Mapping[str, Any], spans: Steps, command: Any, windows: FlightWindows
) -> Any:
    """Return the rotor speeds (B, 4) at the windows' starts, by a simulation of the burn-in.

    `command` (Q, B, 4) is that of its Q steps. The rate loop must not have integrators or filters.
    """
    # Of the motion in the burn-in only the rates are needed.
    rates_b = jnp.swapaxes(windows.burn_in_rate_b, 0, 1)
    zeros, level = jnp.zeros_like(rates_b), jnp.broadcast_to(jnp.eye(3), (*rates_b.shape, 3))
    rates_b = to_true(values, Sample(zeros, level, zeros, rates_b, zeros)).rate_b
    speed = wanted_speed(plant, unpack_command(command[0]), rates_b[0])

    def burn_in_step(carry: Carry, row: Any) -> tuple[Carry, None]:
        span, acting_command, rate_b = row
        carry = update_loop(plant, carry, span, unpack_command(acting_command), rate_b)
        return turn_rotors(plant, carry, span)[0], None

    # The rates where the loop samples are known here, so no acceleration has to predict them.
    zeros = jnp.zeros_like(rates_b[0])
    carry = Carry(speed, speed, zeros, Wrench(zeros, zeros))
    carry, _ = jax.lax.scan(burn_in_step, carry, (spans, command, rates_b))
    return carry.rotor_speed


def _acting_commands(windows: FlightWindows, delay: Any) -> Any:
    """Return the mean command (B, Q + S, 4) from each sample of the rate loop to the next.

    A command acts `delay` [s] after the time of its row, so it may change within a step.
    """
    since_s = jnp.asarray(windows.edge_s)[:, :-1] - delay
    # In a step without a sample the command is not used, except in the first: rotors start with it.
    sample_s = jnp.asarray(windows.sample_s)
    held_s = jnp.where(sample_s > 0.0, sample_s, LONGEST_S)

    def integral(at_s: Any, time_s: Any, command: Any, total: Any) -> Any:
        # At the time of a row, the command before that row is used, as a delay is never negative.
        row = jnp.maximum(jnp.searchsorted(time_s, at_s - 1e-9, side="right") - 1, 0)
        return total[row] + (at_s - time_s[row])[:, None] * command[row]

    series = [jnp.asarray(x) for x in (windows.command_s, windows.command, windows.command_sum)]
    integrals = jax.vmap(integral)
    until, since = integrals(since_s + held_s, *series), integrals(since_s, *series)
    return (until - since) / held_s[..., None]


def _push_at(time_s: Any, push: Any) -> Any:
    """Return the push (S, B, 6), linear between its K knots (B, K, 6), at `time_s` (B, S) [s]."""
    return jnp.swapaxes(jnp.matmul(_hats(time_s, push.shape[1]), push), 0, 1)


def _hats(time_s: Any, knots: int) -> Any:
    """Return the hat function (B, S, K) of each of K `knots` at `time_s` (B, S) [s]: 1 at it."""
    place = time_s / LENGTH_S * (knots - 1)
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[..., None] - jnp.arange(knots)))


def _places(time_s: Any, edge_s: Any) -> Any:
    """Return number, time since the start and length [s] of the step of each `time_s` (B, N)."""
    ends = edge_s.shape[1] - 1
    step = jax.vmap(partial(jnp.searchsorted, side="right"))(edge_s, time_s + 1e-9) - 1
    step = jnp.clip(step, 0, ends - 1)
    begin_s = jnp.take_along_axis(edge_s, step, axis=1)
    length = jnp.take_along_axis(edge_s, step + 1, axis=1) - begin_s
    return step, time_s - begin_s, jnp.maximum(length, 1e-9)


def _interpolated(series: Any, place: Any) -> Any:
    """Return `series` (B, S + 1, K) at `place` (see `_places`), linear between ends of steps."""
    step, since_s, length_s = place
    start = jnp.take_along_axis(series, step[..., None], axis=1)
    end = jnp.take_along_axis(series, step[..., None] + 1, axis=1)
    return start + (since_s / length_s)[..., None] * (end - start)


def _pose(track: Motion, place: Any, integrator: str) -> tuple[Any, Any, Any]:
    """Return position, attitude and velocity at `place`, see `_places`.

    They follow the integrator within a step, and are extrapolated before the start.
    """
    step, since_s, length_s = place
    since_s, length_s = since_s[..., None], length_s[..., None]

    def pick(series: Any, at: Any) -> Any:
        return jnp.take_along_axis(series, at.reshape(*at.shape, *[1] * (series.ndim - 2)), axis=1)

    vel_w, new_vel_w = pick(track.vel_w, step), pick(track.vel_w, step + 1)
    rate_b, new_rate_b = pick(track.rate_b, step), pick(track.rate_b, step + 1)
    gained_w = since_s / length_s * (new_vel_w - vel_w)
    if integrator == "euler":  # semi-implicit: the step's new velocity moves the position
        pos_w, turn = pick(track.pos_w, step) + since_s * new_vel_w, since_s * new_rate_b
    else:
        pos_w = pick(track.pos_w, step) + since_s * (vel_w + 0.5 * gained_w)
        turn = since_s * (rate_b + 0.5 * since_s / length_s * (new_rate_b - rate_b))
    return pos_w, jnp.matmul(pick(track.rot_w, step), exp_rot(turn)), vel_w + gained_w
