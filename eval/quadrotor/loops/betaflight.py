"""Betaflight's rate loop: PID on deg/s in its units of a thousandth, feed-forward, airmode mixer.

    P = 0.032029 p e,  I += 0.244381 i e dt,  D = -0.000529 d d(rate)/dt,
    F = 0.00013754 f d(setpoint)/dt;  motor = throttle + sum / 1000

where yaw's i counts 2.5 times, as in the firmware without `use_integrated_yaw`. Gyro, derivative
and set point pass their first-order filters; the integral is relaxed by fast set points and near
full motors, and limited; so is the sum. Where the motors' range is more than 1 it is scaled to 1,
and the throttle is moved so that all fit (airmode). Left out: dynamic notches and RPM filters
(which meet vibration that is not simulated), D max, anti gravity, thrust linearisation.
Source: Betaflight's documentation and wiki (PID tuning guides of 4.2 to 4.5, CLI reference).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.loops.filters import PT3_SCALE, Layout, pick, pt1
from eval.quadrotor.mixer import largest, least
from tracks.geometry.scene import Array

GROUP = ""
DEG = float(180.0 / np.pi)
P_UNIT, I_UNIT, D_UNIT, F_UNIT = 0.032029, 0.244381, 0.000529, 0.00013754
"""One unit of p, i, d and f, in thousandths of a motor's range per deg/s, deg or deg/s^2."""
YAW_I = 2.5
"""The firmware's factor on yaw's i."""
SUM = 1000.0
LIMITS = {
    "iterm_windup": (0.0, 100.0),
    "tpa_rate": (0.0, 100.0),
    "tpa_breakpoint": (1000.0, 2000.0),
    "dshot_idle_value": (0.0, 2000.0),
}
"""Allowed ranges of settings that are not simply 0 or more."""
RELAXED = 40.0
"""Difference between the set point and its slow part that stops the integral [deg/s]."""


@dataclass(frozen=True)
class Settings:
    """`[controller]`, settings of the CLI."""

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
    """First-order filter of the gyro [Hz]; 0: off; so are the next five."""
    gyro_lpf2_static_hz: float = 500.0
    dterm_lpf1_static_hz: float = 75.0
    dterm_lpf2_static_hz: float = 150.0
    yaw_lowpass_hz: float = 100.0
    rc_smoothing_setpoint_cutoff: float = 30.0
    """Third-order filter of the set point [Hz]."""
    iterm_limit: float = 400.0
    iterm_windup: float = 85.0
    """Share of the motors' range above which the integral slows down [%]; 100: it does not."""
    iterm_relax_cutoff: float = 15.0
    """[Hz]; 0: the integral is not relaxed."""
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
    """(3,) of the sum."""
    gyro_hz: Array
    """(2,)."""
    dterm_hz: Array
    """(2,)."""
    yaw_hz: Array
    setpoint_hz: Array
    i_limit: Array
    windup: Array
    relax_hz: Array
    relaxed: Array
    """(3,) 1 for the axes that are relaxed."""
    tpa: Array
    """(2,) reduction of D at full throttle, and the throttle where it begins."""
    idle: Array
    layout: Layout


class State(NamedTuple):
    """State of the loop between updates."""

    started: Array
    """(...,) 0 before the first update."""
    gyro: Array
    """(..., 2, 3) outputs of the gyro's filters [deg/s]."""
    dterm: Array
    """(..., 2, 3) outputs of the derivative's filters [deg/s]."""
    setpoint: Array
    """(..., 3, 3) outputs of the set point's filters [deg/s]."""
    slow: Array
    """(..., 3) slow part of the set point [deg/s]."""
    integral: Array
    """(..., 3) I."""
    yaw: Array
    """(..., 1) filtered P of yaw."""
    span: Array
    """(...,) range of the motors' differences at the last update, before scaling."""


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
    """Return the state of loops of this batch shape before the first update."""
    none, still = xp.zeros(shape), xp.zeros((*shape, 3))
    two, three = xp.zeros((*shape, 2, 3)), xp.zeros((*shape, 3, 3))
    return State(none, two, two, three, still, still, xp.zeros((*shape, 1)), none)


def update(
    gain: Gains,
    state: State,
    throttle: Array,
    rate_cmd_b: Array,
    rate_b: Array,
    dt: Array,
    scale: Array,
) -> tuple[State, Array]:
    """Return the state after an update and the motor commands; see `crazyflie.update`."""
    xp = rate_b.__array_namespace__()
    fresh = state.started
    gyro = _chain(fresh, state.gyro, DEG * rate_b, gain.gyro_hz, dt)
    rate = gyro[..., -1, :]
    dterm = _chain(fresh, state.dterm, rate, gain.dterm_hz, dt)
    slope = (dterm[..., -1, :] - pick(fresh, dterm[..., -1, :], state.dterm[..., -1, :])) / dt
    cutoffs = xp.stack([gain.setpoint_hz] * 3)
    setpoint = _chain(fresh, state.setpoint, DEG * rate_cmd_b, cutoffs, dt)
    wanted = setpoint[..., -1, :]
    change = (wanted - pick(fresh, wanted, state.setpoint[..., -1, :])) / dt
    error = wanted - rate

    slow = pt1(pick(fresh, wanted, state.slow), wanted, gain.relax_hz, dt)
    relax = xp.maximum(1.0 - gain.relaxed * xp.abs(wanted - slow) / RELAXED, 0.0)
    slows = gain.windup < 1.0
    room = (1.0 - state.span) / xp.where(slows, 1.0 - gain.windup, 1.0)
    room = xp.where(slows, xp.clip(room, 0.0, 1.0), 1.0)
    added = state.integral + gain.i * relax * room[..., None] * error * dt
    integral = xp.clip(added, -gain.i_limit, gain.i_limit)

    p = gain.p * error
    yaw = pt1(pick(fresh, p[..., 2:], state.yaw), p[..., 2:], gain.yaw_hz, dt)
    p = xp.concatenate([p[..., :2], yaw], axis=-1)
    level = (throttle - gain.idle) / (1.0 - gain.idle)
    high = xp.clip((level - gain.tpa[1]) / xp.maximum(1.0 - gain.tpa[1], 1e-6), 0.0, 1.0)
    d = -gain.d * (1.0 - gain.tpa[0] * high)[..., None] * slope
    total = xp.clip(scale * (p + integral + d + gain.f * change), -gain.limit, gain.limit)
    span, command = mixed(gain, level, total / SUM)
    state = State(xp.ones_like(fresh), gyro, dterm, setpoint, slow, integral, yaw, span)
    return state, command


def mixed(gain: Gains, level: Array, turning: Array) -> tuple[Array, Array]:
    """Return the range of the motors' differences (...,), and the motor commands (..., 4).

    Args:
        gain: the layout and the idle command.
        level: (...,) throttle from 0 to 1.
        turning: (..., 3) sums, as shares of a motor's range.
    """
    xp = turning.__array_namespace__()
    roll, pitch, yaw = gain.layout
    add = turning[..., 0, None] * roll + turning[..., 1, None] * pitch
    add = add + turning[..., 2, None] * yaw
    low, high = least(add), largest(add)
    span = high - low
    fits = xp.maximum(span, 1.0)
    level = xp.minimum(xp.maximum(level, -low / fits), 1.0 - high / fits)
    share = xp.clip(level[..., None] + add / fits[..., None], 0.0, 1.0)
    return span, gain.idle + (1.0 - gain.idle) * share


def _chain(fresh: Array, before: Array, value: Array, cutoffs_hz: Array, dt: Array) -> Array:
    """Return the outputs (..., K, 3) of first-order filters one after another."""
    xp = value.__array_namespace__()
    outputs = []
    for k in range(before.shape[-2]):
        value = pt1(pick(fresh, value, before[..., k, :]), value, cutoffs_hz[k], dt)
        outputs.append(value)
    return xp.stack(outputs, axis=-2)
