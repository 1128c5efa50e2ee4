"""Flights without a pose: computes attitude and velocity from gyro and accelerometer.

Specific force is what an accelerometer measures: acceleration minus gravity. A log begins at rest
or in hover, so its first specific force points up. From there the gyro is integrated to the
attitude, and the specific force plus gravity to the velocity. The result drifts, but its error
depends on few numbers: tilt and velocity at the start, and the biases of gyro and accelerometer.
Drag makes these identifiable, as the force across the thrust is opposite to the velocity (Leishman
et al. 2014, doi 10.1109/MCS.2013.2287362). The drag coefficients are estimated, too, since the
vehicle file may lack them; all flights of a vehicle share them. The fit is least squares, with
usual sizes as priors, over pieces of a flight that last `PIECE_S`. Yaw and position start at 0, and
the height far above any ground.

In such flights the model is compared with the accelerometer, not with a derivative of the velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import interpolate
from tracks.geometry.rotation import rot_to_quat

PIECE_S = 12.0
"""Length of a piece of a flight; each has its own tilt, velocity and biases [s]."""
WIDTH_S = 0.2
"""Time over which forces are averaged before they are compared [s]."""
START_S = 0.1
"""Time over which the first specific force is averaged [s]."""
LIKE_GRAVITY = 1.0
"""The first specific force counts as up if its size differs from gravity by less than this [m/s^2].
Otherwise the body starts level."""
PRIOR = np.repeat([0.03, 0.1, 0.005, 0.1], 3)
"""(12,) prior standard deviations of a piece's numbers: tilt [rad] and velocity [m/s] at its start,
biases of gyro [rad/s] and accelerometer [m/s^2], three each."""
LATER = np.repeat([0.05, 1.0, 0.005, 0.1], 3)
"""(12,) prior standard deviations of the pieces after the first one."""
DRAG, DRAG_PRIOR = np.array([0.3, 0.3, 0.0]), np.array([0.4, 0.4, 0.02])
"""Usual drag across the thrust and its prior standard deviation: linear drag along x and along y
[1/s], and drag that grows with the speed [1/m]."""
FORCE_NOISE, LEAST_NOISE = 0.2, 0.02
"""RMS difference between a mean force and such a drag: first guess, and lower limit [m/s^2]."""
ROUNDS = 6
"""Number of Gauss-Newton steps of the fit."""
HIGH_M = 1000.0
"""Height of the start, far from the ground and its effects [m]."""
UNSEEN = (
    "position, heading and height: wind, ground, and faults of pose or velocity",
    "the accelerometer's own scale, which has the same effect as thrust over mass",
    "the gyro's own scale if they have no attitude, which has the same effect as inertia",
)
"""Quantities that are not identifiable from a flight without a pose, in words."""


def is_inertial(log: FlightLog) -> bool:
    """Return whether `log` has no position, and an accelerometer and a gyro in its place."""
    has_accelerometer = log.acc_b is not None and np.isfinite(log.acc_b).any(axis=0).all()
    return "pos" in log.partial and "rate" not in log.partial and bool(has_accelerometer)


@dataclass(frozen=True)
class InertialLog(FlightLog):
    """A flight whose pose is computed from gyro and accelerometer."""

    pose_slope_b: np.ndarray | None = None
    """(N, 3, K) change of the drag's acceleration, in body axes, by one prior standard deviation of
    each of K unknown numbers of the pose [m/s^2]."""


def specific_force_w(log: FlightLog) -> np.ndarray | None:
    """Return the acceleration (N, 3) in the world from an inertial log's accelerometer [m/s^2].

    None for another log.
    """
    if not isinstance(log, InertialLog) or log.acc_b is None:
        return None
    return (log.rot_w @ log.acc_b[..., None])[..., 0] - [0.0, 0.0, GRAVITY]


def posed(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """Return `logs` of one vehicle; inertial ones get a pose from gyro and accelerometer."""
    inertial_logs = iter(by_inertia([log for log in logs if is_inertial(log)]))
    return [next(inertial_logs) if is_inertial(log) else log for log in logs]


def by_inertia(logs: Sequence[FlightLog]) -> list[InertialLog]:
    """Return `logs` of one vehicle with poses that are computed from gyro and accelerometer.

    All of them must be inertial logs (see `is_inertial`).
    """
    flights = [_pieces(log) for log in logs]
    drag = _fit_drag(flights) if flights else DRAG
    return [_with_pose(log, pieces, drag) for log, pieces in zip(logs, flights, strict=True)]


def _fit_drag(flights: Sequence[Sequence[_Piece]]) -> np.ndarray:
    """Fit the numbers of all pieces and the drag that they share; return this drag (3,).

    The numbers are set in the pieces. `flights` holds the pieces of each flight.
    """
    drag, noise = DRAG, FORCE_NOISE
    for _ in range(ROUNDS):
        hessian, gradient = np.diag(DRAG_PRIOR**-2), (DRAG - drag) / DRAG_PRIOR**2
        eliminated = []
        for piece in (one for pieces in flights for one in pieces):
            design, right_side = piece.sides(drag, noise)
            own_columns, shared = design[:, :12], np.column_stack([right_side, design[:, 12:]])
            own_solution = np.linalg.lstsq(own_columns, shared, rcond=None)[0]
            # What the piece's own numbers do not explain is information on the shared drag.
            unexplained = shared - own_columns @ own_solution
            hessian = hessian + unexplained[:, 1:].T @ unexplained[:, 1:]
            gradient = gradient + unexplained[:, 1:].T @ unexplained[:, 0]
            eliminated.append((piece, own_solution))
        change = np.maximum(np.linalg.solve(hessian, gradient), -drag)
        for piece, own_solution in eliminated:
            piece.numbers = piece.numbers + own_solution[:, 0] - own_solution[:, 1:] @ change
        drag = drag + change
        for pieces in flights:
            for last, piece in pairwise(pieces):
                piece.begin_after(last)
        errors = np.concatenate([one.off(drag) for pieces in flights for one in pieces])
        noise = max(float(np.sqrt((errors**2).mean())), LEAST_NOISE)
    return drag


def _pieces(log: FlightLog) -> list[_Piece]:
    """Return the pieces of a flight, each of which begins where the last one ends.

    Several pieces are fitted one by one, so that the end of each is known.
    """
    assert log.acc_b is not None
    time_s = log.time_s
    rate_b, acc_b = (interpolate(time_s, time_s, value) for value in (log.rate_b, log.acc_b))
    known = np.flatnonzero(np.isfinite(log.quat_wxyz).all(axis=1))
    # A log that has an attitude has one shortly after its first row.
    rot = log.rot_w[known[0]] if len(known) else _start_attitude(time_s, acc_b)
    count = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    edges = np.linspace(0, len(time_s) - 1, count + 1).astype(int)
    parts = [slice(first, last + 1) for first, last in pairwise(edges)]
    pieces = list[_Piece]()
    for part in parts:
        prior = LATER if pieces else PRIOR
        pieces.append(_Piece(time_s[part], rate_b[part], acc_b[part], rot, prior))
        if len(pieces) > 1:
            pieces[-1].begin_after(pieces[-2])
        if len(parts) > 1:
            _fit_drag([pieces[-1:]])
    return pieces


def _with_pose(log: FlightLog, pieces: Sequence[_Piece], drag: np.ndarray) -> InertialLog:
    """Return `log` with the pose of its `pieces`; two neighbouring pieces share one row.

    `drag` (3,) is the fitted drag.
    """
    rot_w, vel_w = np.empty((len(log.time_s), 3, 3)), np.zeros((len(log.time_s), 3))
    pose_slope_b = np.zeros((len(log.time_s), 3, 12 * len(pieces)))
    next_row = 0
    for k, piece in enumerate(pieces):
        part = slice(next_row, next_row + len(piece.time_s))
        next_row = part.stop - 1
        rot_w[part], vel_w[part] = piece.flown()
        slopes = np.swapaxes(rot_w[part], 1, 2) @ piece.slopes(rot_w[part])
        horizontal = drag[:2] + drag[2] * float(np.linalg.norm(vel_w[part], axis=1).mean())
        drag_rate = np.append(horizontal, horizontal.mean())[:, None]
        pose_slope_b[part, :, 12 * k : 12 * k + 12] = -drag_rate * slopes * piece.prior
    pos_w = np.zeros_like(vel_w)
    pos_w[1:] = np.cumsum(vel_w[1:] * np.diff(log.time_s)[:, None], axis=0)
    pos_w[:, 2] += HIGH_M
    quat = np.asarray(rot_to_quat(rot_w))
    about = {**vars(log), "pos_w": pos_w, "quat_wxyz": quat, "vel_w": vel_w}
    return InertialLog(**{**about, "velocity_derived": False}, pose_slope_b=pose_slope_b)


class _Piece:
    """A piece of a flight with N rows: signals, start, and the numbers (12,) that `PRIOR` lists."""

    def __init__(self, time_s: np.ndarray, rate_b: np.ndarray, acc_b: np.ndarray,
                 rot: np.ndarray, prior: np.ndarray) -> None:  # fmt: skip
        self.time_s, self.rate_b, self.acc_b, self.rot = time_s, rate_b, acc_b, rot
        self.vel, self.prior, self.numbers = np.zeros(3), prior, np.zeros(12)
        self.span = np.diff(time_s)
        rows_per_mean = max(1, round(WIDTH_S / float(np.median(self.span))))
        self.first = np.arange(0, len(time_s), rows_per_mean)
        self.rows = np.diff(np.append(self.first, len(time_s)))

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (M, ...) of `values` (N, ...) over times of `WIDTH_S`."""
        sums = np.add.reduceat(values, self.first, axis=0)
        return sums / self.rows.reshape(-1, *[1] * (values.ndim - 1))

    def flown(self) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude (N, 3, 3) and velocity (N, 3), with the present numbers."""
        tilt, vel, gyro, _ = self.numbers.reshape(4, 3)
        rate_b = self.rate_b - gyro
        turns = Rotation.from_rotvec(0.5 * (rate_b[1:] + rate_b[:-1]) * self.span[:, None])
        rot_w = np.empty((len(self.time_s), 3, 3))
        rot_w[0] = Rotation.from_rotvec(tilt).as_matrix() @ self.rot
        for k, turn in enumerate(turns.as_matrix()):
            rot_w[k + 1] = rot_w[k] @ turn
        moved = self._integral(self._force_w(rot_w) - [0.0, 0.0, GRAVITY])
        return rot_w, self.vel + vel + moved

    def begin_after(self, before: _Piece) -> None:
        """Start where the piece `before` ends."""
        rot_w, vel_w = before.flown()
        self.rot, self.vel = rot_w[-1], vel_w[-1]

    def off(self, drag: np.ndarray) -> np.ndarray:
        """Return the mean forces (M, 2) along x and y minus those of the `drag` (3,) [m/s^2]."""
        rot_w, vel_w = self.flown()
        vel_b = (np.swapaxes(rot_w, 1, 2) @ vel_w[..., None])[:, :2, 0]
        drag_rate = drag[:2] + drag[2] * np.linalg.norm(vel_w, axis=1)[:, None]
        return self.means(self.acc_b[:, :2] - self.numbers[9:11] + drag_rate * vel_b)

    def sides(self, drag: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the two sides of the equations of a step: matrix (R, 15) and right side (R,).

        The unknowns are changes of the piece's 12 numbers and of the 3 drags. The first equations
        are those of the mean forces, in units of `noise`, the last 12 the priors of the numbers.
        """
        rot_w, vel_w = self.flown()
        to_body = np.swapaxes(rot_w, 1, 2)
        vel_b = (to_body @ vel_w[..., None])[:, :2, 0]
        speed = np.linalg.norm(vel_w, axis=1)[:, None]
        drag_rate = drag[:2] + drag[2] * speed
        columns = np.zeros((len(speed), 2, 15))
        columns[..., :12] = -drag_rate[..., None] * (to_body @ self.slopes(rot_w))[:, :2]
        columns[:, [0, 1], [9, 10]] += 1.0
        columns[:, [0, 1], [12, 13]] = -vel_b
        columns[..., 14] = -speed * vel_b
        design = self.means(columns).reshape(-1, 15) / noise
        right_side = self.off(drag).reshape(-1) / noise
        prior = np.eye(12, 15) / self.prior[:, None]
        return np.concatenate([design, prior]), np.append(right_side, -self.numbers / self.prior)

    def _integral(self, values: np.ndarray) -> np.ndarray:
        """Return the integral (N, ...) over time of `values` (N, ...), from the first row on."""
        return np.asarray(cumulative_trapezoid(values, self.time_s, axis=0, initial=0))

    def _force_w(self, rot_w: np.ndarray) -> np.ndarray:
        """Return the specific force (N, 3) in the world, less the accelerometer's bias."""
        return (rot_w @ (self.acc_b - self.numbers[9:])[..., None])[..., 0]

    def slopes(self, rot_w: np.ndarray) -> np.ndarray:
        """Return the derivative (N, 3, 12) of the velocity in the world by the 12 numbers."""
        count = len(self.time_s)
        identity = np.broadcast_to(np.eye(3), (count, 3, 3))
        force_w = self._force_w(rot_w)[:, :, None]
        # The attitude's change by the tilt at the start, and by the bias of the gyro.
        tilts = np.concatenate([identity, -self._integral(rot_w)], axis=2)
        by_tilt, by_gyro = np.split(self._integral(np.cross(tilts, force_w, axis=1)), 2, axis=2)
        return np.concatenate([by_tilt, identity, by_gyro, -self._integral(rot_w)], axis=2)


def _start_attitude(time_s: np.ndarray, acc_b: np.ndarray) -> np.ndarray:
    """Return the attitude (3, 3) in which the first specific force points up."""
    up = acc_b[time_s <= time_s[0] + START_S].mean(axis=0)
    size = float(np.linalg.norm(up))
    if abs(size - GRAVITY) > LIKE_GRAVITY:
        return np.eye(3)
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
