"""Low-pass filters of the firmwares' rate loops, and the mixer's signs from the rotors.

The filters are discrete, for numpy and JAX; a cutoff of 0 disables a filter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eval.vehicles.vehicle import Rotors
from tracks.geometry.scene import Array

PT3_SCALE = 1.961459177
"""Three equal first-order filters have -3 dB together where each has this many times the cutoff:
1 / sqrt(2^(1/3) - 1)."""


class Pair(NamedTuple):
    """State of a second-order filter."""

    first: Array
    second: Array


def pt1(before: Array, value: Array, cutoff_hz: Array, dt: Array) -> Array:
    """Return a first-order low pass of `value` after its output `before`.

    `y += k (x - y)` with `k = dt / (dt + 1 / (2 pi f))`: the backward Euler step of a RC filter.
    """
    xp = value.__array_namespace__()
    on = cutoff_hz > 0.0
    turn = 2.0 * xp.pi * xp.where(on, cutoff_hz, 1.0) * dt
    return before + xp.where(on, turn / (1.0 + turn), 1.0) * (value - before)


def butterworth(memory: Pair, value: Array, cutoff_hz: Array, dt: Array) -> tuple[Pair, Array]:
    """Return the state and the output of a second-order Butterworth low pass (bilinear).

    `H(s) = 1 / (s^2 + sqrt(2) s + 1)` with the cutoff prewarped to `tan(pi f dt)`; at a cutoff of
    half the sampling rate or more, or 0, it passes all.
    """
    xp = value.__array_namespace__()
    on = (cutoff_hz > 0.0) & (cutoff_hz * dt < 0.5)
    warped = xp.tan(xp.pi * xp.where(on, cutoff_hz * dt, 0.25))
    below = 1.0 + 2.0**0.5 * warped + warped**2
    gain = warped**2 / below
    back_one = 2.0 * (warped**2 - 1.0) / below
    back_two = (1.0 - 2.0**0.5 * warped + warped**2) / below
    now = value - back_one * memory.first - back_two * memory.second
    out = gain * (now + 2.0 * memory.first + memory.second)
    return Pair(now, memory.first), xp.where(on, out, value)


def settled(value: Array, cutoff_hz: Array, dt: Array) -> Pair:
    """Return the state of `butterworth` after a long constant input `value`."""
    xp = value.__array_namespace__()
    on = (cutoff_hz > 0.0) & (cutoff_hz * dt < 0.5)
    warped = xp.tan(xp.pi * xp.where(on, cutoff_hz * dt, 0.25))
    below = 1.0 + 2.0**0.5 * warped + warped**2
    # At rest w (1 + a1 + a2) = x, and the sum is 4 tan^2 / below.
    rest = value * below / (4.0 * warped**2)
    return Pair(rest, rest)


def pick(fresh: Array, then: Any, otherwise: Any) -> Any:
    """Return `then` where `fresh` (...,) is 0, else `otherwise`, for arrays (..., 3)."""
    xp = fresh.__array_namespace__()
    return xp.where(fresh[..., None] == 0.0, then, otherwise)


class Layout(NamedTuple):
    """Shares (4,) of each motor, up to 1, in roll, pitch and yaw torque (FLU)."""

    roll: Array
    pitch: Array
    yaw: Array


def layout_of(rotors: Rotors) -> Layout:
    """Return the layout of `rotors`: arms divided by the longest arm, and minus the spin."""
    x, y, _ = np.asarray(rotors.position, dtype=float).T
    spin = np.asarray(rotors.spin, dtype=float)
    return Layout(y / np.max(np.abs(y)), -x / np.max(np.abs(x)), -spin)
