"""What the Delta Action network remembers when a window starts: its burn-in.

In fine-tuning the network runs for seconds, so it is not fitted from a zero state alone: before
a window it runs over what was measured since the flight's start, up to a few seconds. Nor is it
fitted from such states alone: most worlds of the trainer start on the way, and what was flown
before nobody knows there.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from policies.networks import delta_network
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array

BURN_IN_S = 3.0
"""How far back the network looks before a window [s]."""


class BurnIn(NamedTuple):
    """The network's inputs at W decisions before each of N windows."""

    inputs: Array
    """(N, W, 9) velocity in body axes [m/s], third row of R, action [m/s^2]; oldest first."""
    seen: Array
    """(N, W) 1 where there was a decision of the flight, 0 before its start."""


def burn_in_before(
    rot_w: np.ndarray, vel_w: np.ndarray, action_b: np.ndarray, first: int, count: int
) -> BurnIn:
    """Return inputs (W, 9) and seen (W,) of the decisions before number `first` of a flight.

    Args:
        rot_w: (T, 3, 3) measured at the flight's decisions.
        vel_w: (T, 3) [m/s].
        action_b: (T, 3) [m/s^2].
        first: the decision at which the window starts.
        count: W.
    """
    inputs, seen = np.zeros((count, 9)), np.zeros(count)
    start = max(0, first - count)
    rows = slice(start, first)
    if first > start:
        before = [to_local(rot_w[rows], vel_w[rows]), rot_w[rows, 2], action_b[rows]]
        inputs[count - (first - start) :] = np.concatenate(before, axis=-1)
        seen[count - (first - start) :] = 1.0
    return BurnIn(inputs, seen)


def forgotten(burn_in: BurnIn, share: float) -> BurnIn:
    """Return burn-ins of which the first `share` (0 to 1) of the windows have seen nothing."""
    count = len(burn_in.seen)
    knows = (jnp.arange(count) >= round(share * count))[:, None]
    return burn_in._replace(seen=jnp.where(knows, jnp.asarray(burn_in.seen), 0.0))


def state_after(params: delta_network.Params | None, burn_in: BurnIn) -> jax.Array:
    """Return the network's recurrent state (N, 32) after a burn-in; a blank one without network."""
    blank = delta_network.start(len(burn_in.seen))
    if params is None:
        return blank
    inputs, seen = (jnp.swapaxes(jnp.asarray(array), 0, 1) for array in burn_in)

    def step(hidden: jax.Array, decision: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        values, is_there = decision
        after = delta_network.step(params, hidden, values[:, :3], values[:, 3:6], values[:, 6:])[1]
        return jnp.where(is_there[:, None] > 0, after, hidden), None

    return jax.lax.scan(step, blank, (inputs, seen))[0]
