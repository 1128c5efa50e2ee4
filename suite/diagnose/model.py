"""What the model says of a window, and how that changes with every number of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.interface import Constants
from eval.plant import (
    Command,
    Memory,
    Motion,
    Nominal,
    Plant,
    assemble,
    nominal_quadrotor,
    spin_step,
    wanted_speed,
)
from eval.rigid_body import euler_step
from eval.rotors import follow, steady
from eval.vehicle import Vehicle
from suite.diagnose.parameters import Layout, Space, effects_at
from suite.diagnose.windows import CHANNELS, HISTORY_S, WARM_S, Windows, step_s
from tracks.rotation import exp_rot

STATE = 12
"""Numbers of the state in which a window starts: pos_w, rotation vector, vel_w, rate_b."""
KNOTS = 11
"""Places in a window between which errors of measured rotor speeds run straight."""
BATCH = 16
"""Windows a call: one shape, compiled once."""
FEW = 8
"""Directions of the cheaper call."""


class Linear(NamedTuple):
    """Residuals of W windows and their slopes along K directions."""

    residual: np.ndarray
    """(W, N, 19) measured - simulated; zero where nothing was measured."""
    slope: np.ndarray
    """(W, N, 19, K) of the simulated values."""
    offset: np.ndarray
    """(W, F) of what is free in each window, where the residuals were taken."""


class Given(NamedTuple):
    """What a vehicle file fixes, as arrays, so that one compiled rollout serves every vehicle."""

    nominal: Nominal
    constants: Constants
    base: dict[str, Any]
    """Values of every effect."""


class Model:
    """A vehicle's compiled rollout: residuals of windows and their slopes."""

    def __init__(
        self, vehicle: Vehicle, space: Space, driven_by_rotors: bool, voltage: bool
    ) -> None:
        """Prepare the rollout.

        Args:
            vehicle: its nominal values.
            space: what may change.
            driven_by_rotors: measured rotor speeds are the input, not the commands.
            voltage: the windows have a voltage.
        """
        self.space = space
        self.size = len(space.entries)
        self.free = STATE + (4 * KNOTS if driven_by_rotors else 0)
        """Numbers F that are free in each window: its start, and the rotor speeds' errors."""
        base = {name: value for name, value in space.base.items() if name != "gusts"}
        self._given = Given(*nominal_quadrotor(vehicle), base)
        self._linear = _compiled(space.layout, step_s(vehicle), driven_by_rotors, voltage)

    def residual(self, theta: np.ndarray, offset: np.ndarray, windows: Windows) -> np.ndarray:
        """Return measured - simulated (W, N, 19) from starts moved by `offset` (W, F)."""
        return self.linearise(theta, offset, windows, []).residual

    def linearise(
        self, theta: np.ndarray, offset: np.ndarray, windows: Windows, indices: list[int] | None
    ) -> Linear:
        """Return residuals and slopes along the numbers at `indices`, or along all and the start.

        With `indices` None the directions are all numbers and then the F free ones.
        """
        with jax.enable_x64(True):
            return self._linearise(theta, offset, windows, indices)

    def _linearise(
        self, theta: np.ndarray, offset: np.ndarray, windows: Windows, indices: list[int] | None
    ) -> Linear:
        everything = np.eye(self.size + self.free)
        if indices is None:
            groups = [everything]
        else:
            chosen = everything[indices]
            groups = []
            for first in range(0, max(len(indices), 1), FEW):
                rows = np.zeros((FEW, self.size + self.free))
                part = chosen[first : first + FEW]
                rows[: len(part)] = part
                groups.append(rows)
        values, slopes = [], []
        for x, w, count in _batches(offset, windows):
            answers = [self._linear(self._given, theta, x, w, group) for group in groups]
            values.append(np.asarray(answers[0][0])[:count])
            slopes.append(np.concatenate([np.asarray(a[1])[:count] for a in answers], axis=-1))
        width = self.size + self.free if indices is None else len(indices)
        return Linear(-np.concatenate(values), np.concatenate(slopes)[..., :width], offset)


def _batches(offset: np.ndarray, windows: Windows) -> Any:
    count = len(windows.flight)
    for first in range(0, count, BATCH):
        rows = np.minimum(np.arange(first, first + BATCH), count - 1)
        yield offset[rows], Windows(*(f[rows] for f in windows)), min(BATCH, count - first)


@cache
def _compiled(
    layout: Layout, dt: float, driven_by_rotors: bool, voltage: bool
) -> Callable[..., Any]:
    """Return the compiled slopes: XLA takes longer over them than a diagnosis does."""

    def linear(given: Given, theta: Any, offset: Any, windows: Windows, directions: Any) -> Any:
        size = len(layout)

        def fly(theta: Any, offset: Any) -> Any:
            values = effects_at(layout, given.base, theta)
            plant = assemble(given.nominal, given.constants, values, dt, 0.0)
            return _predict(plant, values, driven_by_rotors, voltage, offset, windows)

        def along(direction: Any) -> Any:
            tangent = (direction[:size], jnp.tile(direction[size:], (BATCH, 1)))
            return jax.jvp(fly, (theta, offset), tangent)

        values, slopes = jax.vmap(along, out_axes=(None, -1))(directions)
        return values, slopes

    return jax.jit(linear)


def _predict(
    plant: Plant,
    values: Mapping[str, Any],
    driven_by_rotors: bool,
    voltage: bool,
    offset: Any,
    windows: Windows,
) -> Any:
    """Return simulated - measured (B, N, 19) of B windows."""
    dt = float(plant.dt)
    gyro, accelerometer = values["gyro_bias"].bias, values["accelerometer_bias"].bias
    before, warm = round(HISTORY_S / dt) + 1, round(WARM_S / dt)
    steps = windows.command.shape[1] - before - warm
    command = _late(windows.command, plant.constants.delay, dt, before)
    motion = Motion(
        windows.pos_w + offset[:, :3],
        jnp.matmul(windows.rot_w, exp_rot(offset[:, 3:6])),
        windows.vel_w + offset[:, 6:9],
        windows.rate_b - gyro + offset[:, 9:STATE],
    )

    def ask(order: Any, rate_b: Any) -> Any:
        return wanted_speed(plant, Command(order[:, 0], order[:, 1:]), rate_b)

    def warm_up(speed: Any, inputs: Any) -> Any:
        order, rate_b = inputs
        wanted = ask(order, rate_b - gyro)
        return follow(speed, wanted, plant.constants.time_constant, plant.dt).end, None

    order = jnp.swapaxes(command, 0, 1)
    warm_rate_b = jnp.swapaxes(jnp.asarray(windows.warm_rate_b), 0, 1)
    speed, _ = jax.lax.scan(
        warm_up, ask(order[0], warm_rate_b[0] - gyro), (order[:warm], warm_rate_b)
    )

    def step(carry: Any, inputs: Any) -> Any:
        speed, motion = carry
        order, measured, drop, index = inputs
        if driven_by_rotors:
            spin = steady(measured)
        else:
            wanted = ask(order, motion.rate_b)
            spin = follow(speed, wanted, plant.constants.time_constant, plant.dt)
        memory = Memory(spin.end, jnp.zeros((len(speed), 4, 0)), {})
        time_s = windows.start_s + index * dt
        _, wrench = spin_step(plant, memory, motion, spin, time_s, None, drop if voltage else None)
        after = euler_step(plant, motion, wrench)
        return (spin.end, after), (after, spin.end, wrench.force_b / plant.constants.mass)

    measured_speed = jnp.asarray(windows.rotor_speed)
    if driven_by_rotors:
        error = offset[:, STATE:].reshape(-1, KNOTS, 4)
        measured_speed = measured_speed - jnp.matmul(_hats(steps), error)
    inputs = (
        order[warm:],
        jnp.swapaxes(measured_speed, 0, 1),
        jnp.swapaxes(jnp.asarray(windows.voltage_drop), 0, 1),
        jnp.arange(steps),
    )
    _, (flown, speeds, forces) = jax.lax.scan(step, (speed, motion), inputs)
    track = Motion(
        *(
            jnp.moveaxis(jnp.concatenate([a[None], b]), 0, 1)
            for a, b in zip(motion, flown, strict=True)
        )
    )
    speeds = jnp.moveaxis(jnp.concatenate([speed[None], speeds]), 0, 1)
    forces = jnp.moveaxis(jnp.concatenate([forces[:1], forces]), 0, 1)
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
    difference = jnp.concatenate(parts, axis=-1)
    assert difference.shape[-1] == CHANNELS
    return jnp.where(windows.seen, difference, 0.0)


def _hats(steps: int) -> np.ndarray:
    """Return the share (S, KNOTS) of each knot in each step, linear between knots."""
    place = (np.arange(steps) + 0.5) / steps * (KNOTS - 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(KNOTS)))


def _late(command: Any, delay: Any, dt: float, before: int) -> Any:
    """Return the command that acts in each step from `before` on, linear between two steps."""
    command = jnp.asarray(command)
    steps = delay / dt
    whole = jnp.floor(steps + 1e-9)
    part = steps - whole
    index = jnp.arange(before, command.shape[1]) - whole.astype(int)
    return (1.0 - part) * command[:, index] + part * command[:, jnp.maximum(index - 1, 0)]


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
