"""PX4's rate loop: PID on body rates in rad/s, and its sequential control allocation.

    torque = K (P e + I-term - D accel) + FF setpoint
    I-term += I e (1 - (e / 400 deg/s)^2) dt, within MC_xR_INT_LIM, not further into saturation

Torques are normalised. The gyro passes a second-order low pass; `accel` is its derivative, which
passes a first-order low pass (as in PX4's source since 2021; the parameter reference says second).
A motor command is thrust plus 0.707 of roll and pitch plus yaw. If motors saturate, thrust is
reduced first, then roll and pitch. Yaw is added next, up to 15 % above full command; it is reduced
where it saturates, and then thrust once more (airmode off). Source: PX4's user guide ("Multicopter
PID Tuning Guide", "Control Allocation", the parameter reference MC_*, IMU_*, THR_MDL_FAC).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.loops.filters import Layout, Pair, Request, butterworth, pick, pt1, settled
from eval.quadrotor.mixer import largest, least
from tracks.geometry.scene import Array

GROUP = ""
"""Name of the settings' table under `[controller]`; "": they are in `[controller]` itself."""
FAST = float(np.deg2rad(400.0))
"""Errors larger than this do not change the integral [rad/s]."""
YAW_ROOM = 0.15
"""Excess over full command that is allowed while yaw is added."""
SMALL = 1e-6
"""Torques below this count as zero."""
WEAK = 0.2
"""Motors with a smaller contribution to an axis do not limit it."""
LIMITS = {"THR_MDL_FAC": (0.0, 1.0)}
"""Allowed ranges of settings; the others must be 0 or more."""


@dataclass(frozen=True)
class Settings:
    """Keys in `[controller]`, named and scaled as the firmware's parameters."""

    MC_ROLLRATE_K: float = 1.0
    MC_ROLLRATE_P: float = 0.15
    MC_ROLLRATE_I: float = 0.2
    MC_ROLLRATE_D: float = 0.003
    MC_ROLLRATE_FF: float = 0.0
    MC_RR_INT_LIM: float = 0.3
    MC_PITCHRATE_K: float = 1.0
    MC_PITCHRATE_P: float = 0.15
    MC_PITCHRATE_I: float = 0.2
    MC_PITCHRATE_D: float = 0.003
    MC_PITCHRATE_FF: float = 0.0
    MC_PR_INT_LIM: float = 0.3
    MC_YAWRATE_K: float = 1.0
    MC_YAWRATE_P: float = 0.2
    MC_YAWRATE_I: float = 0.1
    MC_YAWRATE_D: float = 0.0
    MC_YAWRATE_FF: float = 0.0
    MC_YR_INT_LIM: float = 0.3
    MC_YAW_TQ_CUTOFF: float = 0.0
    """Cutoff of the yaw torque's first-order filter [Hz]; 0: off, as before v1.15."""
    IMU_GYRO_CUTOFF: float = 40.0
    """Cutoff of the gyro's second-order filter [Hz]; 0: off."""
    IMU_DGYRO_CUTOFF: float = 30.0
    """Cutoff of the first-order filter of the gyro's derivative [Hz]; 0: off."""
    THR_MDL_FAC: float = 0.0
    """FAC in the relative thrust FAC u^2 + (1 - FAC) u of the motor command u."""


class Gains(NamedTuple):
    """The loop's constants as arrays (3,), or scalars."""

    k: Array
    p: Array
    i: Array
    d: Array
    f: Array
    i_limit: Array
    yaw_cutoff_hz: Array
    gyro_cutoff_hz: Array
    slope_cutoff_hz: Array
    model: Array
    layout: Layout
    unmixer: Array
    """(3, 4) matrix from the motors' relative thrusts to the normalised torque."""


class State(NamedTuple):
    """State of the loop between updates."""

    started: Array
    """(...,) 0 before the first update, then 1."""
    integral: Array
    """(..., 3) the I-term, a normalised torque."""
    rate: Array
    """(..., 3) filtered body rates at the last update [rad/s]."""
    gyro: Pair
    """(..., 3) state of the gyro's filter."""
    accel: Array
    """(..., 3) filtered derivative of the filtered rates [rad/s^2]."""
    yaw: Array
    """(..., 1) filtered yaw torque."""
    lost: Array
    """(..., 3) commanded torque minus the torque that the motors could produce, last update."""


def gains(settings: Settings, layout: Layout) -> Gains:
    """Return the constants of `settings` as arrays."""

    def each(key: str) -> np.ndarray:
        return np.array(
            [getattr(settings, f"MC_{axis}RATE_{key}") for axis in ("ROLL", "PITCH", "YAW")]
        )

    limits = [settings.MC_RR_INT_LIM, settings.MC_PR_INT_LIM, settings.MC_YR_INT_LIM]
    return Gains(
        *(each(key) for key in ("K", "P", "I", "D", "FF")),
        i_limit=np.array(limits),
        yaw_cutoff_hz=np.asarray(settings.MC_YAW_TQ_CUTOFF),
        gyro_cutoff_hz=np.asarray(settings.IMU_GYRO_CUTOFF),
        slope_cutoff_hz=np.asarray(settings.IMU_DGYRO_CUTOFF),
        model=np.asarray(settings.THR_MDL_FAC),
        layout=layout,
        # With all four columns, since on unequal arms a pure thrust also causes roll and pitch.
        unmixer=np.linalg.inv(np.stack([np.ones(4), *columns(layout)], axis=-1))[1:],
    )


def start(shape: tuple[int, ...], xp: Any) -> State:
    """Return the state of loops with the batch shape `shape` before the first update."""
    zeros = xp.zeros((*shape, 3))
    gyro = Pair(zeros, zeros)
    return State(xp.zeros(shape), zeros, zeros, gyro, zeros, xp.zeros((*shape, 1)), zeros)


def update(gain: Gains, state: State, request: Request) -> tuple[State, Array]:
    """Return the state after an update and the motor commands (..., 4) from 0 to 1."""
    throttle, rate_cmd_b, rate_b, dt, scale = request
    xp = rate_b.__array_namespace__()
    initial = settled(rate_b, gain.gyro_cutoff_hz, dt)
    gyro = Pair(*(pick(state.started, a, b) for a, b in zip(initial, state.gyro, strict=True)))
    gyro, rate = butterworth(gyro, rate_b, gain.gyro_cutoff_hz, dt)
    previous = pick(state.started, rate, state.rate)
    accel = _low_pass(state.accel, (rate - previous) / dt, gain.slope_cutoff_hz, dt)
    error = rate_cmd_b - rate
    torque = gain.k * (gain.p * error - gain.d * accel) + state.integral + gain.f * rate_cmd_b
    torque = scale * torque
    # The torque uses the previous integral, which is updated afterwards.
    unsaturated_error = xp.where(state.lost * error > 0.0, 0.0, error)
    integral_factor = xp.maximum(1.0 - (error / FAST) ** 2, 0.0)
    # As in the firmware, the integral contains K, so its limit is a torque.
    integral = state.integral + integral_factor * gain.k * gain.i * unsaturated_error * dt
    integral = xp.clip(integral, -gain.i_limit, gain.i_limit)
    wanted_yaw = torque[..., 2:]
    yaw = _low_pass(pick(state.started, wanted_yaw, state.yaw), wanted_yaw, gain.yaw_cutoff_hz, dt)
    torque = xp.concatenate([torque[..., :2], yaw], axis=-1)
    thrust = gain.model * throttle**2 + (1.0 - gain.model) * throttle
    motor_thrust = xp.clip(allocate(gain.layout, thrust, torque), 0.0, 1.0)
    lost = torque - (motor_thrust[..., None, :] * gain.unmixer).sum(axis=-1)
    lost = xp.where(xp.abs(lost) > SMALL, lost, 0.0)
    state = State(xp.ones_like(state.started), integral, rate, gyro, accel, yaw, lost)
    return state, signal(gain.model, motor_thrust)


def columns(layout: Layout) -> tuple[Array, Array, Array]:
    """Return each motor's relative thrust (4,) for a unit of roll, of pitch and of yaw torque."""
    root = 2.0**-0.5
    return root * layout.roll, root * layout.pitch, layout.yaw


def allocate(layout: Layout, thrust: Array, torque: Array) -> Array:
    """Return relative motor thrusts (..., 4), within [0, 1] as far as possible.

    `thrust` (...,) is the relative collective thrust, `torque` (..., 3) is normalised.
    """
    xp = torque.__array_namespace__()
    roll, pitch, yaw = columns(layout)
    down = -xp.ones(4)
    motor = thrust[..., None] + torque[..., 0, None] * roll + torque[..., 1, None] * pitch
    motor = _fit_into_range(motor, down, 1.0, only_more=True)
    motor = _fit_into_range(_fit_into_range(motor, roll, 1.0), pitch, 1.0)
    motor = motor + torque[..., 2, None] * yaw
    motor = _fit_into_range(motor, yaw, 1.0 + YAW_ROOM)
    return _fit_into_range(motor, down, 1.0, only_more=True)


def signal(model: Array, thrust: Array) -> Array:
    """Return the motor commands that give relative `thrust` (..., 4) from 0 to 1."""
    xp = thrust.__array_namespace__()
    linear = 1.0 - model
    root = xp.sqrt(xp.maximum(linear**2 + 4.0 * model * thrust, SMALL**2))
    return 2.0 * thrust / (linear + root)


def _low_pass(before: Array, value: Array, cutoff_hz: Array, dt: Array) -> Array:
    """Return the output of `pt1`; as in PX4, a cutoff from half the sampling rate disables it."""
    xp = value.__array_namespace__()
    return pt1(before, value, xp.where(cutoff_hz * dt < 0.5, cutoff_hz, 0.0), dt)


def _fit_into_range(motor: Array, along: Array, top: float, only_more: bool = False) -> Array:
    """Return the motors shifted along a vector so that they fit into [0, top] as far as possible.

    A second shift, by half, balances the motors that exceed the lower and the upper limit.

    Args:
        motor: (..., 4) relative thrusts of the motors.
        along: (4,) direction of the shift.
        top: upper limit of a motor's relative thrust.
        only_more: allow only shifts in the direction of `along`.
    """
    xp = motor.__array_namespace__()
    gain = _shift_into_range(motor, along, top)
    if only_more:
        gain = xp.where(gain > 0.0, gain, 0.0)
        unshifted = gain == 0.0
    else:
        unshifted = xp.zeros_like(gain, dtype=bool)
    shifted = motor + gain[..., None] * along
    half = xp.where(unshifted, 0.0, 0.5 * _shift_into_range(shifted, along, top))
    return shifted + half[..., None] * along


def _shift_into_range(motor: Array, along: Array, top: float) -> Array:
    """Return the factor (...,) on `along` that brings the motors that it affects into [0, top]."""
    xp = motor.__array_namespace__()
    affected = xp.abs(along) >= WEAK
    slope = xp.where(affected, along, 1.0)
    below = xp.where(motor < 0.0, -motor / slope, 0.0)
    above = xp.where(motor > top, (top - motor) / slope, 0.0)
    factor = xp.where(affected, below + above, 0.0)
    return xp.minimum(least(factor), 0.0) + xp.maximum(largest(factor), 0.0)
