"""The Delta Action network: MLP + GRU of 32 (Su et al. 2026, Sec. III-D and III-E).

From velocity in body axes, attitude and the current action it gives a correction of the action,
so that the point mass under the corrected action moves as the recorded vehicle did.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from policies.networks.layers import gru_update, uniform
from policies.networks.network import leaky_relu
from policies.spec import ACTION_SIZE

Params = dict[str, jax.Array]

HIDDEN = 32
"""Width of the features and of the recurrent state."""
INPUTS = 9
"""Velocity in body axes (3), third row of R (3) and the action (3)."""
INPUT_SCALE = (0.2, 0.2, 0.2, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
"""Brings metres a second and m/s^2 to order one."""


def init(key: jax.Array) -> Params:
    """Return fresh parameters; the output starts at zero, so the model starts as no correction."""
    return _drawn(key)


@jax.jit
def _drawn(key: jax.Array) -> Params:
    shapes = {
        "input.weight": (INPUTS, HIDDEN),
        "input.bias": (HIDDEN,),
        "gru.weight_input": (HIDDEN, 3 * HIDDEN),
        "gru.weight_hidden": (HIDDEN, 3 * HIDDEN),
        "gru.bias": (3 * HIDDEN,),
        "gru.bias_new": (HIDDEN,),
        "output.weight": (HIDDEN, ACTION_SIZE),
        "output.bias": (ACTION_SIZE,),
    }
    params = {}
    for name, drawn in uniform(key, shapes).items():
        bound = (INPUTS if name == "input.weight" else HIDDEN) ** -0.5
        params[name] = drawn * (2 * bound) - bound
    params["output.weight"] *= 0.0
    params["output.bias"] *= 0.0
    return params


def start(n: int) -> jax.Array:
    """Return the hidden state at the start of a flight, (n, 32) zeros."""
    return jnp.zeros((n, HIDDEN))


def step(
    params: Params, hidden: jax.Array, vel_b: jax.Array, row3: jax.Array, action_b: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return (correction_b (..., 3) [m/s^2], hidden' (..., 32)).

    Args:
        params: from `init` or a checkpoint.
        hidden: (..., 32).
        vel_b: (..., 3) velocity in body axes [m/s].
        row3: (..., 3) third row of R, world z in body axes.
        action_b: (..., 3) the action being corrected [m/s^2].
    """
    x = jnp.concatenate([vel_b, row3, action_b], axis=-1) * jnp.asarray(INPUT_SCALE)
    x = leaky_relu(x @ params["input.weight"] + params["input.bias"])
    gates_x = x @ params["gru.weight_input"] + params["gru.bias"]
    # A gate's two biases are equivalent, except in the new gate, where the reset is between them.
    bias_h = jnp.pad(params["gru.bias_new"], (2 * HIDDEN, 0))
    hidden = gru_update(gates_x, hidden @ params["gru.weight_hidden"] + bias_h, hidden)
    return hidden @ params["output.weight"] + params["output.bias"], hidden
