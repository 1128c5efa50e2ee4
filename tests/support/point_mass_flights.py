"""Flights that the point mass itself makes, as flight logs with nothing but the truth in them."""

import jax
import jax.numpy as jnp
import numpy as np

from eval.logs.flight_log import FlightLog
from suite.train.dynamics import point_mass
from tracks.geometry.rotation import rot_to_quat

RATE_HZ = 30.0
SOON_S = 1e-3
"""A row this long after each decision carries the acceleration of that moment."""


def fly(plant, count=4, seconds=3.0, seed=0, extra_b=None):
    """Return `count` logs of a point mass of lag, drag and delay `plant` under lively actions.

    `extra_b(vel_b, action_b)` is added to the action by the vehicle and unknown to the log.
    """
    steps = round(seconds * RATE_HZ)
    rng = np.random.default_rng(seed)
    time = np.arange(steps) / RATE_HZ
    phase, rate = rng.uniform(0, 6.3, (2, count, 3)), rng.uniform(1, 4, (count, 3))
    wave = np.sin(rate[:, None] * time[None, :, None] + phase[0][:, None])
    action = (wave * [4.0, 4.0, 2.0]).astype(np.float32)
    body = point_mass.start(
        jnp.asarray(rng.uniform(-1, 1, (count, 3)) + [0, 0, 5], jnp.float32),
        jnp.asarray(rng.normal(0, 2, (count, 3)), jnp.float32),
        jnp.tile(jnp.asarray([1.0, 0.0, 0.0]), (count, 1)),
    )
    constants = point_mass.PointMassParams(
        lag=jnp.full(count, plant.lag),
        drag=jnp.broadcast_to(jnp.asarray(plant.drag, jnp.float32), (count, 3)),
        wind_w=jnp.zeros((count, 3)),
        time_step=jnp.full(count, 1 / RATE_HZ),
        delay=jnp.full(count, plant.delay),
    )

    def step(body, inputs):
        action, target = inputs
        flown = action
        if extra_b is not None:
            flown = action + extra_b((body.rot_w * body.vel_w[..., :, None]).sum(-2), action)
        return point_mass.step(body, constants, flown, target, 0.0), body

    target = np.stack([np.cos(0.8 * time), np.sin(0.8 * time), 0 * time], -1) * 100
    inputs = (jnp.asarray(action.swapaxes(0, 1)), jnp.asarray(target[:, None], jnp.float32))
    _, flown = jax.jit(lambda b: jax.lax.scan(step, b, inputs))(body)
    return [_log(i, time, flown, action[i]) for i in range(count)]


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
