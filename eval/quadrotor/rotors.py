"""Rotors: speed follows its command with a delay and a first-order lag.

If the delay is not a multiple of the step, a step's command is the weighted mean of two commands,
so that the delay has a gradient. The diagnosis knows all commands in advance and takes means over
its own steps instead (`suite/diagnose/evidence/rollout.py`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tracks.geometry.scene import Array

SHORT_S = 1e-4
"""Shortest time over which a change of speed is divided [s]."""
NEGLIGIBLE = 1e-6
"""Thrusts below this count as zero [N]."""


class RotorStep(NamedTuple):
    """Rotor speeds in one physics step; the means are exact for a constant command."""

    end: Array
    """(..., 4) speed at the end of the step [rad/s]."""
    mean: Array
    """(..., 4) mean speed over the step [rad/s]."""
    mean_square: Array
    """(..., 4) mean of the squared speed over the step [(rad/s)^2]."""


def speed_command(thrust: Array, thrust_coefficient: float) -> Array:
    """Return the speeds (..., 4) [rad/s] that nominally produce `thrust` (..., 4) >= 0 [N]."""
    xp = thrust.__array_namespace__()
    # Near zero thrust the root's slope has no bound, and it would dominate all gradients.
    pushes = thrust > NEGLIGIBLE
    return xp.where(pushes, xp.sqrt(xp.where(pushes, thrust, 1.0) / thrust_coefficient), 0.0)


def follow(speed: Array, command: Array, time_constant: Array, dt: Array) -> RotorStep:
    """Return the rotors' step under dOmega/dt = (command - Omega) / time_constant.

    Thrust is computed from the mean square speed, so that lags far shorter than a step count to
    first order. A time constant of 0 follows at once, and the gradient with respect to it exists.

    Args:
        speed: (..., 4) at the start of the step [rad/s].
        command: (..., 4) held during the step [rad/s].
        time_constant: (...,) [s].
        dt: length of the step [s].
    """
    xp = speed.__array_namespace__()
    time_constant = xp.asarray(time_constant)
    lags = time_constant > 0.0
    left = xp.where(lags, xp.exp(-dt / xp.where(lags, time_constant, 1.0)), 0.0)
    steps = (time_constant / dt)[..., None]
    left = left[..., None]
    behind = speed - command
    mean = command + behind * steps * (1.0 - left)
    mean_square = (
        command**2
        + 2.0 * command * behind * steps * (1.0 - left)
        + behind**2 * 0.5 * steps * (1.0 - left**2)
    )
    return RotorStep(command + behind * left, mean, mean_square)


def acceleration(
    start: Array, rotors: RotorStep, command: Array | None, time_constant: Array, dt: Array
) -> Array:
    """Return the mean change of the rotor speeds (..., 4) over a step [rad/s^2].

    If the lag is longer than the step, the lag's equation gives the slope, even for a step of zero
    length. Otherwise the slope is the change divided by the step.

    Args:
        start: (..., 4) at the start of the step [rad/s].
        rotors: the step.
        command: (..., 4) that the rotors followed [rad/s]; None: their speeds are measured.
        time_constant: (...,) of the rotors [s].
        dt: length of the step [s].
    """
    xp = start.__array_namespace__()
    changed = (rotors.end - start) / xp.maximum(xp.asarray(dt), SHORT_S)
    if command is None:
        return changed
    lag = xp.asarray(time_constant)[..., None]
    lags = lag > dt
    slope = (command - 0.5 * (start + rotors.end)) / xp.where(lags, lag, 1.0)
    return xp.where(lags, slope, changed)


def steady(speed: Array) -> RotorStep:
    """Return the step of rotors with a constant speed (..., 4), such as a measured one [rad/s]."""
    return RotorStep(speed, speed, speed**2)


def whole_steps(delay: Array, dt: Any) -> tuple[Array, Array]:
    """Return `delay` (...,) [s] as whole steps of `dt` [s] and the remaining share of a step."""
    steps = delay / dt
    # 0.043 s are 43 steps of 0.001 s in spite of rounding.
    whole = steps.__array_namespace__().floor(steps + 1e-9)
    return whole, steps - whole


def delay_weight(delay: Array, dt: float, max_delay: float) -> Array:
    """Return the weight (..., L) of each stored command in the delayed one, newest first.

    L is the number of commands that `max_delay` [s] requires, 0 for no delay.
    """
    xp = delay.__array_namespace__()
    length = math.ceil(max_delay / dt - 1e-9) + 1 if max_delay > 0.0 else 0
    age = np.arange(length)
    whole, part = (each[..., None] for each in whole_steps(delay, dt))
    return xp.where(age == whole, 1.0 - part, 0.0) + xp.where(age == whole + 1.0, part, 0.0)


def delayed(weight: Array, past: Array, command: Array) -> tuple[Array, Array]:
    """Return the stored commands (..., C, L) with `command` (..., C), and the delayed one.

    Args:
        weight: (..., L) from `delay_weight`, L > 0.
        past: (..., C, L) of the steps before, newest first.
        command: (..., C) of this step.
    """
    xp = command.__array_namespace__()
    past = xp.concatenate([command[..., None], past[..., :-1]], axis=-1)
    return past, xp.matmul(past, xp.asarray(weight)[..., :, None])[..., 0]
