"""Rotor dynamics: the speed follows its command after a delay, with a first-order response (lag).

If the delay is not a multiple of the step, a step's command is the weighted mean of two commands,
so the delay has a gradient. The diagnosis knows all commands in advance and uses means over its
steps instead (`suite/diagnose/evidence/rollout.py`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tracks.geometry.scene import Array

SHORT_S = 1e-4
"""Least step length by which a change of speed is divided [s]."""
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
    # Near zero thrust the root's slope is unbounded and would dominate all gradients.
    positive = thrust > NEGLIGIBLE
    return xp.where(positive, xp.sqrt(xp.where(positive, thrust, 1.0) / thrust_coefficient), 0.0)


def follow(speed: Array, command: Array, time_constant: Array, dt: Array) -> RotorStep:
    """Return the rotor speeds in a step, under dOmega/dt = (command - Omega) / time_constant.

    Thrust is computed from the mean square speed, so that time constants far shorter than a step
    still have an effect, to first order. With a time constant of 0 the speed equals the command,
    but the gradient with respect to the time constant exists.

    Args:
        speed: (..., 4) rotor speeds at the start of the step [rad/s].
        command: (..., 4) commanded speeds, constant during the step [rad/s].
        time_constant: (...,) time constant of the rotors [s].
        dt: length of the step [s].
    """
    xp = speed.__array_namespace__()
    time_constant = xp.asarray(time_constant)
    has_lag = time_constant > 0.0
    decay = xp.where(has_lag, xp.exp(-dt / xp.where(has_lag, time_constant, 1.0)), 0.0)
    steps = (time_constant / dt)[..., None]
    decay = decay[..., None]
    # Omega(t) = command + error exp(-t / time_constant); its means over the step are integrals.
    error = speed - command
    mean = command + error * steps * (1.0 - decay)
    mean_square = (
        command**2
        + 2.0 * command * error * steps * (1.0 - decay)
        + error**2 * 0.5 * steps * (1.0 - decay**2)
    )
    return RotorStep(command + error * decay, mean, mean_square)


def acceleration(
    start: Array, rotors: RotorStep, command: Array | None, time_constant: Array, dt: Array
) -> Array:
    """Return the mean rate of change of the rotor speeds (..., 4) over a step [rad/s^2].

    If the time constant is longer than the step, the equation of `follow` gives the rate, even for
    a step of zero length. Otherwise the rate is the change of speed divided by the step.

    Args:
        start: (..., 4) speeds at the start of the step [rad/s].
        rotors: the step.
        command: (..., 4) commanded speeds [rad/s]; None if the speeds are measured.
        time_constant: (...,) time constant of the rotors [s].
        dt: length of the step [s].
    """
    xp = start.__array_namespace__()
    quotient = (rotors.end - start) / xp.maximum(xp.asarray(dt), SHORT_S)
    if command is None:
        return quotient
    lag = xp.asarray(time_constant)[..., None]
    is_slow = lag > dt
    slope = (command - 0.5 * (start + rotors.end)) / xp.where(is_slow, lag, 1.0)
    return xp.where(is_slow, slope, quotient)


def steady(speed: Array) -> RotorStep:
    """Return the step of rotors with a constant, such as a measured, speed (..., 4) [rad/s]."""
    return RotorStep(speed, speed, speed**2)


def whole_steps(delay: Array, dt: Any) -> tuple[Array, Array]:
    """Return `delay` (...,) [s] as whole steps of `dt` [s] and the remaining share of a step."""
    steps = delay / dt
    # With rounding, 0.043 / 0.001 may be a little less than 43.
    full = steps.__array_namespace__().floor(steps + 1e-9)
    return full, steps - full


def delay_weight(delay: Array, dt: float, max_delay: float) -> Array:
    """Return the weights (..., L) of the stored commands in the delayed command, newest first.

    Args:
        delay: (...,) delay of the commands [s].
        dt: length of a step [s].
        max_delay: longest delay [s], which determines the number L of stored commands; 0: L = 0.
    """
    xp = delay.__array_namespace__()
    length = math.ceil(max_delay / dt - 1e-9) + 1 if max_delay > 0.0 else 0
    age = np.arange(length)
    full, fraction = (steps[..., None] for steps in whole_steps(delay, dt))
    return xp.where(age == full, 1.0 - fraction, 0.0) + xp.where(age == full + 1.0, fraction, 0.0)


def delayed(weight: Array, past: Array, command: Array) -> tuple[Array, Array]:
    """Store a command; return the stored commands (..., C, L) and the delayed command (..., C).

    Args:
        weight: (..., L) weights from `delay_weight`, L > 0.
        past: (..., C, L) commands of the previous steps, newest first.
        command: (..., C) command of this step.
    """
    xp = command.__array_namespace__()
    past = xp.concatenate([command[..., None], past[..., :-1]], axis=-1)
    return past, xp.matmul(past, xp.asarray(weight)[..., :, None])[..., 0]
