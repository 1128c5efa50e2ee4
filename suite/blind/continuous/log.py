"""Make the flight log of a simulated flight: faults of the log, noise, and lost rows.

The noise is white, or partly coloured (correlated in time), like the errors of a state estimator.
In the shapes, T is the number of rows of a log.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eval.logs.flight_log import FlightLog
from suite.blind.continuous.body import POS, QUAT, RATE, VEL
from suite.blind.continuous.engine import Flown
from suite.blind.continuous.timing import Conditions

LOST_ROWS = 3
"""Number of consecutive rows without a pose when a pose is lost."""


def log_of_flight(
    flown: Flown,
    index: int,
    duration_s: float,
    faults: Mapping[str, Any],
    noise: Any,
    conditions: Conditions,
    rng: np.random.Generator | None,
    name: str,
    about: Mapping[str, Any],
) -> FlightLog:
    """Return the log of flight `index` from time 0 to `duration_s` [s].

    Args:
        flown: all flights.
        index: index of the flight.
        duration_s: duration of the log [s].
        faults: effect -> its values. Only effects on the log are used, such as a gyro bias.
        noise: standard deviations at a given rate, as `eval.flights.simulate.Sensors`. Rows at
            another rate have the same noise density, so the deviations are multiplied by the square
            root of the ratio of the rates.
        conditions: rates, jitter, lost rows and colour of the noise.
        rng: random generator of noise, time stamps and lost rows; None: no errors.
        name: name of the log.
        about: metadata of the log.
    """
    stamps = flown.schedule.stamp_s[:-1, index]
    # Rounding of a stamp must not remove the first row.
    rows = np.flatnonzero((stamps > -1e-9) & (stamps < duration_s))
    time_s = stamps[rows]
    # 1. The true states at the rows; with a clock offset the pose is that of another time.
    step = flown.schedule.block[rows]
    offset_s = float(faults["clock_offset"].offset) if "clock_offset" in faults else 0.0
    state = flown.state[step, index]
    pose = state if offset_s == 0.0 else state_at(flown, index, time_s - offset_s)
    pos_w, vel_w, quat = pose[:, POS], pose[:, VEL], pose[:, QUAT]
    if "lever_arm" in faults:
        to_world, arm_b = Rotation.from_quat(quat, scalar_first=True), faults["lever_arm"].offset
        pos_w = pos_w + to_world.apply(arm_b)
        vel_w = vel_w + to_world.apply(np.cross(pose[:, RATE], arm_b))
    if "attitude_offset" in faults:
        quat = rotate_attitude(quat, np.tile(faults["attitude_offset"].angle, (len(rows), 1)))
    rate_b = state[:, RATE] + _bias(faults, "gyro_bias")
    acc_b = flown.acc_b[rows, index] + _bias(faults, "accelerometer_bias")
    speed, voltage = flown.speed[step, index], flown.voltage[rows, index]
    # 2. Noise, lost poses, lost rows and errors of the time stamps.
    kept = np.ones(len(rows), bool)
    if rng is not None:
        draws = _NoiseDraws(rng, time_s, noise.rate_hz, conditions)
        pos_w = pos_w + draws.estimator_noise(noise.pos)
        vel_w = vel_w + draws.estimator_noise(noise.vel)
        rate_b += draws.white_noise(noise.gyro, 3)
        acc_b += draws.white_noise(noise.acc, 3)
        speed = speed + draws.white_noise(noise.rotor, 4)
        voltage = voltage + draws.white_noise(noise.voltage, 1)[:, 0]
        quat = rotate_attitude(quat, draws.estimator_noise(noise.attitude))
        for row in np.flatnonzero(draws.random_rows(noise.lost / LOST_ROWS)):
            pos_w[row : row + LOST_ROWS] = quat[row : row + LOST_ROWS] = np.nan
        kept = ~draws.random_rows(conditions.dropped)
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
        # A velocity without noise counts as not measured, and is not written.
        velocity_derived=not noise.vel,
    )


def state_at(flown: Flown, index: int, time_s: np.ndarray) -> np.ndarray:
    """Return the states (T, 13) of flight `index` at times (T,) within it [s].

    Within a step (at most a millisecond) the position is a cubic Hermite polynomial, and the other
    parts are interpolated linearly.
    """
    ends = flown.time_s[:, index]
    time_s = np.clip(time_s, ends[0], ends[-1])
    step_end = np.clip(np.searchsorted(ends, time_s, side="right"), 1, len(ends) - 1)
    # Steps of zero length have equal ends; the last of them starts the next step with a length.
    step_start = step_end - 1
    span = ends[step_end] - ends[step_start]
    share = np.where(span > 0.0, (time_s - ends[step_start]) / np.where(span > 0.0, span, 1.0), 1.0)
    s, h = share[:, None], span[:, None]
    start, end = flown.state[step_start, index], flown.state[step_end, index]
    state = start + s * (end - start)
    state[:, POS] = (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * start[:, POS]
        + s**2 * (3.0 - 2.0 * s) * end[:, POS]
        + h * s * (1.0 - s) * ((1.0 - s) * start[:, VEL] - s * end[:, VEL])
    )
    quat = state[:, QUAT]
    state[:, QUAT] = quat / np.sqrt((quat * quat).sum(axis=1, keepdims=True))
    return state


def rotate_attitude(quat_wxyz: np.ndarray, angle_b: np.ndarray) -> np.ndarray:
    """Return the attitudes (T, 4), each rotated by a rotation vector (T, 3) in body axes [rad]."""
    attitude = Rotation.from_quat(quat_wxyz, scalar_first=True)
    return (attitude * Rotation.from_rotvec(angle_b)).as_quat(scalar_first=True)


class _NoiseDraws:
    def __init__(
        self, rng: np.random.Generator, time_s: np.ndarray, rate_hz: float, conditions: Conditions
    ) -> None:
        self._rng, self._time_s = rng, time_s
        self._rate_hz, self._conditions = rate_hz, conditions

    def white_noise(self, sigma: float, size: int, share: float = 1.0) -> np.ndarray:
        """Return white noise (T, size), whose density is a `share` of that with `sigma`."""
        factor = np.sqrt(share * self._conditions.row_hz / self._rate_hz)
        return sigma * factor * self._rng.standard_normal((len(self._time_s), size))

    def estimator_noise(self, sigma: float) -> np.ndarray:
        """Return noise (T, 3) that is partly coloured.

        At low frequencies it has the same density as white noise with `sigma`.
        """
        share, colour_s = self._conditions.coloured, self._conditions.colour_s
        white = self.white_noise(sigma, 3, 1.0 - share)
        # The density of a first-order process at zero frequency is 2 tau sigma^2.
        coloured_sigma = sigma * np.sqrt(share / (2.0 * colour_s * self._rate_hz))
        return white + coloured_sigma * gauss_markov(self._rng, self._time_s, colour_s)

    def random_rows(self, share: float) -> np.ndarray:
        """Select a random `share` of the rows, (T,) bool, but not the first two and last four."""
        is_selected = self._rng.random(len(self._time_s)) < share
        is_selected[:2] = is_selected[-4:] = False
        return is_selected


def gauss_markov(rng: np.random.Generator, time_s: np.ndarray, colour_s: float) -> np.ndarray:
    """Return a first-order Gauss-Markov process (T, 3) of unit variance.

    Args:
        rng: random generator.
        time_s: (T,) increasing times [s].
        colour_s: correlation time [s]; the correlation after a time dt is exp(-|dt| / colour_s).
    """
    draws = rng.standard_normal((len(time_s), 3))
    decays = np.exp(-np.diff(time_s) / colour_s)
    series, value = np.empty_like(draws), draws[0]
    series[0] = value
    for row, (decay, draw) in enumerate(zip(decays, draws[1:], strict=True), 1):
        value = decay * value + np.sqrt(1.0 - decay**2) * draw
        series[row] = value
    return series


def _bias(faults: Mapping[str, Any], name: str) -> np.ndarray:
    """Return the bias (3,) of a sensor from the effect `name`; zero without this effect."""
    return np.asarray(faults[name].bias, dtype=float) if name in faults else np.zeros(3)
