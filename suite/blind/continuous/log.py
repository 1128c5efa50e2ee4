"""The log of a flight: faults of the log, white and coloured noise, lost rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from eval.logs.flight_log import FlightLog
from suite.blind.continuous.body import POS, QUAT, RATE, VEL
from suite.blind.continuous.engine import Flown
from suite.blind.continuous.timing import Conditions

IN_A_ROW = 3
"""Numbers of consecutive rows without a pose."""


class Noise(NamedTuple):
    """Standard deviations of the noise of rows at `rate_hz`; 0 leaves a channel out."""

    rate_hz: float
    pos: float
    """Each axis [m]."""
    attitude: float
    """About each body axis [rad]."""
    gyro: float
    """Each axis [rad/s]."""
    vel: float
    """Each axis [m/s]."""
    acc: float
    """Each axis [m/s^2]."""
    rotor: float
    """Each rotor [rad/s]."""
    voltage: float
    """[V]."""
    lost: float
    """Share of rows in which the pose is missing."""


def log_of_flight(
    flown: Flown,
    index: int,
    duration_s: float,
    faults: Mapping[str, Any],
    noise: Noise,
    conditions: Conditions,
    rng: np.random.Generator | None,
    name: str,
    about: Mapping[str, Any],
) -> FlightLog:
    """Return the log of flight `index` from time 0 to `duration_s` [s].

    Args:
        flown: all flights.
        index: of the flight.
        duration_s: of the log.
        faults: values of effects by name; only faults of a log are used.
        noise: at its own rate. Rows at another rate have the same noise density: deviations are
            multiplied by the root of the rates' ratio. A part may be coloured.
        conditions: of the case.
        rng: of noise, stamps and lost rows; None logs all rows without errors.
        name: of the log.
        about: its metadata.
    """
    stamps = flown.schedule.stamp_s[:-1, index]
    # Rounding of a stamp must not remove the first row.
    rows = np.flatnonzero((stamps > -1e-9) & (stamps < duration_s))
    time_s = stamps[rows]
    step = flown.schedule.block[rows]
    late = float(faults["clock_offset"].offset) if "clock_offset" in faults else 0.0
    state = flown.state[step, index]
    posed = state if late == 0.0 else state_at(flown, index, time_s - late)
    pos_w, vel_w, quat = posed[:, POS], posed[:, VEL], posed[:, QUAT]
    rate_b = state[:, RATE] + _bias(faults, "gyro_bias")
    acc_b = flown.acc_b[rows, index] + _bias(faults, "accelerometer_bias")
    speed, voltage = flown.speed[step, index], flown.voltage[rows, index]
    kept = np.ones(len(rows), bool)
    if rng is not None:
        drawn = _Draws(rng, time_s, noise, conditions)
        pos_w = pos_w + drawn.estimated(noise.pos)
        vel_w = vel_w + drawn.estimated(noise.vel)
        rate_b += drawn.white(noise.gyro, 3)
        acc_b += drawn.white(noise.acc, 3)
        speed = speed + drawn.white(noise.rotor, 4)
        voltage = voltage + drawn.white(noise.voltage, 1)[:, 0]
        quat = turned(quat, drawn.estimated(noise.attitude))
        for row in np.flatnonzero(drawn.chosen(noise.lost / IN_A_ROW)):
            pos_w[row : row + IN_A_ROW] = quat[row : row + IN_A_ROW] = np.nan
        kept = ~drawn.chosen(conditions.dropped)
        time_s = time_s + conditions.clock_s * rng.uniform(-1.0, 1.0, len(time_s))
    return FlightLog(
        name=name,
        time_s=time_s[kept],
        pos_w=pos_w[kept],
        quat_wxyz=quat[kept],
        vel_w=vel_w[kept],
        rate_b=rate_b[kept],
        thrust_cmd=flown.command[rows, index, 0][kept],
        rate_cmd_b=flown.command[rows, index, 1:][kept],
        rotor_speed=speed[kept] if noise.rotor else None,
        acc_b=acc_b[kept] if noise.acc else None,
        voltage=voltage[kept] if noise.voltage else None,
        about=dict(about),
        # Not in the log, as if it had not been measured.
        velocity_derived=not noise.vel,
    )


def state_at(flown: Flown, index: int, time_s: np.ndarray) -> np.ndarray:
    """Return the states (T, 13) of flight `index` at any times within it [s].

    Within a step (at most a millisecond) the position is a cubic with the velocities at both ends,
    and all else is linear.
    """
    ends = flown.time_s[:, index]
    time_s = np.clip(time_s, ends[0], ends[-1])
    after = np.clip(np.searchsorted(ends, time_s, side="right"), 1, len(ends) - 1)
    # Steps of zero length have equal ends; the last of them starts the next real step.
    before = after - 1
    span = ends[after] - ends[before]
    share = np.where(span > 0.0, (time_s - ends[before]) / np.where(span > 0.0, span, 1.0), 1.0)
    s, h = share[:, None], span[:, None]
    one, two = flown.state[before, index], flown.state[after, index]
    between = one + s * (two - one)
    between[:, POS] = (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * one[:, POS]
        + s**2 * (3.0 - 2.0 * s) * two[:, POS]
        + h * s * (1.0 - s) * ((1.0 - s) * one[:, VEL] - s * two[:, VEL])
    )
    quat = between[:, QUAT]
    between[:, QUAT] = quat / np.sqrt((quat * quat).sum(axis=1, keepdims=True))
    return between


def turned(quat_wxyz: np.ndarray, angle_b: np.ndarray) -> np.ndarray:
    """Return quaternions (T, 4) turned further by rotation vectors (T, 3) in body axes [rad]."""
    before = Rotation.from_quat(quat_wxyz, scalar_first=True)
    return (before * Rotation.from_rotvec(angle_b)).as_quat(scalar_first=True)


class _Draws:
    """The random noise of one flight."""

    def __init__(
        self, rng: np.random.Generator, time_s: np.ndarray, noise: Noise, conditions: Conditions
    ) -> None:
        self._rng, self._time_s = rng, time_s
        self._rate_hz, self._conditions = noise.rate_hz, conditions

    def white(self, sigma: float, size: int, share: float = 1.0) -> np.ndarray:
        """Return white noise (T, size) with a share of the noise density."""
        root = np.sqrt(share * self._conditions.row_hz / self._rate_hz)
        return sigma * root * self._rng.standard_normal((len(self._time_s), size))

    def estimated(self, sigma: float) -> np.ndarray:
        """Return noise (T, 3) with a coloured part, of the same density at low frequencies."""
        share, colour_s = self._conditions.coloured, self._conditions.colour_s
        white = self.white(sigma, 3, 1.0 - share)
        # The density of a first-order process at zero frequency is 2 tau sigma^2.
        spread = sigma * np.sqrt(share / (2.0 * colour_s * self._rate_hz))
        return white + spread * gauss_markov(self._rng, self._time_s, colour_s)

    def chosen(self, share: float) -> np.ndarray:
        """Return (T,) which rows are; never one of the first two or the last four."""
        picked = self._rng.random(len(self._time_s)) < share
        picked[:2] = picked[-4:] = False
        return picked


def gauss_markov(rng: np.random.Generator, time_s: np.ndarray, colour_s: float) -> np.ndarray:
    """Return (T, 3) of unit variance with correlation exp(-|dt| / colour_s)."""
    fresh = rng.standard_normal((len(time_s), 3))
    kept = np.exp(-np.diff(time_s) / colour_s)
    series, now = np.empty_like(fresh), fresh[0]
    series[0] = now
    for row, (stays, draw) in enumerate(zip(kept, fresh[1:], strict=True), 1):
        now = stays * now + np.sqrt(1.0 - stays**2) * draw
        series[row] = now
    return series


def _bias(faults: Mapping[str, Any], name: str) -> np.ndarray:
    return np.asarray(faults[name].bias, dtype=float) if name in faults else np.zeros(3)
