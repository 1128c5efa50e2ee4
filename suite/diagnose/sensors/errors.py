"""Errors of an on-board state estimate against the log's reference pose, and their delay.

To first order a delay d causes the error -d times the derivative of the truth, and a scale error k
of the velocity causes k v. Both are fitted by least squares to the errors of all flights, less each
flight's mean; axes are weighted by their variance. Errors are correlated in time, so intervals come
from the disagreement of stretches. Rows are not whitened: that would weight fast motion, in which
an estimator's own dynamics dominate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from eval.judging.statistics import Interval
from eval.logs.columns import ESTIMATE, GROUPS, FlightLogError
from eval.logs.flight_log import FlightLog
from suite.diagnose.estimate.block import NormalEquations, without_nuisance
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.identify.grid import attitude_on, joined
from tracks.geometry.rotation import to_local

PARTS = {"position": "pos", "velocity": "vel", "attitude": "quat"}
"""Parts of the state, three axes each, and the columns that hold them."""
SLOPE_ROWS = 15
"""The reference is differentiated over so many rows."""
SETTLES_S = 2.0
"""Time left out after the first row and before the last: the vehicle is near the ground [s]."""
LEAST_S = 8.0
"""Least length of a flight, as the errors last for seconds [s]."""


class Errors(NamedTuple):
    """Errors of the estimate in one flight on an even grid; NaN where something is missing."""

    name: str
    step_s: float
    value: np.ndarray
    """(T, 9) estimate - reference: position in the world, velocity and attitude in the body."""
    slope: np.ndarray
    """(T, 9) of the reference over time, in the same axes."""
    vel_b: np.ndarray
    """(T, 3) of the reference [m/s]."""


def errors_of(log: FlightLog, late_s: float = 0.0) -> Errors:
    """Return the errors of the estimate in `log` relative to the reference `late_s` earlier [s].

    Raises:
        FlightLogError: where the log holds no estimate, or no reference for it.
    """
    there = [part for part, group in PARTS.items() if _estimate(log, group) is not None]
    if not there:
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
    grid = np.arange(log.time_s[0], log.time_s[-1] + 0.5 * step_s, step_s)
    grid = grid[(grid >= grid[0] + SETTLES_S) & (grid <= grid[-1] - SETTLES_S)]
    if len(grid) < LEAST_S / step_s:
        reason = (
            f"{log.duration_s:.1f} s of flight; allowed are {LEAST_S + 2 * SETTLES_S:g} s or more"
        )
        raise FlightLogError(log.name, None, None, reason)
    then = grid - late_s
    vel_w = joined(log.time_s, log.vel_w, then)
    rot_w = attitude_on(log.time_s, log.quat_wxyz, then)
    value, nothing = np.full((len(grid), 9), np.nan), np.full((len(grid), 3), np.nan)
    for k, (part, group) in enumerate(PARTS.items()):
        if part not in there:
            continue
        own = _estimate(log, group)
        assert own is not None
        if group == "quat":
            estimate = attitude_on(log.time_s, own, grid)
            off = rotation_between(rot_w, estimate)
        else:
            reference = log.pos_w if group == "pos" else log.vel_w
            off = joined(log.time_s, own, grid) - joined(log.time_s, reference, then)
            off = to_local(rot_w, off) if group == "vel" else off
        value[:, 3 * k : 3 * k + 3] = off
    acc_b = to_local(rot_w, _differentiated(vel_w, step_s))
    rate_b = joined(log.time_s, log.rate_b, then) if np.isfinite(log.rate_b).any() else nothing
    slope = np.concatenate([vel_w, acc_b, rate_b], axis=1)
    return Errors(log.name, step_s, value, slope, to_local(rot_w, vel_w))


def rotation_between(rot_w: np.ndarray, other_w: np.ndarray) -> np.ndarray:
    """Return the vector (T, 3) of the turn from `rot_w` to `other_w`, in the body; NaN is kept."""
    turn = np.matmul(np.swapaxes(rot_w, -1, -2), other_w)
    good = np.isfinite(turn).all(axis=(1, 2))
    out = np.full((len(turn), 3), np.nan)
    if good.any():
        out[good] = Rotation.from_matrix(turn[good]).as_rotvec()
    return out


def _estimate(log: FlightLog, group: str) -> np.ndarray | None:
    """Return the estimate's columns (T, C) of a group where they are all there."""
    columns = [log.extra.get(f"{ESTIMATE}{name}") for name in GROUPS[group]]
    if any(column is None or np.asarray(column).dtype.kind not in "fiu" for column in columns):
        return None
    values = np.stack([np.asarray(column, float) for column in columns], axis=1)
    return values if np.isfinite(values).all(axis=1).sum() > 1 else None


def _differentiated(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the slope (T, C) of a parabola over `SLOPE_ROWS` rows; NaN near holes."""
    if len(values) < SLOPE_ROWS:
        return np.full_like(values, np.nan)
    how = {"deriv": 1, "delta": step_s, "axis": 0, "mode": "nearest"}
    return np.asarray(savgol_filter(values, SLOPE_ROWS, 2, **how))


STRETCH_S = 5.0
"""Errors further apart than this count as independent [s]."""
DIFFER_P = 0.05
"""Flights differ where chance makes them do so more rarely than this."""


ROUNDS = 3
"""Of the fit, each at the delay of the one before."""


class Lateness(NamedTuple):
    """The systematic part of the errors."""

    delay_s: Interval
    velocity_scale: Interval
    by_part: dict[str, Interval]
    """Delay by each part of the state alone [s]."""


def fit_lateness(logs: Sequence[FlightLog]) -> tuple[Lateness, list[Errors]]:
    """Return the delay and the scale of the velocity, and the errors at that delay.

    A delay whose interval contains 0 is set to 0.
    """
    delay_s, found = 0.0, None
    for _ in range(ROUNDS):
        flights = [errors_of(log, delay_s) for log in logs]
        found = _fitted(flights, delay_s)
        delay_s = found.delay_s.value
    assert found is not None
    return found, [errors_of(log, acting(found.delay_s)) for log in logs]


def _fitted(flights: Sequence[Errors], at_s: float) -> Lateness:
    fitted, scale = (0, 1), Interval(0.0, 0.0, 0.0)
    every = _equations(flights, slice(0, 9))
    value, half = _solved(every, fitted)
    if value[1]:
        scale = _interval(value[1], half[1])
        if not acting(scale):  # it would only widen the delay's interval
            fitted = (0,)
            value, half = _solved(every, fitted)
    by_part = {}
    for k, part in enumerate(PARTS):
        own = _equations(flights, slice(3 * k, 3 * k + 3))
        if own.hessian[:, 0, 0].any():
            alone, width = _solved(own, fitted)
            by_part[part] = _interval(at_s + alone[0], width[0])
    return Lateness(_interval(at_s + value[0], half[0]), scale, by_part)


def acting(found: Interval) -> float:
    """Return the value, or 0 where the interval contains 0."""
    return 0.0 if found.low <= 0.0 <= found.high else found.value


def _interval(value: float, half: float) -> Interval:
    return Interval(float(value), float(value - half), float(value + half))


def without(flight: Errors, scale: float) -> np.ndarray:
    """Return the errors (T, 9) less what a scale of the velocity explains."""
    return flight.value - scale * _scaled(flight)


def stretches(flight: Errors) -> np.ndarray:
    """Return the number (T,) of each row's stretch."""
    return (np.arange(len(flight.value)) * flight.step_s / STRETCH_S).astype(int)


def _scaled(flight: Errors) -> np.ndarray:
    nothing = np.zeros_like(flight.vel_b)
    return np.concatenate([nothing, flight.vel_b, nothing], axis=1)


def _equations(flights: Sequence[Errors], channels: slice) -> NormalEquations:
    """Return the normal equations of delay and scale on the errors of `channels`, by stretch."""
    rows, stretch, flight_of = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for number, flight in enumerate(flights):
        values = np.stack([flight.value, -flight.slope, _scaled(flight)], axis=-1)[:, channels]
        whole = np.isfinite(values).all(axis=-1, keepdims=True)
        values = np.where(whole, values, 0.0)
        mean = values.sum(axis=0) / np.maximum(whole.sum(axis=0), 1)
        rows.append(np.where(whole, values - mean, 0.0))
        stretch.append(stretches(flight))
        flight_of.append(np.full(len(values), number))
    both = np.stack([np.concatenate(flight_of), np.concatenate(stretch)])
    places, number = np.unique(both, axis=1, return_inverse=True)
    every = np.concatenate(rows)
    # Noise in units of what is left, of which the fit itself takes little.
    count = np.maximum(np.count_nonzero(every[..., 0], axis=0), 1)
    noise = np.sqrt(np.maximum((every[..., 0] ** 2).sum(axis=0) / count, 1e-300))
    white = every / noise[:, None]
    start_s = places[1] * STRETCH_S
    return without_nuisance(
        white[..., 0], white[..., 1:], (0, 1), number.ravel(), places[0], start_s
    ).equations


def _solved(equations: NormalEquations, fitted: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return delay and scale (2,) and their intervals' half-widths (2,); 0 where not fitted."""
    hessian, gradient = equations.sums()
    at = [k for k in fitted if hessian[k, k] > 1e-9]
    value, half = np.zeros(2), np.zeros(2)
    if at:
        value[at] = np.linalg.solve(hessian[np.ix_(at, at)], gradient[at])
        left = equations._replace(gradient=equations.gradient - equations.hessian @ value)
        half[at] = intervals95(left.take(at), DIFFER_P, leave_out=True).half_width
    return value, half
