"""Low-pass filters of the firmwares' rate loops, and the mixer's layout of the rotors.

The filters are discrete, and take numpy and JAX arrays; a cutoff of 0 disables a filter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eval.vehicles.vehicle import Rotors
from tracks.geometry.scene import Array

PT3_SCALE = 1.961459177
"""Ratio of the cutoff of each of three equal first-order filters to that of all three in series:
1 / sqrt(2^(1/3) - 1)."""


class Request(NamedTuple):
    """Inputs of an update of a firmware's rate loop."""

    throttle: Array
    """(...,) motor command without roll, pitch and yaw, from 0 to 1."""
    rate_cmd_b: Array
    """(..., 3) commanded body rates [rad/s]."""
    rate_b: Array
    """(..., 3) current body rates [rad/s]."""
    dt: Array
    """Time since the last update [s], a number or (..., 1)."""
    scale: Array
    """(..., 3) factor on the outputs, by the effect `rate_gain`."""


class Pair(NamedTuple):
    """State of a second-order filter in direct form II: its last two inner values."""

    first: Array
    """The last inner value."""
    second: Array
    """The inner value before the last."""


def pt1(before: Array, value: Array, cutoff_hz: Array, dt: Array) -> Array:
    """Return the next output of a first-order low pass, by the backward Euler step.

    `y += k (x - y)` with `k = dt / (dt + 1 / (2 pi f))`. Here y is `before`, x is `value` and f is
    `cutoff_hz` [Hz], where 0 returns x. The last output is `dt` old [s].
    """
    xp = value.__array_namespace__()
    enabled = cutoff_hz > 0.0
    phase = 2.0 * xp.pi * xp.where(enabled, cutoff_hz, 1.0) * dt
    return before + xp.where(enabled, phase / (1.0 + phase), 1.0) * (value - before)


def butterworth(memory: Pair, value: Array, cutoff_hz: Array, dt: Array) -> tuple[Pair, Array]:
    """Return the state and the output of a second-order Butterworth low pass (bilinear).

    `H(s) = 1 / (s^2 + sqrt(2) s + 1)` with the cutoff prewarped to `tan(pi f dt)`. For a cutoff of
    0, or of half the sampling rate or more, the output is the input. f is `cutoff_hz` [Hz], and
    inputs are `dt` apart [s].
    """
    xp = value.__array_namespace__()
    enabled, warped, a0 = _prewarped(xp, cutoff_hz, dt)
    # Coefficients of the transfer function in z, divided by a0.
    gain = warped**2 / a0
    a1 = 2.0 * (warped**2 - 1.0) / a0
    a2 = (1.0 - 2.0**0.5 * warped + warped**2) / a0
    inner = value - a1 * memory.first - a2 * memory.second
    out = gain * (inner + 2.0 * memory.first + memory.second)
    return Pair(inner, memory.first), xp.where(enabled, out, value)


def _prewarped(xp: Any, cutoff_hz: Array, dt: Array) -> tuple[Array, Array, Array]:
    """Return whether `butterworth` is enabled, its prewarped cutoff, and its coefficient a0."""
    enabled = (cutoff_hz > 0.0) & (cutoff_hz * dt < 0.5)
    warped = xp.tan(xp.pi * xp.where(enabled, cutoff_hz * dt, 0.25))
    return enabled, warped, 1.0 + 2.0**0.5 * warped + warped**2


def settled(value: Array, cutoff_hz: Array, dt: Array) -> Pair:
    """Return the state of `butterworth` after a long time with the constant input `value`."""
    _, warped, a0 = _prewarped(value.__array_namespace__(), cutoff_hz, dt)
    # In equilibrium inner (1 + a1 + a2) = value, and the sum is 4 warped^2 / a0.
    inner = value * a0 / (4.0 * warped**2)
    return Pair(inner, inner)


def pick(started: Array, initial: Any, running: Any) -> Any:
    """Return `initial` where `started` (...,) is 0, else `running`, for arrays (..., 3)."""
    xp = started.__array_namespace__()
    return xp.where(started[..., None] == 0.0, initial, running)


class Layout(NamedTuple):
    """Contribution (4,) of each motor, -1 to 1, to roll, pitch and yaw torque (FLU axes)."""

    roll: Array
    pitch: Array
    yaw: Array


def layout_of(rotors: Rotors) -> Layout:
    """Return the layout of `rotors`: lever arms divided by the longest, and the negative spin."""
    x, y, _ = np.asarray(rotors.position, dtype=float).T
    spin = np.asarray(rotors.spin, dtype=float)
    return Layout(y / np.max(np.abs(y)), -x / np.max(np.abs(x)), -spin)
