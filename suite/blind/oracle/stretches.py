"""Short stretches of simulated flights, flown again under changed physics.

What a log can say about a parameter is how far the parameter moves the logged channels over
stretches of half a second with the same commands, after the unknown state at the start of each
stretch has been fitted away. Everything here is numpy and free of noise. The stretches are flown
by the plant's own step (`eval/quadrotor/stepper.py`), one batch for all parameters: the oracle is
independent of the diagnosis and its rollouts, not of the catalogue's equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.quadrotor.plant import Motion, Plant, Wrench, euler_step, make_plant, unpacked
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.follow import Recording
from suite.diagnose.plans.simulate import FULL_V, Sensors
from tracks.geometry.rotation import exp_rot

HORIZON_S = 0.5
"""Length of a stretch [s]."""
EVERY_S = 0.5
"""From the start of one stretch to the next [s]."""
LONG_S = 2.0
"""Length of stretches that show what short ones hide: an error of force grows with its square."""
ROOM_S = 0.05
"""Commands before the start of a stretch that a delay may need [s]."""
DELAY_STEP_S = 0.004
"""By which a delay is changed [s]."""
STATE_STEP = 1e-5
"""By which the state at the start is changed, in its own units."""


class Stretches(NamedTuple):
    """W stretches of S steps from all flights of a case."""

    dt: float
    period: int
    """Steps from one row of a log to the next."""
    start_s: np.ndarray
    """(W,) time in flight at the start [s]."""
    motion: Motion
    """(W, ...) true states at the start."""
    rotor_speed: np.ndarray
    """(W, 4) at the start [rad/s]."""
    history: np.ndarray
    """(W, 4, L) commands of the steps before, newest first."""
    command: np.ndarray
    """(S, W, 4) thrust [m/s^2] and body rates [rad/s]."""
    acting: np.ndarray
    """(S, W, 4) with what physics outside the catalogue made of it."""
    extra: Wrench
    """(S, W, 3) of physics outside the catalogue."""
    voltage_drop: np.ndarray
    """(S, W) [V]."""


class Channels(NamedTuple):
    """What a log could hold of stretches, on R rows each, the start's row first."""

    pos_w: np.ndarray
    rot_w: np.ndarray
    vel_w: np.ndarray
    rate_b: np.ndarray
    acc_b: np.ndarray
    rotor_speed: np.ndarray


def cut(
    recordings: Sequence[Recording], every_s: float = EVERY_S, horizon_s: float = HORIZON_S
) -> Stretches:
    """Return the stretches of all `recordings`, which share their physics step and log rate.

    Args:
        recordings: flights.
        every_s: from the start of one stretch to the next [s].
        horizon_s: length of a stretch [s].
    """
    dt, period = recordings[0].dt, recordings[0].period
    steps = round(horizon_s / dt / period) * period
    room = round(ROOM_S / dt)
    stride = max(round(every_s / dt / period), 1) * period
    begins = [
        (flight, start)
        for flight in recordings
        for start in range(-(-room // period) * period, len(flight.time_s) - steps, stride)
    ]

    def first(read: Callable[[Recording], np.ndarray]) -> np.ndarray:
        return np.stack([read(flight)[start] for flight, start in begins])

    def during(read: Callable[[Recording], np.ndarray]) -> np.ndarray:
        return np.stack([read(flight)[start : start + steps] for flight, start in begins], axis=1)

    return Stretches(
        dt,
        period,
        first(lambda flight: flight.time_s),
        Motion(*(first(lambda flight, k=k: flight.motion[k]) for k in range(4))),
        first(lambda flight: flight.rotor_speed),
        np.stack([f.acting.packed[start - room : start][::-1].T for f, start in begins]),
        during(lambda flight: flight.command.packed),
        during(lambda flight: flight.acting.packed),
        Wrench(*(during(lambda flight, k=k: flight.extra[k]) for k in range(2))),
        during(lambda flight: FULL_V - flight.voltage),
    )


def replay(
    stretches: Stretches,
    plant: Plant,
    motion: Motion | None = None,
    outside: bool = False,
    has_voltage: bool = False,
    draws: np.ndarray | None = None,
) -> Channels:
    """Fly the stretches again.

    Args:
        stretches: W stretches.
        plant: one, or with leading axes (P, 1) that the result then has as (R, P, W, ...).
        motion: (P, W, ...) to start from in place of the true states.
        outside: whether the recorded physics outside the catalogue acts too.
        has_voltage: whether effects see the voltage.
        draws: (S + 1, P, W, 3) normal draws for random wind.
    """
    start = stretches.motion if motion is None else motion
    shapes = [start.pos_w.shape[:-1], plant.constants.mass.shape]
    lead = np.broadcast_shapes(*shapes, () if draws is None else draws.shape[1:-1])
    motion = Motion(
        *(np.broadcast_to(part, (*lead, *own)) for part, own in zip(start, _SHAPES, strict=True))
    )
    room = plant.delay_weight.shape[-1]
    gusts = {name: gust for name in plant.effects if (gust := EFFECTS[name].gust) is not None}
    wind = {} if draws is None else {n: g(plant.effects[n], draws[0]) for n, g in gusts.items()}
    state = PlantState(
        np.broadcast_to(stretches.rotor_speed, (*lead, 4)),
        np.broadcast_to(stretches.history[..., :room], (*lead, 4, room)),
        wind,
    )
    acc_b = np.zeros((*lead, 3))
    # The first row has no step before it: its accelerometer says nothing.
    kept = [(*motion, acc_b, state.rotor_speed)]
    for step, given in enumerate(stretches.acting if outside else stretches.command):
        inputs = Inputs(
            unpacked(np.broadcast_to(given, (*lead, 4))),
            noise=None if draws is None else draws[step + 1],
            voltage_drop=stretches.voltage_drop[step] if has_voltage else None,
        )
        time_s = stretches.start_s + step * stretches.dt
        state, wrench = plant_step(plant, state, motion, inputs, time_s)
        if outside:
            added = (part[step] for part in stretches.extra)
            wrench = Wrench(*(one + two for one, two in zip(wrench, added, strict=True)))
        acc_b = wrench.force_b / plant.constants.mass[..., None]
        motion = euler_step(plant, motion, wrench)
        if (step + 1) % stretches.period == 0:
            kept.append((*motion, acc_b, state.rotor_speed))
    return Channels(*(np.stack(part) for part in zip(*kept, strict=True)))


_SHAPES = ((3,), (3, 3), (3,), (3,))
"""Of a body's motion: position, body to world, velocity, body rates."""


def whitened(sensors: Sensors, channels: Channels, base: Channels) -> np.ndarray:
    """Return (..., W, D): how far `channels` are from `base`, in standard deviations of the noise.

    `base` may lack leading axes that `channels` has.
    """
    more = (1,) * (channels.pos_w.ndim - base.pos_w.ndim)
    old = Channels(*(part.reshape(len(part), *more, *part.shape[1:]) for part in base))
    turn = np.matmul(np.swapaxes(old.rot_w, -1, -2), channels.rot_w)
    angle = 0.5 * np.stack(
        [turn[..., k, j] - turn[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1
    )
    parts = [
        (channels.pos_w - old.pos_w, sensors.pos),
        (angle, sensors.attitude),
        (channels.rate_b - old.rate_b, sensors.gyro),
        (channels.vel_w - old.vel_w, sensors.vel),
        (channels.acc_b - old.acc_b, sensors.acc),
        (channels.rotor_speed - old.rotor_speed, sensors.rotor),
    ]
    both = np.concatenate([part / sigma for part, sigma in parts if sigma], axis=-1)
    both = np.moveaxis(both, 0, -2)
    return both.reshape(*both.shape[:-2], -1)


def state_columns(
    stretches: Stretches, plant: Plant, sensors: Sensors, base: Channels
) -> np.ndarray:
    """Return (W, D, 12): an orthonormal basis of what an unknown start can explain."""
    motion = stretches.motion
    # One row of 12 for each axis of position, attitude, velocity and body rates.
    moves = STATE_STEP * np.eye(12).reshape(12, 4, 1, 3)
    moved = Motion(
        motion.pos_w + moves[:, 0],
        np.matmul(motion.rot_w, exp_rot(moves[:, 1] + 0.0 * motion.pos_w)),
        motion.vel_w + moves[:, 2],
        motion.rate_b + moves[:, 3],
    )
    columns = whitened(sensors, replay(stretches, plant, moved), base) / STATE_STEP
    return np.linalg.qr(np.moveaxis(columns, 0, -1))[0]


def without_start(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return columns (..., W, D) less what an unknown start can explain of them."""
    share = np.einsum("wdk,...wd->...wk", basis, columns)
    return columns - np.einsum("wdk,...wk->...wd", basis, share)


def stretch_plant(vehicle: Vehicle, effects: Mapping[str, Any] | None = None) -> Plant:
    """Return a plant for stretches, `effects` in place of the vehicle's own.

    It remembers the commands that the vehicle's delay and `DELAY_STEP_S` more need.
    """
    dt = 1.0 / vehicle.controller.frequency
    room = float(make_plant(vehicle, dt).constants.delay) + DELAY_STEP_S
    return make_plant(vehicle, dt, effects, min(room, ROOM_S - 2.0 * dt))
