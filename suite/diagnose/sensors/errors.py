"""Errors of an on-board state estimate relative to the log's reference pose, and their delay.

To first order a delay d causes the error -d times the derivative of the truth, and a scale error k
of the velocity causes k v. Both are fitted by least squares to the errors of all flights, after
subtracting each flight's mean. Axes are weighted by their variance. Errors are correlated in time,
so intervals come from the disagreement between stretches of 5 s. Rows are not whitened: that would
give fast motion a high weight, in which the estimator's own dynamics dominate.
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
"""Parts of the state, three axes each, and the columns that hold them."""
SLOPE_ROWS = 15
"""Rows over which the reference is differentiated."""
SETTLES_S = 2.0
"""Time left out after the first row and before the last: the vehicle is near the ground [s]."""
LEAST_S = 8.0
"""Least length of a flight; errors are correlated over seconds [s]."""


class Errors(NamedTuple):
    """Errors of the estimate in one flight at T evenly spaced times; NaN for missing signals."""

    name: str
    step_s: float
    value: np.ndarray
    """(T, 9) estimate - reference: position in the world [m], velocity [m/s] and attitude [rad] in
    the body."""
    slope: np.ndarray
    """(T, 9) time derivative of the reference, in the same axes."""
    vel_b: np.ndarray
    """(T, 3) velocity of the reference [m/s]."""
    rot_w: np.ndarray
    """(T, 3, 3) attitude of the reference, body to world."""
    lean_w: np.ndarray
    """(L + T, 3) velocity x body z over gravity, also of L rows before the first error [s]."""


def errors_of(log: FlightLog, late_s: float = 0.0) -> Errors:
    """Return the errors of the estimate in `log` relative to the reference `late_s` earlier [s].

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
    step_s = float(np.median(np.diff(log.time_s)))
    whole = np.arange(log.time_s[0], log.time_s[-1] + 0.5 * step_s, step_s)
    whole = whole[whole <= whole[-1] - SETTLES_S]
    grid = whole[whole >= whole[0] + SETTLES_S]
    if len(grid) < LEAST_S / step_s:
        reason = (
            f"{log.duration_s:.1f} s of flight; allowed are {LEAST_S + 2 * SETTLES_S:g} s or more"
        )
        raise FlightLogError(log.name, None, None, reason)
    vel_w = interpolated(log.time_s, log.vel_w, whole - late_s)
    rot_w = attitude_at(log.time_s, log.quat_wxyz, whole - late_s)
    lean_w = cross(vel_w, rot_w[..., 2]) / GRAVITY
    vel_w, rot_w = vel_w[-len(grid) :], rot_w[-len(grid) :]
    then = grid - late_s
    value, rate_b = np.full((len(grid), 9), np.nan), np.full((len(grid), 3), np.nan)
    for k, (part, estimate) in enumerate(estimates.items()):
        if estimate is None:
            continue
        if part == "attitude":
            error = rotation_between(rot_w, attitude_at(log.time_s, estimate, grid))
        else:
            reference = interpolated(log.time_s, log.pos_w, then) if part == "position" else vel_w
            error = interpolated(log.time_s, estimate, grid) - reference
            error = to_local(rot_w, error) if part == "velocity" else error
        value[:, 3 * k : 3 * k + 3] = error
    acc_b = to_local(rot_w, _differentiated(vel_w, step_s))
    if np.isfinite(log.rate_b).any():
        rate_b = interpolated(log.time_s, log.rate_b, then)
    slope = np.concatenate([vel_w, acc_b, rate_b], axis=1)
    return Errors(log.name, step_s, value, slope, to_local(rot_w, vel_w), rot_w, lean_w)


def rotation_between(rot_w: np.ndarray, other_w: np.ndarray) -> np.ndarray:
    """Return rotation vectors (T, 3) from `rot_w` to `other_w` in body axes [rad]; NaN is kept.

    Both (T, 3, 3) are rotations from body to world.
    """
    relative = np.matmul(np.swapaxes(rot_w, -1, -2), other_w)
    good = np.isfinite(relative).all(axis=(1, 2))
    out = np.full((len(relative), 3), np.nan)
    if good.any():
        out[good] = Rotation.from_matrix(relative[good]).as_rotvec()
    return out


def _estimate(log: FlightLog, group: str) -> np.ndarray | None:
    """Return the estimate's columns (T, C) of a group, or None if one is missing."""
    columns = [log.extra.get(f"{ESTIMATE}{name}") for name in GROUPS[group]]
    if any(column is None or np.asarray(column).dtype.kind not in "fiu" for column in columns):
        return None
    values = np.stack([np.asarray(column, float) for column in columns], axis=1)
    return values if np.isfinite(values).all(axis=1).sum() > 1 else None


def _differentiated(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the slope (T, C) of a parabola over `SLOPE_ROWS` rows; NaN near holes."""
    if len(values) < SLOPE_ROWS:
        return np.full_like(values, np.nan)
    slope = savgol_filter(values, SLOPE_ROWS, 2, deriv=1, delta=step_s, axis=0, mode="nearest")
    return np.asarray(slope)


STRETCH_S = 5.0
"""Errors further apart than this count as independent [s]."""
DIFFER_P = 0.05
"""Flights count as different below this p-value [1]."""
ROUNDS = 3
"""Rounds of the fit, each linearised at the delay of the round before."""
LEAST_INFORMATION = 1e-9
"""A number with less information in the errors is not fitted [1]."""


class Lateness(NamedTuple):
    """The systematic part of the errors."""

    delay_s: Interval
    """Delay of the estimate [s]."""
    velocity_scale: Interval
    """Relative scale error of the velocity [1]."""
    by_part: dict[str, Interval]
    """Delay by each part of the state alone [s]."""


def fit_lateness(logs: Sequence[FlightLog]) -> tuple[Lateness, list[Errors]]:
    """Fit the delay and the velocity's scale to the flights in `logs`.

    Returns:
        The systematic part, and each flight's errors at the fitted delay. A delay whose interval
        contains 0 counts as 0.
    """
    lateness = _fitted([errors_of(log) for log in logs], 0.0)
    for _ in range(ROUNDS - 1):
        delay_s = lateness.delay_s.value
        lateness = _fitted([errors_of(log, delay_s) for log in logs], delay_s)
    return lateness, [errors_of(log, significant(lateness.delay_s)) for log in logs]


def _fitted(flights: Sequence[Errors], delay_s: float) -> Lateness:
    """Return delay and scale by errors that were taken at `delay_s`."""
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
    return Interval(float(value), float(value - half), float(value + half))


def without_scale(flight: Errors, scale: float) -> np.ndarray:
    """Return the errors (T, 9) without those by a relative `scale` error of the velocity [1]."""
    return flight.value - scale * _scale_slope(flight)


def _scale_slope(flight: Errors) -> np.ndarray:
    """Return the errors (T, 9) that a scale error of 1 causes."""
    zeros = np.zeros_like(flight.vel_b)
    return np.concatenate([zeros, flight.vel_b, zeros], axis=1)


def _equations(flights: Sequence[Errors], channels: slice) -> NormalEquations:
    """Return the normal equations of delay and scale on the errors of `channels`, by stretch."""
    columns = [np.stack([one.value, -one.slope, _scale_slope(one)], axis=-1) for one in flights]
    return equations_of(flights, [values[:, channels] for values in columns])


def equations_of(flights: Sequence[Errors], columns: Sequence[np.ndarray]) -> NormalEquations:
    """Return the normal equations, by stretch, of two numbers.

    Args:
        flights: the errors.
        columns: for each flight C errors and their slopes along the numbers, (T, C, 3).
    """
    rows, stretch, flight_of = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for number, (flight, values) in enumerate(zip(flights, columns, strict=True)):
        complete = np.isfinite(values).all(axis=-1, keepdims=True)
        values = np.where(complete, values, 0.0)
        mean = values.sum(axis=0) / np.maximum(complete.sum(axis=0), 1)
        rows.append(np.where(complete, values - mean, 0.0))
        stretch.append((np.arange(len(values)) * flight.step_s / STRETCH_S).astype(int))
        flight_of.append(np.full(len(values), number))
    places, number = np.unique(
        np.stack([np.concatenate(flight_of), np.concatenate(stretch)]), axis=1, return_inverse=True
    )
    table = np.concatenate(rows)
    # The errors' RMS serves as noise: the fit explains a small part of them.
    count = np.maximum(np.count_nonzero(table[..., 0], axis=0), 1)
    noise = np.sqrt(np.maximum((table[..., 0] ** 2).sum(axis=0) / count, 1e-300))
    white = table / noise[:, None]
    start_s = places[1] * STRETCH_S
    return without_nuisance(
        white[..., 0], white[..., 1:], (0, 1), number.ravel(), places[0], start_s
    ).equations


def _solved(equations: NormalEquations, numbers: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return delay and scale (2,) and their intervals' half-widths (2,); 0 if not in `numbers`."""
    hessian, gradient = equations.sums()
    fitted = [k for k in numbers if hessian[k, k] > LEAST_INFORMATION]
    value, half = np.zeros(2), np.zeros(2)
    if fitted:
        value[fitted] = np.linalg.solve(hessian[np.ix_(fitted, fitted)], gradient[fitted])
        residual = equations._replace(gradient=equations.gradient - equations.hessian @ value)
        half[fitted] = intervals95(residual.take(fitted), DIFFER_P, leave_out=True).half_width
    return value, half
