"""Betaflight's rate loop: PID on body rates, feed-forward, and its mixer in airmode.

Errors e are in deg/s, outputs in thousandths of a motor's range:

    P = 0.032029 p e,  I += 0.244381 i e dt,  D = -0.000529 d d(rate)/dt,
    F = 0.00013754 f d(setpoint)/dt;  motor = throttle + sum / 1000

The gain i of yaw is multiplied by 2.5, as in the firmware without `use_integrated_yaw`. Gyro,
derivative and set point pass first-order filters. The integral grows more slowly while the set
point changes fast or the motors are near their limits, and it is limited, as is the sum. If the
differences between motors exceed their range, they are scaled down, and the throttle is shifted so
that all commands fit (airmode). Not modelled: dynamic notches and RPM filters (vibration is not
simulated), D max, anti gravity and thrust linearisation. Source: Betaflight's documentation and
wiki (PID tuning guides of 4.2 to 4.5, CLI reference).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.loops.filters import PT3_SCALE, Layout, Request, pick, pt1
from eval.quadrotor.mixer import largest, least
from tracks.geometry.scene import Array

GROUP = ""
"""Name of the settings' table under `[controller]`; "": they are in `[controller]` itself."""
DEG = float(180.0 / np.pi)
"""Degrees in a radian."""
P_UNIT, I_UNIT, D_UNIT, F_UNIT = 0.032029, 0.244381, 0.000529, 0.00013754
"""Value of one unit of the firmware's gains p, i, d and f, in thousandths of a motor's range per
deg/s (p), deg (i) or deg/s^2 (d, f)."""
YAW_I = 2.5
"""The firmware's factor on the gain i of yaw."""
SUM = 1000.0
"""Value of an output that is a motor's full range."""
LIMITS = {
    "iterm_windup": (0.0, 100.0),
    "tpa_rate": (0.0, 100.0),
    "tpa_breakpoint": (1000.0, 2000.0),
    "dshot_idle_value": (0.0, 2000.0),
}
"""Allowed ranges of settings; the others must be 0 or more."""
RELAXED = 40.0
"""Difference between the set point and its low-passed value that stops the integral [deg/s]."""


@dataclass(frozen=True)
class Settings:
    """Keys in `[controller]`, named and scaled as in Betaflight's CLI."""

    p_roll: float = 45.0
    i_roll: float = 80.0
    d_roll: float = 30.0
    f_roll: float = 120.0
    p_pitch: float = 47.0
    i_pitch: float = 84.0
    d_pitch: float = 34.0
    f_pitch: float = 125.0
    p_yaw: float = 45.0
    i_yaw: float = 80.0
    d_yaw: float = 0.0
    f_yaw: float = 120.0
    gyro_lpf1_static_hz: float = 250.0
    """Cutoff of a first-order filter of the gyro [Hz]; 0: off; also for the next five settings."""
    gyro_lpf2_static_hz: float = 500.0
    dterm_lpf1_static_hz: float = 75.0
    dterm_lpf2_static_hz: float = 150.0
    yaw_lowpass_hz: float = 100.0
    rc_smoothing_setpoint_cutoff: float = 30.0
    """Cutoff of the third-order filter of the set point [Hz]."""
    iterm_limit: float = 400.0
    iterm_windup: float = 85.0
    """Share of the motors' range above which the integral grows more slowly [%]; 100: off."""
    iterm_relax_cutoff: float = 15.0
    """Cutoff of the set point's low pass for I-term relax [Hz]; 0: off."""
    pidsum_limit: float = 500.0
    pidsum_limit_yaw: float = 400.0
    tpa_rate: float = 65.0
    """Reduction of D at full throttle [%]."""
    tpa_breakpoint: float = 1350.0
    """Throttle at which the reduction begins, 1000 to 2000."""
    dshot_idle_value: float = 550.0
    """Motor command at zero throttle [0.01 %]."""


class Gains(NamedTuple):
    """The loop's constants as arrays (3,), or scalars."""

    p: Array
    i: Array
    d: Array
    f: Array
    limit: Array
    """(3,) limits of the sum of all terms."""
    gyro_hz: Array
    """(2,) cutoffs of the gyro's filters [Hz]."""
    dterm_hz: Array
    """(2,) cutoffs of the derivative's filters [Hz]."""
    yaw_hz: Array
    setpoint_hz: Array
    i_limit: Array
    windup: Array
    relax_hz: Array
    relaxed: Array
    """(3,) 1 for axes with I-term relax, else 0."""
    tpa: Array
    """(2,) reduction of D at full throttle, and the throttle where it begins."""
    idle: Array
    layout: Layout


class State(NamedTuple):
    """State of the loop between updates."""

    started: Array
    """(...,) 0 before the first update, then 1."""
    gyro: Array
    """(..., 2, 3) outputs of the gyro's filters [deg/s]."""
    dterm: Array
    """(..., 2, 3) outputs of the derivative's filters [deg/s]."""
    setpoint: Array
    """(..., 3, 3) outputs of the set point's filters [deg/s]."""
    slow: Array
    """(..., 3) low-passed set point, for I-term relax [deg/s]."""
    integral: Array
    """(..., 3) the term I, in thousandths of a motor's range."""
    yaw: Array
    """(..., 1) filtered term P of yaw."""
    span: Array
    """(...,) largest difference between motors at the last update, before scaling."""


def gains(settings: Settings, layout: Layout) -> Gains:
    """Return the constants of `settings` as arrays."""

    def each(key: str, unit: float) -> np.ndarray:
        values = [getattr(settings, f"{key}_{axis}") for axis in ("roll", "pitch", "yaw")]
        return unit * np.array(values)

    s = settings
    relaxes = 1.0 if s.iterm_relax_cutoff > 0.0 else 0.0
    return Gains(
        p=each("p", P_UNIT),
        i=each("i", I_UNIT) * (1.0, 1.0, YAW_I),
        d=each("d", D_UNIT),
        f=each("f", F_UNIT),
        limit=np.array([s.pidsum_limit, s.pidsum_limit, s.pidsum_limit_yaw]),
        gyro_hz=np.array([s.gyro_lpf1_static_hz, s.gyro_lpf2_static_hz]),
        dterm_hz=np.array([s.dterm_lpf1_static_hz, s.dterm_lpf2_static_hz]),
        yaw_hz=np.asarray(s.yaw_lowpass_hz),
        setpoint_hz=np.asarray(PT3_SCALE * s.rc_smoothing_setpoint_cutoff),
        i_limit=np.asarray(s.iterm_limit),
        windup=np.asarray(0.01 * s.iterm_windup),
        relax_hz=np.asarray(s.iterm_relax_cutoff),
        relaxed=np.array([relaxes, relaxes, 0.0]),
        tpa=np.array([0.01 * s.tpa_rate, 0.001 * (s.tpa_breakpoint - 1000.0)]),
        idle=np.asarray(1e-4 * s.dshot_idle_value),
        layout=layout,
    )


def start(shape: tuple[int, ...], xp: Any) -> State:
    """Return the state of loops with the batch shape `shape` before the first update."""
    scalar, vector = xp.zeros(shape), xp.zeros((*shape, 3))
    two, three = xp.zeros((*shape, 2, 3)), xp.zeros((*shape, 3, 3))
    return State(scalar, two, two, three, vector, vector, xp.zeros((*shape, 1)), scalar)


def update(gain: Gains, state: State, request: Request) -> tuple[State, Array]:
    """Return the state after an update and the motor commands (..., 4) from 0 to 1."""
    throttle, rate_cmd_b, rate_b, dt, scale = request
    xp = rate_b.__array_namespace__()
    started = state.started
    gyro = _chain(started, state.gyro, DEG * rate_b, gain.gyro_hz, dt)
    rate = gyro[..., -1, :]
    dterm = _chain(started, state.dterm, rate, gain.dterm_hz, dt)
    slope = (dterm[..., -1, :] - pick(started, dterm[..., -1, :], state.dterm[..., -1, :])) / dt
    cutoffs = xp.stack([gain.setpoint_hz] * 3)
    setpoints = _chain(started, state.setpoint, DEG * rate_cmd_b, cutoffs, dt)
    setpoint = setpoints[..., -1, :]
    change = (setpoint - pick(started, setpoint, state.setpoint[..., -1, :])) / dt
    error = setpoint - rate

    # The integral grows more slowly while the set point changes, and near the motors' limits.
    slow = pt1(pick(started, setpoint, state.slow), setpoint, gain.relax_hz, dt)
    relax = xp.maximum(1.0 - gain.relaxed * xp.abs(setpoint - slow) / RELAXED, 0.0)
    has_windup = gain.windup < 1.0
    margin = (1.0 - state.span) / xp.where(has_windup, 1.0 - gain.windup, 1.0)
    margin = xp.where(has_windup, xp.clip(margin, 0.0, 1.0), 1.0)
    integral = state.integral + gain.i * relax * margin[..., None] * error * dt
    integral = xp.clip(integral, -gain.i_limit, gain.i_limit)

    # The terms P, I, D and F, and their sum.
    p = gain.p * error
    yaw = pt1(pick(started, p[..., 2:], state.yaw), p[..., 2:], gain.yaw_hz, dt)
    p = xp.concatenate([p[..., :2], yaw], axis=-1)
    throttle = (throttle - gain.idle) / (1.0 - gain.idle)
    above_breakpoint = xp.clip(
        (throttle - gain.tpa[1]) / xp.maximum(1.0 - gain.tpa[1], 1e-6), 0.0, 1.0
    )
    d = -gain.d * (1.0 - gain.tpa[0] * above_breakpoint)[..., None] * slope
    total = xp.clip(scale * (p + integral + d + gain.f * change), -gain.limit, gain.limit)
    span, command = mixed(gain, throttle, total / SUM)
    state = State(xp.ones_like(started), gyro, dterm, setpoints, slow, integral, yaw, span)
    return state, command


def mixed(gain: Gains, throttle: Array, torque: Array) -> tuple[Array, Array]:
    """Return the largest difference between motors (...,), and the motor commands (..., 4).

    `throttle` (...,) is from 0 (idle) to 1; `torque` (..., 3) are roll, pitch and yaw sums,
    relative to a motor's range.
    """
    xp = torque.__array_namespace__()
    roll, pitch, yaw = gain.layout
    per_motor = torque[..., 0, None] * roll + torque[..., 1, None] * pitch
    per_motor = per_motor + torque[..., 2, None] * yaw
    low, high = least(per_motor), largest(per_motor)
    span = high - low
    divisor = xp.maximum(span, 1.0)
    throttle = xp.minimum(xp.maximum(throttle, -low / divisor), 1.0 - high / divisor)
    command = xp.clip(throttle[..., None] + per_motor / divisor[..., None], 0.0, 1.0)
    return span, gain.idle + (1.0 - gain.idle) * command


def _chain(started: Array, before: Array, value: Array, cutoffs_hz: Array, dt: Array) -> Array:
    """Return the outputs (..., K, 3) of K first-order filters in series.

    Before the first update (`started` is 0) the filters start at their input.
    """
    xp = value.__array_namespace__()
    outputs = []
    for k in range(before.shape[-2]):
        value = pt1(pick(started, value, before[..., k, :]), value, cutoffs_hz[k], dt)
        outputs.append(value)
    return xp.stack(outputs, axis=-2)
