"""Errors of an on-board state estimate relative to the log's reference pose, and their delay.

To first order, an estimate that is late by d has the error -d times the derivative of the truth. A
scale error k of the velocity v causes the error k v. Delay and scale are fitted by least squares to
the errors of all flights, after subtracting the mean of each flight. Each axis is divided by the
RMS of its errors. Errors are correlated in time, so intervals come from the disagreement between
stretches of 5 s. Rows are not whitened (made uncorrelated in time): whitening would give a high
weight to fast motion, in which the dynamics of the estimator dominate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.judging.statistics import Interval
from eval.logs.columns import ESTIMATE, GROUPS, FlightLogError
from eval.logs.flight_log import FlightLog
from suite.diagnose.estimate.block import NormalEquations, without_nuisance
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.identify.grid import attitude_at, interpolated
from tracks.geometry.rotation import cross, to_local

PARTS = {"position": "pos", "velocity": "vel", "attitude": "quat"}
"""Parts of the state, three axes each, and the group of columns that has each part."""
SLOPE_ROWS = 15
"""Number of rows over which the reference is differentiated."""
SETTLES_S = 2.0
"""Time left out after the first row and before the last: the vehicle is near the ground [s]."""
LEAST_S = 8.0
"""Least length of a flight; errors are correlated over seconds [s]."""


class Errors(NamedTuple):
    """Errors of the estimate in one flight at T evenly spaced times; NaN for missing signals."""

    name: str
    """Name of the flight."""
    step_s: float
    """Time between rows [s]."""
    value: np.ndarray
    """(T, 9) estimate minus reference: position in world axes [m], velocity [m/s] and attitude
    [rad] in body axes."""
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
    """Return the errors of the estimate in `log` relative to the reference.

    Args:
        log: the flight.
        late_s: delay of the estimate [s]; it is compared with the reference so much earlier.

    Raises:
        FlightLogError: if the log has no estimate, no reference for it, or is too short.
    """
    estimates = {part: _estimate(log, group) for part, group in PARTS.items()}
    if all(estimate is None for estimate in estimates.values()):
        reason = (
            "no on-board estimate: no columns est_pos_x, est_vel_x or est_quat_w. suite import "
            'keeps them where the mapping file has [[pos]] of source = "mocap" and of source = '
            '"estimate", as nanobench has'
        )
        raise FlightLogError(log.name, None, None, reason)
    for group, values in (("pos", log.pos_w), ("quat", log.quat_wxyz)):
        if not np.isfinite(values).any():
            reason = f"no reference for the estimate: {GROUPS[group][0]} is missing in every row"
            raise FlightLogError(log.name, GROUPS[group][0], None, reason)
    # Times without take-off and landing. The velocity is also needed before `grid`, see `lean_w`.
    step_s = float(np.median(np.diff(log.time_s)))
    from_start = np.arange(log.time_s[0], log.time_s[-1] + 0.5 * step_s, step_s)
    from_start = from_start[from_start <= from_start[-1] - SETTLES_S]
    grid = from_start[from_start >= from_start[0] + SETTLES_S]
    if len(grid) < LEAST_S / step_s:
        reason = (
            f"{log.duration_s:.1f} s of flight; allowed are {LEAST_S + 2 * SETTLES_S:g} s or more"
        )
        raise FlightLogError(log.name, None, None, reason)
    vel_w = interpolated(log.time_s, log.vel_w, from_start - late_s)
    rot_w = attitude_at(log.time_s, log.quat_wxyz, from_start - late_s)
    lean_w = cross(vel_w, rot_w[..., 2]) / GRAVITY
    vel_w, rot_w = vel_w[-len(grid) :], rot_w[-len(grid) :]
    # Estimate minus reference, part by part.
    then_s = grid - late_s
    value, rate_b = np.full((len(grid), 9), np.nan), np.full((len(grid), 3), np.nan)
    for k, (part, estimate) in enumerate(estimates.items()):
        if estimate is None:
            continue
        if part == "attitude":
            error = rotation_between(rot_w, attitude_at(log.time_s, estimate, grid))
        else:
            reference = interpolated(log.time_s, log.pos_w, then_s) if part == "position" else vel_w
            error = interpolated(log.time_s, estimate, grid) - reference
            error = to_local(rot_w, error) if part == "velocity" else error
        value[:, 3 * k : 3 * k + 3] = error
    # The time derivative of the reference is velocity, acceleration and body rates.
    acc_b = to_local(rot_w, _differentiated(vel_w, step_s))
    if np.isfinite(log.rate_b).any():
        rate_b = interpolated(log.time_s, log.rate_b, then_s)
    slope = np.concatenate([vel_w, acc_b, rate_b], axis=1)
    return Errors(log.name, step_s, value, slope, to_local(rot_w, vel_w), rot_w, lean_w)


def rotation_between(rot_w: np.ndarray, other_w: np.ndarray) -> np.ndarray:
    """Return rotation vectors (T, 3) from `rot_w` to `other_w` in body axes [rad]; NaN is kept.

    Both (T, 3, 3) are rotations from body to world.
    """
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


def _differentiated(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the time derivative of `values` (T, C); NaN near missing values.

    It is the slope of a parabola that is fitted to `SLOPE_ROWS` rows.
    """
    if len(values) < SLOPE_ROWS:
        return np.full_like(values, np.nan)
    slope = savgol_filter(values, SLOPE_ROWS, 2, deriv=1, delta=step_s, axis=0, mode="nearest")
    return np.asarray(slope)


STRETCH_S = 5.0
"""Errors further apart than this count as independent [s]."""
DIFFER_P = 0.05
"""P-value below which flights differ more than their stretches explain. Intervals are then
wider."""
ROUNDS = 3
"""Number of rounds of the fit; each is linearised at the delay of the round before."""
LEAST_INFORMATION = 1e-9
"""A parameter (delay or scale) with less information in the errors is not fitted."""


class Lateness(NamedTuple):
    """The systematic part of the errors."""

    delay_s: Interval
    """Delay of the estimate [s]."""
    velocity_scale: Interval
    """Relative scale error of the velocity."""
    by_part: dict[str, Interval]
    """Delay that each part of the state alone gives, by the part's name [s]."""


def fit_lateness(logs: Sequence[FlightLog]) -> tuple[Lateness, list[Errors]]:
    """Fit the delay and the scale of the velocity to the flights in `logs`.

    Returns:
        The delay and the scale, and the errors of each flight at the fitted delay. A delay whose
        interval contains 0 counts as 0.
    """
    lateness = _fitted([errors_of(log) for log in logs], 0.0)
    for _ in range(ROUNDS - 1):
        delay_s = lateness.delay_s.value
        lateness = _fitted([errors_of(log, delay_s) for log in logs], delay_s)
    return lateness, [errors_of(log, significant(lateness.delay_s)) for log in logs]


def _fitted(flights: Sequence[Errors], delay_s: float) -> Lateness:
    """Return delay and scale, from errors that were computed with the delay `delay_s`."""
    # Parameter 0 is the delay, parameter 1 the scale.
    numbers, scale = (0, 1), Interval(0.0, 0.0, 0.0)
    equations = _equations(flights, slice(0, 9))
    value, half = _solved(equations, numbers)
    if value[1]:
        scale = _interval(value[1], half[1])
        if not significant(scale):  # it would only widen the delay's interval
            numbers = (0,)
            value, half = _solved(equations, numbers)
    by_part = {}
    for k, part in enumerate(PARTS):
        of_part = _equations(flights, slice(3 * k, 3 * k + 3))
        if of_part.hessian[:, 0, 0].any():
            part_value, part_half = _solved(of_part, numbers)
            by_part[part] = _interval(delay_s + part_value[0], part_half[0])
    return Lateness(_interval(delay_s + value[0], half[0]), scale, by_part)


def significant(interval: Interval) -> float:
    """Return the value, or 0 if the interval contains 0."""
    return 0.0 if interval.low <= 0.0 <= interval.high else interval.value


def _interval(value: float, half: float) -> Interval:
    """Return the interval of `value` with the half-width `half`."""
    return Interval(float(value), float(value - half), float(value + half))


def without_scale(flight: Errors, scale: float) -> np.ndarray:
    """Return the errors (T, 9) without those by a relative `scale` error of the velocity."""
    return flight.value - scale * _scale_slope(flight)


def _scale_slope(flight: Errors) -> np.ndarray:
    """Return the errors (T, 9) that a relative scale error of 1 of the velocity causes."""
    zeros = np.zeros_like(flight.vel_b)
    return np.concatenate([zeros, flight.vel_b, zeros], axis=1)


def _equations(flights: Sequence[Errors], channels: slice) -> NormalEquations:
    """Return the normal equations of delay and scale for the errors of `channels`, by stretch."""
    columns = [np.stack([one.value, -one.slope, _scale_slope(one)], axis=-1) for one in flights]
    return equations_of(flights, [values[:, channels] for values in columns])


def equations_of(flights: Sequence[Errors], columns: Sequence[np.ndarray]) -> NormalEquations:
    """Return the normal equations of two parameters, by stretch.

    Args:
        flights: the flights.
        columns: for each flight (T, C, 3): its errors in C channels, and their slopes along the two
            parameters.
    """
    rows, stretch, flight_of = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for index, (flight, values) in enumerate(zip(flights, columns, strict=True)):
        complete = np.isfinite(values).all(axis=-1, keepdims=True)
        values = np.where(complete, values, 0.0)
        mean = values.sum(axis=0) / np.maximum(complete.sum(axis=0), 1)
        rows.append(np.where(complete, values - mean, 0.0))
        stretch.append((np.arange(len(values)) * flight.step_s / STRETCH_S).astype(int))
        flight_of.append(np.full(len(values), index))
    # Give each stretch of each flight a number; `index` is then the stretch of each row.
    flight_and_stretch, index = np.unique(
        np.stack([np.concatenate(flight_of), np.concatenate(stretch)]), axis=1, return_inverse=True
    )
    table = np.concatenate(rows)
    # The errors' RMS serves as noise: the fit explains a small part of them.
    count = np.maximum(np.count_nonzero(table[..., 0], axis=0), 1)
    noise = np.sqrt(np.maximum((table[..., 0] ** 2).sum(axis=0) / count, 1e-300))
    white = table / noise[:, None]
    start_s = flight_and_stretch[1] * STRETCH_S
    return without_nuisance(
        white[..., 0], white[..., 1:], (0, 1), index.ravel(), flight_and_stretch[0], start_s
    ).equations


def _solved(equations: NormalEquations, numbers: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return delay and scale (2,), and the half-widths (2,) of their intervals.

    Only the parameters in `numbers` are fitted; 0 is the delay and 1 the scale. The others are 0.
    """
    hessian, gradient = equations.sums()
    fitted = [k for k in numbers if hessian[k, k] > LEAST_INFORMATION]
    value, half = np.zeros(2), np.zeros(2)
    if fitted:
        value[fitted] = np.linalg.solve(hessian[np.ix_(fitted, fitted)], gradient[fitted])
        residual = equations._replace(gradient=equations.gradient - equations.hessian @ value)
        half[fitted] = intervals95(residual.take(fitted), DIFFER_P, leave_out=True).half_width
    return value, half
