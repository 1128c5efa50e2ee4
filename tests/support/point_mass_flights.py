"""Flights that the point mass itself makes, as flight logs with nothing but the truth in them."""

from functools import partial

import jax
import numpy as np

from eval.logs.flight_log import FlightLog
from suite.train.dynamics import point_mass
from tracks.geometry.rotation import rot_to_quat

RATE_HZ = 30.0
SOON_S = 1e-3
"""A row this long after each decision carries the acceleration of that moment."""
MOST = 8
"""So many drones are flown, whatever is asked for, so that all tests use one compiled program."""


@partial(jax.jit, static_argnums=0)
def flown(extra_b, constants, body, inputs):
    """Return the states before each decision, (T, B, ...)."""

    def step(body, inputs):
        action, target = inputs
        flown = action
        if extra_b is not None:
            flown = action + extra_b((body.rot_w * body.vel_w[..., :, None]).sum(-2), action)
        return point_mass.step(body, constants, flown, target, 0.0), body

    return jax.lax.scan(step, body, inputs)[1]


begun = jax.jit(point_mass.start)


def fly(plant, count=4, seconds=3.0, seed=0, extra_b=None):
    """Return `count` logs of a point mass of lag, drag and delay `plant` under lively actions.

    `extra_b(vel_b, action_b)` is added to the action by the vehicle and unknown to the log.
    """
    steps, longest = round(seconds * RATE_HZ), round(4.0 * RATE_HZ)
    assert count <= MOST and steps <= longest
    rng = np.random.default_rng(seed)
    time = np.arange(steps) / RATE_HZ
    phase, rate = rng.uniform(0, 6.3, (2, count, 3)), rng.uniform(1, 4, (count, 3))
    wave = np.sin(rate[:, None] * time[None, :, None] + phase[0][:, None])
    action = (wave * [4.0, 4.0, 2.0]).astype(np.float32)
    pos_w, vel_w = rng.uniform(-1, 1, (count, 3)) + [0, 0, 5], rng.normal(0, 2, (count, 3))
    values = (plant.lag, plant.drag, np.zeros(3), 1 / RATE_HZ, plant.delay)
    constants = point_mass.PointMassParams(
        *(np.broadcast_to(np.float32(x), (MOST, *np.shape(x))) for x in values)
    )
    angle = 0.8 * np.arange(longest) / RATE_HZ
    target = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)[:, None] * 100
    ahead = np.tile(np.float32([1.0, 0.0, 0.0]), (MOST, 1))
    body = begun(_filled(pos_w, MOST), _filled(vel_w, MOST), ahead)
    actions = _filled(_filled(action, MOST).swapaxes(0, 1), longest)
    states = jax.tree.map(
        lambda x: np.asarray(x)[:steps, :count],
        flown(extra_b, constants, body, (actions, np.float32(target))),
    )
    return [_log(i, time, states, action[i]) for i in range(count)]


def _filled(rows, count):
    """Return `count` rows: those given, and zeros after them."""
    zeros = np.zeros((count - len(rows), *np.shape(rows)[1:]))
    return np.concatenate([rows, zeros]).astype(np.float32)


def _log(i, time, flown, action):
    pos, vel, acc, rot = (
        np.asarray(x[:, i], float) for x in (flown.pos_w, flown.vel_w, flown.acc_w, flown.rot_w)
    )

    def rows(decision, soon):
        return np.stack([decision, soon], 1).reshape(2 * len(time), *decision.shape[1:])

    quat = rot_to_quat(rot)
    actions = rows(action, action).astype(float)
    return FlightLog(
        f"flight {i}",
        rows(time, time + SOON_S),
        rows(pos, pos + vel * SOON_S),
        rows(quat, quat),
        rows(vel, vel + acc * SOON_S),
        np.zeros((2 * len(time), 3)),
        extra={
            **{f"action_{axis}": actions[:, k] for k, axis in enumerate("xyz")},
            "policy_step": rows(np.ones(len(time)), np.zeros(len(time))),
        },
    )
