"""The critic: an MLP that estimates the value of a state from privileged information.

The value is the expected return. The critic is used only in training, so its inputs may be the true
state and the nearest obstacle instead of the image (asymmetric critic, Pinto et al. 2018). From
them it learns faster.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from policies.spec import PolicySpec
from suite.train.dynamics.interface import DynamicsState
from suite.train.step import NEAR, target_gate
from suite.train.worlds import Worlds
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.rotation import to_local

Params = dict[str, jax.Array]
"""Weights and biases of the critic's layers, by name."""
AHEAD_S = (0.0, 0.1, 0.2, 0.4, 0.8)
"""Times from now at which the critic's inputs have the distance to solids, for a flight at constant
velocity [s]."""
FEATURES = 29 + 2 * len(AHEAD_S)
"""Number of inputs, without the commanded speed."""
REACH_M = 2.0
"""Largest distance to an obstacle in the inputs; larger ones are limited to it [m]."""
TOUCH_M = 0.2
"""Decay length of the inputs that grow near obstacles [m]."""


def features(worlds: Worlds, body: DynamicsState, target: jax.Array) -> jax.Array:
    """Return the critic's inputs (B, F) in worlds that have passed `target` (B,) gates.

    The first inputs are in the frame of the next gate, scaled to about one: position, velocity,
    acceleration, the gate after it, the drone's forward and up axes, the direction away from the
    nearest obstacle, and the position with a finer scale near the gate. Then follow the distances
    to solids now and at later times, twice (linear, and growing near a solid); the time and place
    at which the gate's plane is reached at constant velocity; the opening's width; the number of
    remaining gates (up to 2); and the commanded speed, if the policy has that input.

    F is `feature_count`.
    """
    gates = worlds.scene.gates
    gate, _ = target_gate(gates, target)
    following, _ = target_gate(gates, target, ahead=1)
    times = jnp.asarray(AHEAD_S)[:, None]
    path_w = body.pos_w[:, None] + times * body.vel_w[:, None]
    distance, away_w = nearest_obstacle(worlds.scene, path_w, NEAR)
    pos_g = to_local(gate.rot_w, body.pos_w - gate.center_w)
    vel_g = to_local(gate.rot_w, body.vel_w)
    half_width = gate.opening_g.max((1, 2))[:, None]
    time_to_plane = jnp.clip(-pos_g[:, :1] / jnp.maximum(vel_g[:, :1], 0.1), 0.0, 2.0)
    crossing_g = pos_g[:, 1:] + time_to_plane * vel_g[:, 1:]
    remaining = gates.center_w.shape[1] - target
    columns = [
        pos_g / 5.0,
        vel_g / 5.0,
        to_local(gate.rot_w, body.acc_w) / 10.0,
        to_local(gate.rot_w, following.center_w - gate.center_w) / 5.0,
        to_local(gate.rot_w, body.rot_w[:, :, 0]),
        to_local(gate.rot_w, body.rot_w[:, :, 2]),
        to_local(gate.rot_w, away_w[:, 0]),
        jnp.tanh(2.0 * pos_g),
        jnp.clip(distance, -REACH_M, REACH_M),
        jnp.exp(-jnp.maximum(distance, -TOUCH_M) / TOUCH_M),
        time_to_plane,
        jnp.clip(crossing_g / half_width, -3.0, 3.0),
        2.0 * half_width,
        jnp.minimum(remaining, 2)[:, None] - 1.0,
    ]
    if worlds.speed_command is not None:
        columns.append(worlds.speed_command[:, None])
    return jnp.concatenate(columns, axis=-1)


def feature_count(spec: PolicySpec) -> int:
    """Return the number of the critic's inputs for a policy with `spec`."""
    return FEATURES + spec.speed_input


def init(key: jax.Array, width: int, count: int = FEATURES) -> Params:
    """Return random parameters of a critic with `count` inputs and two hidden layers of `width`.

    The last layer's weights are small, so that the first values are near zero.
    """
    sizes = [(count, width), (width, width), (width, 1)]
    params: Params = {}
    for number, (k, (rows, columns)) in enumerate(
        zip(jax.random.split(key, len(sizes)), sizes, strict=True)
    ):
        scale = 0.01 if columns == 1 else 1.0
        params[f"weight{number}"] = scale * rows**-0.5 * jax.random.normal(k, (rows, columns))
        params[f"bias{number}"] = jnp.zeros(columns)
    return params


def value(params: Params, inputs: jax.Array) -> jax.Array:
    """Return the values (...) of states, given their `features` (..., F)."""
    x = jnp.tanh(inputs @ params["weight0"] + params["bias0"])
    x = jnp.tanh(x @ params["weight1"] + params["bias1"])
    return (x @ params["weight2"] + params["bias2"])[..., 0]
