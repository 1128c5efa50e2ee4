"""The Crazyflie's rate loop: PID on body rates in deg/s, and its distribution of power to motors.

    out = kp e + ki integral(e) + kd (-d rate/dt) + kff setpoint, limited to 16 bits
    motor = thrust -+ roll/2 -+ pitch/2 -+ yaw, all in 1/65535 of a motor's full command

If a motor would exceed its full command, all motors are reduced equally. Not modelled: at a thrust
of exactly 0, the firmware stops all motors and resets its integrals. Source: Bitcraze's
documentation of the firmware ("Controllers", "PID tuning", parameter group `pid_rate`), with its
values for the Crazyflie 2.x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.loops.filters import Layout, Pair, Request, butterworth, pick
from eval.quadrotor.mixer import largest
from tracks.geometry.scene import Array

DEG = float(180.0 / np.pi)
"""Degrees in a radian."""
FULL = 65535.0
"""A motor's full command in the firmware, an unsigned number of 16 bits."""
SIGNED = 32767.0
"""Largest output of the PID in the firmware, a signed number of 16 bits."""
GROUP = "pid_rate"
"""Name of the settings' table under `[controller]`."""
LIMITS: dict[str, tuple[float, float]] = {}
"""Allowed ranges of settings; the others must be 0 or more."""


@dataclass(frozen=True)
class Settings:
    """Keys in `[controller.pid_rate]`, named and scaled as the firmware's parameters."""

    roll_kp: float = 250.0
    roll_ki: float = 500.0
    roll_kd: float = 2.5
    roll_kff: float = 0.0
    pitch_kp: float = 250.0
    pitch_ki: float = 500.0
    pitch_kd: float = 2.5
    pitch_kff: float = 0.0
    yaw_kp: float = 120.0
    yaw_ki: float = 16.7
    yaw_kd: float = 0.0
    yaw_kff: float = 0.0
    roll_ilimit: float = 33.3
    """Largest integral of the error [deg]; 0: no limit. It is a constant in the firmware."""
    pitch_ilimit: float = 33.3
    yaw_ilimit: float = 166.7
    lpf_cutoff: float = 0.0
    """Cutoff of the derivative's second-order filter [Hz]; 0: off, as in the firmware."""


class Gains(NamedTuple):
    """The loop's constants as arrays (3,)."""

    p: Array
    i: Array
    d: Array
    f: Array
    i_limit: Array
    cutoff_hz: Array
    layout: Layout


class State(NamedTuple):
    """State of the loop between updates."""

    started: Array
    """(...,) 0 before the first update, then 1."""
    integral: Array
    """(..., 3) integral of the error [deg]."""
    rate: Array
    """(..., 3) body rates at the last update [deg/s]."""
    slope: Pair
    """(..., 3) state of the derivative's filter."""


def gains(settings: Settings, layout: Layout) -> Gains:
    """Return the constants of `settings` as arrays."""

    def each(key: str) -> np.ndarray:
        return np.array([getattr(settings, f"{axis}_{key}") for axis in ("roll", "pitch", "yaw")])

    limit = each("ilimit")
    return Gains(
        *(each(key) for key in ("kp", "ki", "kd", "kff")),
        i_limit=np.where(limit > 0.0, limit, np.inf),
        cutoff_hz=np.asarray(settings.lpf_cutoff),
        layout=layout,
    )


def start(shape: tuple[int, ...], xp: Any) -> State:
    """Return the state of loops with the batch shape `shape` before the first update."""
    zeros = xp.zeros((*shape, 3))
    return State(xp.zeros(shape), zeros, zeros, Pair(zeros, zeros))


def update(gain: Gains, state: State, request: Request) -> tuple[State, Array]:
    """Return the state after an update and the motor commands (..., 4) from 0 to 1."""
    throttle, rate_cmd_b, rate_b, dt, scale = request
    xp = rate_b.__array_namespace__()
    setpoint, rate = DEG * rate_cmd_b, DEG * rate_b
    error = setpoint - rate
    previous = pick(state.started, rate, state.rate)
    unfiltered = -(rate - previous) / dt
    slope, derivative = butterworth(state.slope, unfiltered, gain.cutoff_hz, dt)
    integral = xp.clip(state.integral + error * dt, -gain.i_limit, gain.i_limit)
    out = gain.p * error + gain.i * integral + gain.d * derivative + gain.f * setpoint
    out = xp.clip(scale * out, -SIGNED, SIGNED)
    motor = throttle[..., None] * FULL + motor_shares(gain.layout, out)
    excess = xp.maximum(largest(motor) - FULL, 0.0)
    command = xp.clip((motor - excess[..., None]) / FULL, 0.0, 1.0)
    return State(xp.ones_like(state.started), integral, rate, slope), command


def motor_shares(layout: Layout, out: Array) -> Array:
    """Return the contributions (..., 4) of outputs (..., 3) to the motors.

    Roll and pitch are halved, as in the firmware.
    """
    roll_and_pitch = 0.5 * (out[..., 0, None] * layout.roll + out[..., 1, None] * layout.pitch)
    return roll_and_pitch + out[..., 2, None] * layout.yaw
