"""Commands act late.

A delay that is no multiple of the step makes a step's command the mean of the two that share it,
so that a delay has a gradient. A flight whose commands are all known needs no memory of them: the
diagnosis takes means over its own steps (`suite/diagnose/fit/rollout.py`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tracks.geometry.scene import Array


def whole_steps(delay: Array, dt: Any) -> tuple[Array, Array]:
    """Return `delay` (...,) [s] as whole steps of `dt` [s] and the share of a step that is left."""
    steps = delay / dt
    # 0.043 s are 43 steps of 0.001 s in spite of rounding.
    whole = steps.__array_namespace__().floor(steps + 1e-9)
    return whole, steps - whole


def delay_weight(delay: Array, dt: float, max_delay: float) -> Array:
    """Return the share (..., L) of each remembered command in the one that acts, newest first.

    L is what `max_delay` [s] needs, 0 where that is 0.
    """
    xp = delay.__array_namespace__()
    length = math.ceil(max_delay / dt - 1e-9) + 1 if max_delay > 0.0 else 0
    age = np.arange(length)
    whole, part = (each[..., None] for each in whole_steps(delay, dt))
    return xp.where(age == whole, 1.0 - part, 0.0) + xp.where(age == whole + 1.0, part, 0.0)


def delayed(weight: Array, past: Array, command: Array) -> tuple[Array, Array]:
    """Return the remembered commands (..., C, L) with `command` (..., C), and the one that acts.

    Args:
        weight: (..., L) from `delay_weight`, L > 0.
        past: (..., C, L) of the steps before, newest first.
        command: (..., C) of this step.
    """
    xp = command.__array_namespace__()
    past = xp.concatenate([command[..., None], past[..., :-1]], axis=-1)
    return past, xp.matmul(past, xp.asarray(weight)[..., :, None])[..., 0]
