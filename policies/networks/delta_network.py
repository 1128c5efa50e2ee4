"""The Delta Action network: it corrects the action so that the simulation matches real flights.

Inputs are the velocity in body axes, the attitude and the current action; the output is added to
the action. Under the corrected action, the simulated point mass moves as the recorded vehicle did.
The network is an MLP and a GRU of 32 units (Su et al. 2026, Sec. III-D and III-E).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from policies.networks.layers import gru_update, uniform
from policies.networks.network import leaky_relu
from policies.spec import ACTION_SIZE

Params = dict[str, jax.Array]
"""Parameters by name."""
HIDDEN = 32
"""Width of the features and of the recurrent state."""
INPUTS = 9
"""Number of inputs: velocity in body axes (3), third row of the attitude matrix (3), action (3)."""
INPUT_SCALE = (0.2, 0.2, 0.2, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
"""Factors that bring the inputs in m/s and m/s^2 to order one."""


@jax.jit
def init(key: jax.Array) -> Params:
    """Return random initial parameters; the output layer is zero, so the correction is zero."""
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
    for name, number in uniform(key, shapes).items():
        bound = (INPUTS if name == "input.weight" else HIDDEN) ** -0.5
        params[name] = number * (2 * bound) - bound
    params["output.weight"] *= 0.0
    params["output.bias"] *= 0.0
    return params


def start(n: int) -> jax.Array:
    """Return the hidden state at the start of a flight, (n, 32) zeros."""
    return jnp.zeros((n, HIDDEN))


def step(
    params: Params, hidden: jax.Array, vel_b: jax.Array, row3: jax.Array, action_b: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the correction (..., 3) [m/s^2, body axes] and the new hidden state (..., 32).

    Args:
        params: the network's parameters, from `init` or a checkpoint.
        hidden: (..., 32) recurrent state.
        vel_b: (..., 3) velocity in body axes [m/s].
        row3: (..., 3) third row of the attitude matrix R: world z in body axes.
        action_b: (..., 3) the action to correct [m/s^2].
    """
    x = jnp.concatenate([vel_b, row3, action_b], axis=-1) * jnp.asarray(INPUT_SCALE)
    x = leaky_relu(x @ params["input.weight"] + params["input.bias"])
    gates_x = x @ params["gru.weight_input"] + params["gru.bias"]
    # Only the new gate needs a second bias, which the reset gate multiplies.
    bias_h = jnp.pad(params["gru.bias_new"], (2 * HIDDEN, 0))
    hidden = gru_update(gates_x, hidden @ params["gru.weight_hidden"] + bias_h, hidden)
    return hidden @ params["output.weight"] + params["output.bias"], hidden
