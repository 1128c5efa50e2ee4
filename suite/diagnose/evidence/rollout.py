"""FlightWindows flown through the model, and how that differs from what was measured in them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from eval.effects.interface import Sample
from eval.effects.log_faults import pose_delay, to_logged, to_true
from eval.quadrotor.continuous import Carry, Steps, fly, turn_rotors, update_loop
from eval.quadrotor.plant import Motion, Plant, Wrench, unpack_command
from eval.quadrotor.stepper import Feedback, Inputs, wanted_speed
from suite.diagnose.data.sampling import LONGEST_S
from suite.diagnose.data.windows import CHANNELS, KNOTS, LENGTH_S, STATE, FlightWindows
from tracks.geometry.rotation import exp_rot


class Flown(NamedTuple):
    """B windows at their S + 1 ends of steps."""

    track: Motion
    """(B, S + 1, ...)."""
    rotor_speed: Any
    """(B, S + 1, 4) [rad/s]."""
    force_b: Any
    """(B, S + 1, 3) specific force as a step ends, before what acts next does [m/s^2]."""


def fly_windows(
    plant: Plant,
    values: Mapping[str, Any],
    rotor_input: bool,
    voltage: bool,
    integrator: str,
    offset: Any,
    windows: FlightWindows,
    push: Any = None,
    feedback: Feedback | None = None,
) -> Flown:
    """Fly B windows from their measured starts.

    Args:
        plant: with the effects `values`.
        values: of all effects; the log's own faults are read from them.
        rotor_input: measured rotor speeds are the input, not the commands.
        voltage: the windows have a voltage.
        integrator: one of `eval.quadrotor.continuous.INTEGRATORS`.
        offset: (B, F) of the start from what was measured and, last, of the rotor speeds: of their
            errors at the knots where they are the input, else at the start from the burn-in's.
        windows: B of them.
        push: (B, KNOTS, 6) what pushes, as `Inputs.push_b` has it; none if not given.
        feedback: what pushes in place of `push`.
    """
    burn_in = windows.burn_in_rate_b.shape[1]
    edge_s, sample_s = jnp.asarray(windows.edge_s), jnp.asarray(windows.sample_s)
    spans = Steps(jnp.diff(edge_s), sample_s > 0.0, jnp.asarray(windows.lead_s))
    spans, command = jax.tree.map(
        lambda field: jnp.swapaxes(field, 0, 1), (spans, _acting(windows, plant.constants.delay))
    )
    start = to_true(values, _sample(windows.rate_b, windows.pos_w, windows.rot_w, windows.vel_w))
    motion = Motion(
        start.pos_w + offset[:, :3],
        jnp.matmul(start.rot_w, exp_rot(offset[:, 3:6])),
        start.vel_w + offset[:, 6:9],
        start.rate_b + offset[:, 9:STATE],
    )
    middle_s = 0.5 * (edge_s[:, burn_in:-1] + edge_s[:, burn_in + 1 :])
    rotor_speed = None
    if rotor_input:
        error = offset[:, STATE:].reshape(-1, KNOTS, 4)
        rotor_speed = jnp.asarray(windows.rotor_speed) - jnp.matmul(_hats(middle_s), error)
        rotor_speed = jnp.swapaxes(rotor_speed, 0, 1)
        begin_speed = rotor_speed[0]
    else:
        before = jax.tree.map(lambda field: field[:burn_in], spans)
        begin_speed = _burned_in(plant, values, before, command[:burn_in], windows)
        begin_speed = begin_speed + offset[:, STATE:]
    inputs = Inputs(
        unpack_command(command[burn_in:]),
        rotor_speed,
        voltage_drop=jnp.swapaxes(jnp.asarray(windows.voltage_drop), 0, 1) if voltage else None,
        push_b=None if push is None else jnp.swapaxes(jnp.matmul(_hats(middle_s), push), 0, 1),
    )
    spans = jax.tree.map(lambda field: field[burn_in:], spans)
    begin_s = jnp.asarray(windows.start_s)
    flown = fly(plant, motion, spans, inputs, begin_speed, begin_s, integrator, feedback)
    force_b = jnp.concatenate([flown.acc_b[:1], flown.acc_b])
    along = (flown.motion, flown.rotor_speed, force_b)
    return Flown(*jax.tree.map(lambda field: jnp.moveaxis(field, 0, 1), along))


def difference(
    values: Mapping[str, Any], integrator: str, flown: Flown, windows: FlightWindows
) -> Any:
    """Return simulated - measured (B, N, 19) of `flown`, zero where nothing was measured.

    `values` and `integrator` are those of `fly_windows`.
    """
    track, speeds, forces = flown
    edge_s = jnp.asarray(windows.edge_s)[:, windows.burn_in_rate_b.shape[1] :]
    pose = _at(windows.row_s - pose_delay(values), edge_s)
    now = _at(jnp.asarray(windows.row_s), edge_s)
    rate_b, force_b = _pick(track.rate_b, now), _pick(forces, now)
    seen = to_logged(values, Sample(*_pose(track, pose, integrator), rate_b, force_b))
    turn = jnp.matmul(jnp.swapaxes(windows.row_rot_w, -1, -2), seen.rot_w)
    attitude = 0.5 * jnp.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )
    parts = [
        seen.pos_w - windows.row_pos_w,
        attitude,
        seen.vel_w - windows.row_vel_w,
        seen.rate_b - windows.row_rate_b,
        seen.acc_b - windows.row_acc_b,
        _pick(speeds, now) - windows.row_rotor_speed,
    ]
    apart = jnp.concatenate(parts, axis=-1)
    assert apart.shape[-1] == CHANNELS
    return jnp.where(windows.seen, apart, 0.0)


def at_knots(flown: Flown, windows: FlightWindows) -> Flown:
    """Return `flown` at the ends of steps nearest to the knots, (B, KNOTS, ...)."""
    edge_s = jnp.asarray(windows.edge_s)[:, windows.burn_in_rate_b.shape[1] :]
    knot_s = jnp.linspace(0.0, LENGTH_S, KNOTS)
    ends = jnp.abs(edge_s[:, None] - knot_s[:, None]).argmin(axis=-1)
    rows = jnp.arange(len(ends))[:, None]
    return jax.tree.map(lambda field: field[rows, ends], flown)


def _burned_in(
    plant: Plant, values: Mapping[str, Any], spans: Steps, command: Any, windows: FlightWindows
) -> Any:
    """Return the rotor speeds (B, 4) at the starts, by what was commanded (Q, B, 4) before them.

    The loop must be one that remembers nothing.
    """
    # Before the start only rates are known.
    rates_b = to_true(values, _sample(jnp.swapaxes(windows.burn_in_rate_b, 0, 1))).rate_b
    speed = wanted_speed(plant, unpack_command(command[0]), rates_b[0])

    def burn_in_step(carry: Carry, row: Any) -> tuple[Carry, None]:
        span, acting, rate_b = row
        carry = update_loop(plant, carry, span, unpack_command(acting), rate_b)
        return turn_rotors(plant, carry, span)[0], None

    # The rates where the loop samples are known here: none has to be carried on.
    still = jnp.zeros_like(rates_b[0])
    carry = Carry(speed, speed, still, Wrench(still, still))
    carry, _ = jax.lax.scan(burn_in_step, carry, (spans, command, rates_b))
    return carry.rotor_speed


def _sample(rate_b: Any, pos_w: Any = None, rot_w: Any = None, vel_w: Any = None) -> Sample:
    """Return a sample (..., 3) without an accelerometer, and at rest where no pose is given."""
    rate_b = jnp.asarray(rate_b)
    still = jnp.zeros_like(rate_b)
    if pos_w is None:
        pos_w, rot_w, vel_w = still, jnp.broadcast_to(jnp.eye(3), (*still.shape, 3)), still
    return Sample(pos_w, rot_w, vel_w, rate_b, still)


def _acting(windows: FlightWindows, delay: Any) -> Any:
    """Return the commands (B, Q + S, 4) that act between samples of the loop, as means.

    They act `delay` (...,) [s] after their rows, within steps too.
    """
    since_s = jnp.asarray(windows.edge_s)[:, :-1] - delay
    # Where the loop takes no sample any command will do, but for the first: rotors begin with it.
    sample_s = jnp.asarray(windows.sample_s)
    held = jnp.where(sample_s > 0.0, sample_s, LONGEST_S)

    def integral(at_s: Any, time_s: Any, command: Any, total: Any) -> Any:
        # At a row's own time the command before it: a delay can only grow from none.
        row = jnp.maximum(jnp.searchsorted(time_s, at_s - 1e-9, side="right") - 1, 0)
        return total[row] + (at_s - time_s[row])[:, None] * command[row]

    series = [jnp.asarray(x) for x in (windows.command_s, windows.command, windows.command_sum)]
    whole = jax.vmap(integral)
    return (whole(since_s + held, *series) - whole(since_s, *series)) / held[..., None]


def _hats(time_s: Any) -> Any:
    """Return the share (B, S, KNOTS) of each knot at times (B, S) [s], linear between knots."""
    place = time_s / LENGTH_S * (KNOTS - 1)
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[..., None] - jnp.arange(KNOTS)))


def _at(time_s: Any, edge_s: Any) -> Any:
    """Return (step before, time after it, length of the step) for times (B, N), edges (B, S + 1).

    Times and lengths are (B, N) [s].
    """
    ends = edge_s.shape[1] - 1
    index = jax.vmap(partial(jnp.searchsorted, side="right"))(edge_s, time_s + 1e-9) - 1
    index = jnp.clip(index, 0, ends - 1)
    begin_s = jnp.take_along_axis(edge_s, index, axis=1)
    length = jnp.take_along_axis(edge_s, index + 1, axis=1) - begin_s
    return index, time_s - begin_s, jnp.maximum(length, 1e-9)


def _pick(series: Any, place: Any) -> Any:
    """Return `series` (B, S + 1, K) at `place`, linear between ends of steps."""
    index, left, length = place
    here = jnp.take_along_axis(series, index[..., None], axis=1)
    there = jnp.take_along_axis(series, index[..., None] + 1, axis=1)
    return here + (left / length)[..., None] * (there - here)


def _pose(track: Motion, place: Any, integrator: str) -> tuple[Any, Any, Any]:
    """Return position, attitude and velocity at `place`; times before the start extend back."""
    index, left, length = place
    left, length = left[..., None], length[..., None]

    def pick(series: Any, at: Any) -> Any:
        return jnp.take_along_axis(series, at.reshape(*at.shape, *[1] * (series.ndim - 2)), axis=1)

    vel_w, new_vel_w = pick(track.vel_w, index), pick(track.vel_w, index + 1)
    rate_b, new_rate_b = pick(track.rate_b, index), pick(track.rate_b, index + 1)
    gained_w = left / length * (new_vel_w - vel_w)
    if integrator == "euler":  # a step's new velocity carries the position
        pos_w, turn = pick(track.pos_w, index) + left * new_vel_w, left * new_rate_b
    else:
        pos_w = pick(track.pos_w, index) + left * (vel_w + 0.5 * gained_w)
        turn = left * (rate_b + 0.5 * left / length * (new_rate_b - rate_b))
    return pos_w, jnp.matmul(pick(track.rot_w, index), exp_rot(turn)), vel_w + gained_w
