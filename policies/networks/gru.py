"""The gated recurrent unit of both networks (Cho et al. 2014, with torch's order of gates)."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def gru_update(from_input: jax.Array, from_hidden: jax.Array, hidden: jax.Array) -> jax.Array:
    """Return the next hidden state (..., H).

    Args:
        from_input: (..., 3 H) the input's part of the gates reset, update and new.
        from_hidden: (..., 3 H) the hidden state's part of the same.
        hidden: (..., H).
    """
    reset_x, update_x, new_x = jnp.split(from_input, 3, axis=-1)
    reset_h, update_h, new_h = jnp.split(from_hidden, 3, axis=-1)
    reset = jax.nn.sigmoid(reset_x + reset_h)
    update = jax.nn.sigmoid(update_x + update_h)
    new = jnp.tanh(new_x + reset * new_h)
    return new + update * (hidden - new)
