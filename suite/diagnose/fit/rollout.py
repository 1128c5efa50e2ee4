"""Windows flown through the model, and how that differs from what was measured in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.quadrotor.delay import delayed_series
from eval.quadrotor.plant import Motion, Plant, unpacked
from eval.quadrotor.stepper import Feedback, Inputs, PlantState, rollout, rotor_step, wanted_speed
from suite.diagnose.data.windows import CHANNELS, HISTORY_S, WARM_S, Windows
from tracks.geometry.rotation import exp_rot

STATE = 12
"""Numbers of the state in which a window starts: pos_w, rotation vector, vel_w, rate_b."""
KNOTS = 11
"""Places in a window between which what is free along it runs straight."""


class Flown(NamedTuple):
    """B windows at their S + 1 ends of steps."""

    track: Motion
    """(B, S + 1, ...)."""
    rotor_speed: Any
    """(B, S + 1, 4) [rad/s]."""
    force_b: Any
    """(B, S + 1, 3) specific force in the step before [m/s^2]."""


def fly_windows(
    plant: Plant,
    values: Mapping[str, Any],
    driven_by_rotors: bool,
    voltage: bool,
    offset: Any,
    windows: Windows,
    push: Any = None,
    feedback: Feedback | None = None,
) -> Flown:
    """Fly B windows from their measured starts.

    Args:
        plant: with the effects `values`, for steps of the windows.
        values: of all effects; the log's own faults are read from them.
        driven_by_rotors: measured rotor speeds are the input, not the commands.
        voltage: the windows have a voltage.
        offset: (B, F) of the start and of the rotor speeds' errors from what was measured.
        windows: B of them.
        push: (B, KNOTS, 6) what pushes, as `Inputs.push_b` has it; none if not given.
        feedback: what pushes in place of `push`.
    """
    dt = float(plant.dt)
    gyro = values["gyro_bias"].bias
    before, warm = round(HISTORY_S / dt) + 1, round(WARM_S / dt)
    steps = windows.command.shape[1] - before - warm
    command = delayed_series(jnp.asarray(windows.command), plant.constants.delay, dt, before)
    motion = Motion(
        windows.pos_w + offset[:, :3],
        jnp.matmul(windows.rot_w, exp_rot(offset[:, 3:6])),
        windows.vel_w + offset[:, 6:9],
        windows.rate_b - gyro + offset[:, 9:STATE],
    )
    order = jnp.swapaxes(command, 0, 1)
    warm_rate_b = jnp.swapaxes(jnp.asarray(windows.warm_rate_b), 0, 1)
    speed = wanted_speed(plant, unpacked(order[0]), warm_rate_b[0] - gyro)

    def warm_up(state: PlantState, inputs: Any) -> tuple[PlantState, None]:
        order, rate_b = inputs
        return rotor_step(plant, state, unpacked(order), rate_b - gyro)[0], None

    # The commands are late already: a plant for whole flights need not remember them.
    start = PlantState(speed, jnp.zeros((len(speed), 4, 0)), {})
    start, _ = jax.lax.scan(warm_up, start, (order[:warm], warm_rate_b))

    measured = None
    if driven_by_rotors:
        error = offset[:, STATE:].reshape(-1, KNOTS, 4)
        measured = jnp.asarray(windows.rotor_speed) - jnp.matmul(_hats(steps), error)
        measured = jnp.swapaxes(measured, 0, 1)
    inputs = Inputs(
        unpacked(order[warm:]),
        measured,
        voltage_drop=jnp.swapaxes(jnp.asarray(windows.voltage_drop), 0, 1) if voltage else None,
        push_b=None if push is None else jnp.swapaxes(jnp.matmul(_hats(steps), push), 0, 1),
    )
    flown = rollout(plant, motion, inputs, start, windows.start_s, feedback)
    force_b = jnp.concatenate([flown.acc_b[:1], flown.acc_b])
    along = (flown.motion, flown.rotor_speed, force_b)
    return Flown(*jax.tree.map(lambda field: jnp.moveaxis(field, 0, 1), along))


def difference(plant: Plant, values: Mapping[str, Any], flown: Flown, windows: Windows) -> Any:
    """Return simulated - measured (B, N, 19) of `flown`, zero where nothing was measured."""
    dt, (track, speeds, forces) = float(plant.dt), flown
    steps = speeds.shape[1] - 1
    gyro, accelerometer = values["gyro_bias"].bias, values["accelerometer_bias"].bias
    pose = _at(windows.row_s - values["clock_offset"].offset, dt, steps)
    now = _at(windows.row_s, dt, steps)
    pos_w, rot_w, vel_w = _pose(track, pose, dt)
    rate_b = _pick(track.rate_b, now, dt)
    turn = jnp.matmul(jnp.swapaxes(windows.row_rot_w, -1, -2), rot_w)
    attitude = 0.5 * jnp.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )
    parts = [
        pos_w - windows.row_pos_w,
        attitude,
        vel_w - windows.row_vel_w,
        rate_b + gyro - windows.row_rate_b,
        _pick(forces, now, dt) + accelerometer - windows.row_acc_b,
        _pick(speeds, now, dt) - windows.row_rotor_speed,
    ]
    apart = jnp.concatenate(parts, axis=-1)
    assert apart.shape[-1] == CHANNELS
    return jnp.where(windows.seen, apart, 0.0)


def _hats(steps: int) -> np.ndarray:
    """Return the share (S, KNOTS) of each knot in each step, linear between knots."""
    place = (np.arange(steps) + 0.5) / steps * (KNOTS - 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(KNOTS)))


def _at(time_s: Any, dt: float, steps: int) -> Any:
    """Return (step before, time after it [s]) for times since the window's start."""
    index = jnp.clip(jnp.floor(time_s / dt + 1e-6), 0, steps).astype(int)
    return index, time_s - index * dt


def _pick(series: Any, place: Any, dt: float) -> Any:
    """Return `series` (B, S + 1, K) at `place`, linear between steps."""
    index, left = place
    following = jnp.minimum(index + 1, series.shape[1] - 1)
    here = jnp.take_along_axis(series, index[..., None], axis=1)
    there = jnp.take_along_axis(series, following[..., None], axis=1)
    return here + (left / dt)[..., None] * (there - here)


def _pose(track: Motion, place: Any, dt: float) -> tuple[Any, Any, Any]:
    """Return position, attitude and velocity at `place`; times before the start extend back."""
    index, left = place
    left = left[..., None]
    following = jnp.minimum(index + 1, track.pos_w.shape[1] - 1)

    def pick(series: Any, at: Any) -> Any:
        return jnp.take_along_axis(series, at.reshape(*at.shape, *[1] * (series.ndim - 2)), axis=1)

    vel_w, rate_b = pick(track.vel_w, index), pick(track.rate_b, following)
    acc_w = (pick(track.vel_w, following) - vel_w) / dt
    # A step's new velocity carries the position (semi-implicit Euler).
    pos_w = pick(track.pos_w, index) + left * pick(track.vel_w, following)
    rot_w = jnp.matmul(pick(track.rot_w, index), exp_rot(left * rate_b))
    return pos_w, rot_w, vel_w + left * acc_w
