"""Rotor speed follows its command, late and with a first-order lag; thrust goes with its square.

A delay that is no multiple of the step makes a step's command the mean of the two that share it,
so that a delay has a gradient. A flight whose commands are all known needs no memory of them: the
diagnosis takes means over its own steps (`suite/diagnose/evidence/rollout.py`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tracks.geometry.scene import Array

SHORT_S = 1e-4
"""Changes over shorter steps are taken to last so long [s]."""
NEGLIGIBLE = 1e-6
"""Thrusts below this are none [N]."""


class RotorStep(NamedTuple):
    """What the rotors do during one physics step; means are exact for a constant command."""

    end: Array
    """(..., 4) speed at the end of the step [rad/s]."""
    mean: Array
    """(..., 4) mean speed over the step [rad/s]."""
    mean_square: Array
    """(..., 4) mean of the squared speed over the step [(rad/s)^2]."""


def speed_command(thrust: Array, thrust_coefficient: float) -> Array:
    """Return the speeds (..., 4) [rad/s] that nominally give `thrust` (..., 4) >= 0 [N]."""
    xp = thrust.__array_namespace__()
    # A rotor at its lower limit is asked for zero or for what rounding left of it, where the
    # root's slope has no bound; gradients would drown in it.
    pushes = thrust > NEGLIGIBLE
    return xp.where(pushes, xp.sqrt(xp.where(pushes, thrust, 1.0) / thrust_coefficient), 0.0)


def follow(speed: Array, command: Array, time_constant: Array, dt: Array) -> RotorStep:
    """Return the rotors' step under dOmega/dt = (command - Omega) / time_constant.

    The thrust of a step is that of the mean square and not of the speed at one of its ends, so
    that lags far shorter than a step still count, to first order: a time constant of 0 follows
    at once, and the gradient with respect to it exists there.

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

    By the lag's own equation where it is longer than the step, so that a step of no length has a
    slope as well; else what changed over the step's length.

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
    """Return the step of rotors that hold `speed` (..., 4) [rad/s], as when it was measured."""
    return RotorStep(speed, speed, speed**2)


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
