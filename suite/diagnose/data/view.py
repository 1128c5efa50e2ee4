"""Views: force or torque of a flight, as mean accelerations over short smooth windows (bumps).

A view is one part of the dynamics. It is compared with the model while all other signals are as
measured. A bump w(t) is a weight over time that is zero at both ends. Means of modelled
accelerations are weighted by w. Those of measured accelerations follow from the velocity v as
-integral(w' v) / integral(w), so measurements are never differentiated (modulating functions;
Shinbrot 1957, Trans. ASME 79). The means by all bumps of a flight are called its weak form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from eval.effects.interface import GRAVITY
from eval.importers.rows import nearest
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.inertial import InertialLog, specific_force_w
from suite.diagnose.data.sampling import voltage_drop
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.scene import Array

LEAST_ROWS = 4
"""Smallest number of steps from row to row in a bump."""


class FlightRows(NamedTuple):
    """N rows of one flight. A missing signal has a filled-in value, and its row is not `good`."""

    time_s: Array
    """(N,) time from the first row of the flight [s]."""
    motion: Motion
    """(N, ...) measured state."""
    rotor_speed: Array
    """(N, 4) rotor speeds [rad/s]."""
    voltage_drop: Array
    """(N,) fall of the battery voltage since its first value [V]; zeros without a voltage."""
    good: Array
    """(N,) bool, whether a row is in flight and has all signals."""
    imu_acc_w: Array | None = None
    """(N, 3) acceleration from the accelerometer [m/s^2]; only in flights without a pose."""
    pose_slope_b: Array | None = None
    """(N, 3, K) change of the drag's acceleration by one standard deviation of each of K unknown
    numbers of the pose [m/s^2]; only in flights without a pose."""

    @property
    def vel_b(self) -> Array:
        """(N, 3) velocity in body axes [m/s]."""
        return (np.swapaxes(self.motion.rot_w, 1, 2) @ self.motion.vel_w[..., None])[..., 0]


def rows_of(
    log: FlightLog, vehicle: Vehicle, rotor_speed: np.ndarray, limits: Thresholds = THRESHOLDS
) -> FlightRows:
    """Return the rows of `log` with rotor speeds (N, 4) [rad/s]; near the ground none is `good`."""
    rot_w = log.rot_w
    signals = (log.pos_w, log.vel_w, log.rate_b, rotor_speed)
    good = np.isfinite(np.concatenate(signals, axis=1)).all(axis=1)
    good &= np.isfinite(rot_w).all(axis=(1, 2))
    imu_acc_w = specific_force_w(log)
    if imu_acc_w is not None:
        good &= np.isfinite(imu_acc_w).all(axis=1)
        imu_acc_w = np.nan_to_num(imu_acc_w)
    pose_slope_b = log.pose_slope_b if isinstance(log, InertialLog) else None
    good &= ~near_ground(log, vehicle, rotor_speed, limits)
    pos_w, vel_w, rate_b, speed = (np.nan_to_num(signal) for signal in signals)
    return FlightRows(
        log.time_s - log.time_s[0],
        Motion(pos_w, np.where(np.isfinite(rot_w), rot_w, np.eye(3)), vel_w, rate_b),
        speed,
        voltage_drop(log, log.time_s),
        good,
        imu_acc_w,
        pose_slope_b,
    )


def near_ground(
    log: FlightLog,
    vehicle: Vehicle,
    rotor_speed: np.ndarray | None,
    limits: Thresholds = THRESHOLDS,
    lasting: bool = False,
) -> np.ndarray:
    """Return (T,) bool, whether a row of `log` is on the ground or near such a row in time.

    A row is on the ground if the vehicle is at rest with too little thrust to fly. Without a
    position the speed is unknown. Then a vehicle is at rest if it does not turn and has too little
    thrust for longer than a cut of the throttle; with `lasting` only such a rest counts. Without a
    `rotor_speed` (T, 4) [rad/s] the commanded thrust is used.
    """
    speed_known = "pos" not in log.partial or isinstance(log, InertialLog)
    motion, least = (
        (log.vel_w, limits.ground_speed) if speed_known else (log.rate_b, limits.ground_rate)
    )
    if rotor_speed is None:
        assert log.thrust_cmd is not None
        thrust = vehicle.mass * log.thrust_cmd
    else:
        thrust = vehicle.rotors.thrust_coefficient * (rotor_speed**2).sum(axis=1)
    grounded = thrust < limits.ground_thrust * vehicle.mass * GRAVITY
    grounded &= np.linalg.norm(motion, axis=1) < least
    if lasting or not speed_known:
        half_s = 0.5 * limits.ground_margin_s
        grounded = _near(log.time_s, ~_near(log.time_s, ~grounded, half_s), half_s)
    return _near(log.time_s, grounded, limits.ground_margin_s)


def _near(time_s: np.ndarray, marked: np.ndarray, margin_s: float) -> np.ndarray:
    """Return for each row (N,) whether it is within `margin_s` [s] of a `marked` row (N,) bool."""
    if not marked.any():
        return marked
    marked_s = time_s[marked]
    return np.abs(time_s - marked_s[nearest(marked_s, time_s)]) <= margin_s


@dataclass(frozen=True)
class View:
    """One part of the dynamics, force or torque, with all other signals as measured."""

    name: str
    """Name in a diagnosis."""
    about: str
    """Description for people: what is compared, and with which measured signals."""
    width_s: float
    """Width of the bumps [s]."""
    in_world: bool
    """Whether this is the force view, with linear accelerations in world axes [m/s^2]. Their
    residuals are rotated into body axes. Else they are angular, in body axes [rad/s^2]."""
    axes: tuple[int, ...] = (0, 1, 2)
    """Body axes along which the accelerations are identifiable."""

    @property
    def spacing_s(self) -> float:
        """Time between the middles of neighbouring bumps [s]."""
        return 0.5 * self.width_s


FORCE = View("force", "translation under the measured attitude and thrust", 0.2, True)
SPECIFIC = replace(FORCE, about="specific force by the accelerometer under the measured thrust")
TORQUE = View("torque", "rotation under the measured rotor speeds", 0.1, False)


class SmoothedFlight(NamedTuple):
    """A flight's rows, with its measured accelerations in one view."""

    rows: FlightRows
    form: WeakForm
    measured: np.ndarray
    """(M, 3) measured mean accelerations, in the axes of the view."""
    reliability: np.ndarray = np.ones(3)
    """(3,) factor on the model's deviations from its mean over the flight. It is the share of the
    rotors' torque that is not noise, times a correction for torque between rows."""


def smoothed(view: View, rows: FlightRows, limits: Thresholds = THRESHOLDS) -> SmoothedFlight:
    """Return a flight's measured accelerations in `view`."""
    form = weak_form(rows.time_s, rows.good, view.width_s, limits.longest_hole_s)
    if view.in_world and rows.imu_acc_w is not None:
        return SmoothedFlight(rows, form, form.mean @ rows.imu_acc_w)
    measured = form.change @ (rows.motion.vel_w if view.in_world else rows.motion.rate_b)
    return SmoothedFlight(rows, form, measured)


class WeakForm(NamedTuple):
    """M bumps over the N rows of a flight, as matrices that are applied to series of rows."""

    middle_s: np.ndarray
    """(M,) middle of each bump, from the first row of the flight [s]."""
    middle_row: np.ndarray
    """(M,) number of the row nearest to the middle."""
    change: sparse.csr_array
    """(M, N) matrix from velocities to mean accelerations."""
    mean: sparse.csr_array
    """(M, N) matrix from accelerations to their means."""

    def take(self, chosen: np.ndarray) -> WeakForm:
        """Return only the `chosen` bumps, (M,) bool."""
        bumps = np.flatnonzero(chosen)
        matrices = (sparse.csr_array(matrix[bumps]) for matrix in (self.change, self.mean))
        return WeakForm(self.middle_s[bumps], self.middle_row[bumps], *matrices)


def weak_form(
    time_s: np.ndarray, good: np.ndarray, width_s: float, hole_s: float, slope: bool = False
) -> WeakForm:
    """Return bumps of `width_s`, half a width apart, without a bad row or a hole inside.

    Rows are at `time_s` (N,) [s]; `good` (N,) bool says which can be used, and those further apart
    than `hole_s` are a hole. With `slope`, the weight is -w'(t) in place of the bump w(t): `mean`
    takes accelerations to means of their derivatives, and `change` takes positions to mean
    accelerations.
    """
    span = np.diff(time_s)
    middle = 0.5 * (time_s[1:] + time_s[:-1])
    usable = good[1:] & good[:-1] & (span <= hole_s)
    centres, rows, columns, bumps, spans = [], [], [], [], []
    for centre in np.arange(time_s[0] + 0.5 * width_s, time_s[-1] - 0.5 * width_s, 0.5 * width_s):
        # Steps between rows that are inside the bump.
        first, last = np.searchsorted(middle, (centre - 0.5 * width_s, centre + 0.5 * width_s))
        if last - first < LEAST_ROWS or not usable[first:last].all():
            continue
        # A hole may begin or end in the bump, with its middle outside.
        if (span[max(first - 1, 0) : last + 1] > hole_s).any():
            continue
        from_centre = middle[first:last] - centre
        # Normalised over the rows: the bump to an integral of 1; its slope so that it is exact for
        # accelerations that are constant or linear in time.
        if slope:
            bump = np.sin(2.0 * np.pi * from_centre / width_s)
            bump -= (bump * span[first:last]).sum() / span[first:last].sum()
            bump /= (bump * from_centre * span[first:last]).sum()
        else:
            bump = np.cos(np.pi * from_centre / width_s) ** 2
            bump /= (bump * span[first:last]).sum()
        rows.append(np.full(last - first, len(centres)))
        columns.append(np.arange(first, last))
        bumps.append(bump)
        spans.append(bump * span[first:last])
        centres.append(centre)
    shape = (len(centres), len(time_s))
    if not centres:
        empty = sparse.csr_array(shape)
        return WeakForm(np.zeros(0), np.zeros(0, int), empty, empty)
    row, column = np.concatenate(rows), np.concatenate(columns)

    def matrix(before: np.ndarray, after: np.ndarray) -> sparse.csr_array:
        places = (np.concatenate([row, row]), np.concatenate([column, column + 1]))
        return sparse.csr_array((np.concatenate([before, after]), places), shape=shape)

    # Mean accelerations are sums of w times the steps of the velocity from row to row. Means of
    # accelerations use both ends of each step (trapezoids).
    bump, weight = np.concatenate(bumps), 0.5 * np.concatenate(spans)
    middle_s = np.array(centres)
    middle_row = nearest(time_s, middle_s)
    return WeakForm(middle_s, middle_row, matrix(-bump, bump), matrix(weight, weight))
