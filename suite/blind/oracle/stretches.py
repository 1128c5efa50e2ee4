"""Short stretches of simulated flights, flown again under changed physics.

What a log can say about a parameter is how far the parameter moves the logged channels over
stretches of half a second with the same commands, after the unknown state at the start of each
stretch has been fitted away. Everything here is numpy and free of noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.quadrotor.plant import Command, Motion, Plant, Wrench, euler_step, make_plant
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.follow import Recording
from suite.diagnose.plans.sensors import Sensors
from suite.diagnose.plans.simulate import FULL_V
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
    command: Command
    """(S, W, ...)."""
    acting: Command
    """(S, W, ...) with what physics outside the catalogue made of it."""
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
    parts: list[list[Any]] = []
    for flight in recordings:
        first = -(-room // period) * period
        for start in range(first, len(flight.time_s) - steps, stride):
            span, past = slice(start, start + steps), slice(start - room, start)
            packed = np.concatenate([flight.acting.thrust[:, None], flight.acting.rate_b], axis=1)
            parts.append(
                [
                    flight.time_s[start],
                    *(field[start] for field in flight.motion),
                    flight.rotor_speed[start],
                    packed[past][::-1].T,
                    flight.command.thrust[span],
                    flight.command.rate_b[span],
                    flight.acting.thrust[span],
                    flight.acting.rate_b[span],
                    flight.extra.force_b[span],
                    flight.extra.torque_b[span],
                    FULL_V - flight.voltage[span],
                ]
            )
    heads = [np.stack([part[i] for part in parts]) for i in range(7)]
    rows = [np.stack([part[i] for part in parts], axis=1) for i in range(7, 14)]
    return Stretches(
        dt,
        period,
        heads[0],
        Motion(*heads[1:5]),
        heads[5],
        heads[6],
        Command(rows[0], rows[1]),
        Command(rows[2], rows[3]),
        Wrench(rows[4], rows[5]),
        rows[6],
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
    lead = np.broadcast_shapes(start.pos_w.shape[:-1], plant.constants.mass.shape)
    if draws is not None:
        lead = np.broadcast_shapes(lead, draws.shape[1:-1])
    motion = Motion(*(np.broadcast_to(f, (*lead, *f.shape[_axes(i) :])) for i, f in _ends(start)))
    room = plant.delay_weight.shape[-1]
    wind = {}
    if draws is not None:
        for name, value in plant.effects.items():
            gust = EFFECTS[name].gust
            if gust is not None:
                wind[name] = gust(value, draws[0])
    state = PlantState(
        np.broadcast_to(stretches.rotor_speed, (*lead, 4)),
        np.broadcast_to(stretches.history[..., :room], (*lead, 4, room)),
        wind,
    )
    acc_b = np.zeros((*lead, 3))
    kept = []
    given = stretches.acting if outside else stretches.command
    steps = len(given.thrust)
    for step in range(steps + 1):
        if step % stretches.period == 0:
            # The first row has no step before it: its accelerometer says nothing.
            kept.append((*motion, acc_b, state.rotor_speed))
        if step == steps:
            break
        command = Command(
            np.broadcast_to(given.thrust[step], lead),
            np.broadcast_to(given.rate_b[step], (*lead, 3)),
        )
        inputs = Inputs(
            command,
            noise=None if draws is None else draws[step + 1],
            voltage_drop=stretches.voltage_drop[step] if has_voltage else None,
        )
        time_s = stretches.start_s + step * stretches.dt
        state, wrench = plant_step(plant, state, motion, inputs, time_s)
        if outside:
            wrench = Wrench(
                wrench.force_b + stretches.extra.force_b[step],
                wrench.torque_b + stretches.extra.torque_b[step],
            )
        acc_b = wrench.force_b / plant.constants.mass[..., None]
        motion = euler_step(plant, motion, wrench)
    pos_w, rot_w, vel_w, rate_b, acc_b, speed = (np.stack(part) for part in zip(*kept, strict=True))
    return Channels(pos_w, rot_w, vel_w, rate_b, acc_b, speed)


def whitened(sensors: Sensors, channels: Channels, base: Channels) -> np.ndarray:
    """Return (..., W, D): how far `channels` are from `base`, in standard deviations of the noise.

    `base` may lack leading axes that `channels` has.
    """

    def apart(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return new - old.reshape(len(old), *(1,) * (new.ndim - old.ndim), *old.shape[1:])

    old_rot = base.rot_w.reshape(
        len(base.rot_w), *(1,) * (channels.rot_w.ndim - base.rot_w.ndim), *base.rot_w.shape[1:]
    )
    turn = np.matmul(np.swapaxes(old_rot, -1, -2), channels.rot_w)
    angle = 0.5 * np.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )
    parts = [
        (apart(channels.pos_w, base.pos_w), sensors.pos),
        (angle, sensors.attitude),
        (apart(channels.rate_b, base.rate_b), sensors.gyro),
        (apart(channels.vel_w, base.vel_w), sensors.vel),
        (apart(channels.acc_b, base.acc_b), sensors.acc),
        (apart(channels.rotor_speed, base.rotor_speed), sensors.rotor),
    ]
    both = np.concatenate([part / sigma for part, sigma in parts if sigma], axis=-1)
    both = np.moveaxis(both, 0, -2)
    return both.reshape(*both.shape[:-2], -1)


def state_columns(
    stretches: Stretches, plant: Plant, sensors: Sensors, base: Channels
) -> np.ndarray:
    """Return (W, D, 12): an orthonormal basis of what an unknown start can explain."""
    motion = stretches.motion
    step = STATE_STEP * np.eye(3)[:, None, :]
    still = np.zeros((3, 1, 3))

    def stacked(part: int) -> np.ndarray:
        return np.concatenate([step if i == part else still for i in range(4)])

    moved = Motion(
        motion.pos_w + stacked(0),
        np.matmul(motion.rot_w, exp_rot(stacked(1) + 0.0 * motion.pos_w)),
        motion.vel_w + stacked(2),
        motion.rate_b + stacked(3),
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


def _ends(motion: Motion) -> list[tuple[int, np.ndarray]]:
    return list(enumerate(motion))


def _axes(index: int) -> int:
    return -2 if index == 1 else -1
