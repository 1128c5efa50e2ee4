"""Errors of an on-board state estimate relative to the log's reference pose, and their causes.

To first order, an estimate that is late by d has the error -d times the derivative of the truth. A
scale error k of the velocity v causes the error k v. An estimator that neglects drag takes the
deceleration by drag for a tilt of the vehicle; the tilt follows the velocity with a first-order
lag, whose time constant is called correlation time (the sensor model `drag_tilt`).

These causes are fitted by least squares to the errors of all flights (`identify/fit.py`), with a
free constant of each flight. Errors are correlated in time, so intervals come from the disagreement
between stretches of 5 s. Rows are not whitened (made uncorrelated in time): whitening would give a
high weight to fast motion, in which the dynamics of the estimator dominate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.judging.statistics import Interval
from eval.logs.columns import ESTIMATE, GROUPS, FlightLogError
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import attitude_at, follow_lag, interpolate
from suite.diagnose.identify.fit import Rows, Unknown, fit
from tracks.geometry.rotation import cross, to_local

PARTS = {"position": "pos", "velocity": "vel", "attitude": "quat"}
"""Parts of the state, three axes each, and the group of columns that has each part."""
VELOCITY = slice(3, 6)
"""Channels of the velocity among the errors."""
SLOPE_ROWS = 15
"""Number of rows over which the reference is differentiated."""
SETTLES_S = 2.0
"""Time left out after the first row and before the last: the vehicle is near the ground [s]."""
LEAST_S = 8.0
"""Least length of a flight; errors are correlated over seconds [s]."""
ZERO = Interval(0.0, 0.0, 0.0)
"""A parameter that is not in the model."""
STRETCH_S = 5.0
"""Errors further apart than this count as independent [s]."""
ROUNDS = 3
"""Number of rounds of the fit; each is linearised at the delay of the round before."""
TILT = slice(6, 9)
"""Channels of the attitude among the errors. All three axes are fitted: if a body leans, a tilt
about a horizontal world axis has a part about the body's z axis."""
DELAY = Unknown("delay", 0.0, -1.0, 1.0, np.inf, 1e-3)
SCALE = Unknown("scale", 0.0, -1.0, 1.0, np.inf, 1e-3)
DRAG = Unknown("drag", 0.3, -2.0, 5.0, np.inf, 1e-2)
LOG_LASTS = Unknown("log_lasts", 0.0, np.log(0.05), np.log(10.0), np.inf, 1e-2)
"""The fitted parameters: change of the delay [s], relative scale error of the velocity, drag [1/s],
and logarithm of the tilt's correlation time in seconds. The drag does not start at 0, where the
correlation time has no effect."""
LOG_LIMITS = (-20.0, 20.0)
"""Limits of the logarithm of the correlation time's interval."""


class Errors(NamedTuple):
    """Errors of the estimate in one flight at T evenly spaced times; NaN for missing signals."""

    step_s: float
    """Time between rows [s]."""
    value: np.ndarray
    """(T, 9) estimate minus reference: world position [m], body velocity [m/s] and attitude
    [rad]."""
    slope: np.ndarray
    """(T, 9) time derivative of the reference, in the same axes."""
    vel_b: np.ndarray
    """(T, 3) velocity of the reference in body axes [m/s]."""
    rot_w: np.ndarray
    """(T, 3, 3) attitude of the reference, body to world."""
    lean_w: np.ndarray
    """(L + T, 3) cross product of velocity and body z axis, divided by gravity [s]: the tilt for a
    drag of 1/s that an estimator neglects. It begins L rows before the first error."""


def errors_of(log: FlightLog, late_s: float = 0.0) -> Errors:
    """Return the errors of the estimate in `log` relative to the reference `late_s` [s] earlier.

    Raises:
        FlightLogError: if the log has no estimate, no reference for it, or is too short.
    """
    estimates = {part: _estimate(log, group) for part, group in PARTS.items()}
    if all(estimate is None for estimate in estimates.values()):
        reason = (
            "no on-board estimate: no columns est_pos_x, est_vel_x or est_quat_w. suite import "
            'keeps them where the mapping file has [[pos]] of source = "mocap" and of source = '
            '"estimate", as nanobench has, and --source estimate is left out'
        )
        raise FlightLogError(log.name, reason)
    for group, values in (("pos", log.pos_w), ("quat", log.quat_wxyz)):
        if not np.isfinite(values).any():
            reason = f"no reference for the estimate: {GROUPS[group][0]} is missing in every row"
            raise FlightLogError(log.name, reason, GROUPS[group][0])
    # Times without take-off and landing. The velocity is also needed before `grid`, see `lean_w`.
    step_s = float(np.median(np.diff(log.time_s)))
    least_s = LEAST_S + 2 * SETTLES_S
    if log.duration_s < least_s:
        reason = f"{log.duration_s:.1f} s of flight; allowed are {least_s:g} s or more"
        raise FlightLogError(log.name, reason)
    from_start = np.arange(log.time_s[0], log.time_s[-1] + 0.5 * step_s, step_s)
    from_start = from_start[from_start <= from_start[-1] - SETTLES_S]
    grid = from_start[from_start >= from_start[0] + SETTLES_S]
    vel_w = interpolate(from_start - late_s, log.time_s, log.vel_w, holes=True)
    rot_w = attitude_at(from_start - late_s, log.time_s, log.quat_wxyz)
    lean_w = cross(vel_w, rot_w[..., 2]) / GRAVITY
    vel_w, rot_w = vel_w[-len(grid) :], rot_w[-len(grid) :]
    # Estimate minus reference, part by part.
    then_s = grid - late_s
    value = np.full((len(grid), 9), np.nan)
    for k, (part, estimate) in enumerate(estimates.items()):
        if estimate is None:
            continue
        if part == "attitude":
            error = rotation_between(rot_w, attitude_at(grid, log.time_s, estimate))
        else:
            pos_w = interpolate(then_s, log.time_s, log.pos_w, holes=True)
            reference = pos_w if part == "position" else vel_w
            error = interpolate(grid, log.time_s, estimate, holes=True) - reference
            error = to_local(rot_w, error) if part == "velocity" else error
        value[:, 3 * k : 3 * k + 3] = error
    # The time derivative of the reference is velocity, acceleration and body rates.
    acc_w = savgol_filter(vel_w, SLOPE_ROWS, 2, deriv=1, delta=step_s, axis=0, mode="nearest")
    acc_b = to_local(rot_w, acc_w)
    rate_b = interpolate(then_s, log.time_s, log.rate_b, holes=True)
    slope = np.concatenate([vel_w, acc_b, rate_b], axis=1)
    return Errors(step_s, value, slope, to_local(rot_w, vel_w), rot_w, lean_w)


def rotation_between(rot_w: np.ndarray, other_w: np.ndarray) -> np.ndarray:
    """Return rotation vectors (T, 3) from `rot_w` to `other_w` (T, 3, 3), in body axes [rad]."""
    relative = np.matmul(np.swapaxes(rot_w, -1, -2), other_w)
    good = np.isfinite(relative).all(axis=(1, 2))
    rotation_b = np.full((len(relative), 3), np.nan)
    if good.any():
        rotation_b[good] = Rotation.from_matrix(relative[good]).as_rotvec()
    return rotation_b


def _estimate(log: FlightLog, group: str) -> np.ndarray | None:
    """Return the estimate's columns (T, C) of a group, or None if one is missing."""
    columns = [log.extra.get(f"{ESTIMATE}{name}") for name in GROUPS[group]]
    if any(column is None or np.asarray(column).dtype.kind not in "fiu" for column in columns):
        return None
    values = np.stack([np.asarray(column, float) for column in columns], axis=1)
    return values if np.isfinite(values).all(axis=1).sum() > 1 else None


class Systematic(NamedTuple):
    """The systematic part of the errors."""

    delay_s: Interval
    """Delay of the estimate [s]."""
    velocity_scale: Interval
    """Relative scale error of the velocity."""
    drag: Interval
    """Drag that the estimator neglects [1/s]; zeros where it is not significant."""
    tilt_lasts_s: Interval
    """Correlation time of the tilt by this drag [s]; zeros without a drag."""

    def removed(self, flight: Errors) -> np.ndarray:
        """Return the errors (T, 9) of a flight without those by scale and neglected drag."""
        value = _without_scale(flight, significant(self.velocity_scale))
        if self.drag.value:
            value[:, TILT] -= self.drag.value * _lean(flight, self.tilt_lasts_s.value)
        return value


def fit_systematic(logs: Sequence[FlightLog]) -> tuple[Systematic, list[Errors]]:
    """Fit the systematic part of the errors of the flights in `logs`.

    Returns:
        The systematic part, and the errors of each flight at the fitted delay. A delay whose
        interval contains 0 counts as 0.
    """
    delay_s = scale = ZERO
    for _ in range(ROUNDS):
        late_s = delay_s.value
        change_s, scale = _delay_and_scale([errors_of(log, late_s) for log in logs])
        delay_s = Interval(*(late_s + end for end in change_s))
    flights = [errors_of(log, significant(delay_s)) for log in logs]
    return Systematic(delay_s, scale, *_neglected_drag(flights)), flights


def _delay_and_scale(flights: Sequence[Errors]) -> tuple[Interval, Interval]:
    """Return the change of the delay [s], and the scale error of the velocity."""

    def residuals(numbers: Mapping[str, float]) -> list[Rows]:
        # To first order, a delay causes the error -delay * slope.
        change_s, scale = numbers["delay"], numbers["scale"]
        return [_rows(one, _without_scale(one, scale) + change_s * one.slope) for one in flights]

    noise = _size([one.value for one in flights])
    fitted, scale = fit(residuals, [DELAY], noise=noise, fixed={"scale": 0.0}), ZERO
    if any(np.isfinite(one.value[:, VELOCITY]).any() for one in flights):
        both = fit(residuals, [DELAY, SCALE], noise=noise)
        scale = both.interval("scale")
        # A scale that is not significant would only widen the delay's interval.
        fitted = both if significant(scale) else fitted
    return fitted.interval("delay"), scale


def _neglected_drag(flights: Sequence[Errors]) -> tuple[Interval, Interval]:
    """Return the drag [1/s] and the correlation time of its tilt [s]; zeros if not significant."""
    if not any(np.isfinite(flight.value[:, TILT]).any() for flight in flights):
        return ZERO, ZERO

    def residuals(numbers: Mapping[str, float]) -> list[Rows]:
        drag, lasts_s = numbers["drag"], float(np.exp(numbers["log_lasts"]))
        return [_rows(one, one.value[:, TILT] - drag * _lean(one, lasts_s)) for one in flights]

    noise = _size([one.value[:, TILT] for one in flights])
    fitted = fit(residuals, [DRAG, LOG_LASTS], noise=noise)
    drag, log_lasts = fitted.interval("drag"), fitted.interval("log_lasts")
    if drag.value <= 0.0 or not significant(drag):
        return ZERO, ZERO
    return drag, Interval(*np.exp(np.clip(log_lasts, *LOG_LIMITS)).tolist())


def _lean(flight: Errors, lasts_s: float) -> np.ndarray:
    """Return the attitude error (T, 3) in body axes for a drag of 1/s, see `drag_tilt`."""
    lean_w = follow_lag(np.nan_to_num(flight.lean_w), flight.step_s, lasts_s)
    return to_local(flight.rot_w, lean_w[-len(flight.value) :])


def _without_scale(flight: Errors, scale: float) -> np.ndarray:
    """Return the errors (T, 9) without those by a relative `scale` error of the velocity."""
    value = flight.value.copy()
    value[:, VELOCITY] -= scale * flight.vel_b
    return value


def _size(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return the RMS (C,) of errors (T, C) about each flight's mean, as the noise of a fit."""
    known = [np.ma.masked_invalid(one) for one in values]
    squares = np.ma.concatenate([(one - one.mean(axis=0)) ** 2 for one in known])
    return np.maximum(np.sqrt(squares.mean(axis=0)).filled(1.0), 1e-150)


def _rows(flight: Errors, values: np.ndarray) -> Rows:
    """Return remaining errors `values` (T, C) of a flight for a fit; each has a free constant."""
    return Rows(values, stretches(len(values), flight.step_s), np.ones(values.shape[1], bool))


def stretches(count: int, step_s: float) -> np.ndarray:
    """Return the number (T,) of the stretch of `STRETCH_S` in which each of `count` rows is."""
    return (np.arange(count) * step_s / STRETCH_S).astype(int)


def significant(interval: Interval) -> float:
    """Return the value, or 0 if the interval contains 0."""
    return 0.0 if interval.low <= 0.0 <= interval.high else interval.value
