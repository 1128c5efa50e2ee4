"""Flights without a pose: attitude and velocity are computed from gyro and accelerometer.

Such a log (here: inertial log) begins at rest or in hover, so its first specific force points up.
From there the gyro is integrated to the attitude, and the specific force minus gravity to the
velocity. Yaw and horizontal position begin at 0. The drift depends on a few parameters: tilt and
velocity at the start, biases of gyro and accelerometer, and later changes of the tilt. Drag makes
them observable, as the force across the thrust is opposite to the velocity (Leishman et al. 2014,
doi 10.1109/MCS.2013.2287362). The drag coefficients, which all flights of a vehicle share, are
estimated too, since the vehicle file may lack them. The estimate is least squares with priors.

In such flights the model is compared with the accelerometer, not with a derivative of the velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import interpolate
from tracks.geometry.rotation import rot_to_quat

PIECE_S = 12.0
"""Duration of a piece: tilt, velocity and biases are estimated anew for each [s]."""
WIDTH_S = 0.2
"""Forces are compared as means over this time [s]."""
KNOT_S = 1.0
"""Time between knots, at which the estimated tilt may change (a random walk) [s]."""
WALK, LEAST_WALK = 0.02, 0.001
"""Standard deviation of the tilt's change at a knot: value before it is estimated, and smallest
value [rad]. A gyro that was sampled without a filter, or interpolated, drifts far more than its
noise alone would cause."""
DRAWS = 8
"""Number of random draws of the velocity's error."""
START_S = 0.1
"""The first specific force is the mean over this time [s]."""
LIKE_GRAVITY = 1.0
"""The first specific force shows which way is up if its size is within this of gravity [m/s^2].
Otherwise the body is assumed to start level."""
PRIOR = np.repeat([0.03, 0.1, 0.005, 0.1], 3)
"""(12,) prior standard deviations for a flight's first piece, three axes each: tilt at the start
[rad], velocity at the start [m/s], bias of gyro [rad/s], bias of accelerometer [m/s^2]."""
LATER = np.repeat([0.1, 1.0, 0.005, 0.1], 3)
"""(12,) the same standard deviations for later pieces, whose start is less certain."""
DRAG, DRAG_PRIOR = np.array([0.3, 0.3, 0.0]), np.array([0.4, 0.4, 0.02])
"""Prior mean and standard deviation of the drag's coefficients: linear drag along body x and y
[1/s], and drag along both that grows with the speed [1/m]."""
FORCE_NOISE, LEAST_NOISE = 0.2, 0.02
"""Standard deviation of the residual between a mean force and the drag: value before it is
estimated, and smallest value [m/s^2]."""
ROUNDS, SETTLED = 20, 0.003
"""Largest number of rounds of the fit, and tolerance: the fit ends after a round that changes the
drag [1/s] and the relative noise by less than this."""
HIGH_M = 1000.0
"""Height of the start, so high that the ground has no effect [m]."""
UNSEEN = (
    "position, heading and height: wind, ground, and faults of pose or velocity",
    "the accelerometer's own scale, which has the same effect as thrust over mass",
    "the gyro's own scale if they have no attitude, which has the same effect as inertia",
)
"""What a flight without a pose does not show, in words."""


def is_inertial(log: FlightLog) -> bool:
    """Return whether `log` has no position, but an accelerometer and a gyro."""
    has_acc = log.acc_b is not None and np.isfinite(log.acc_b).any(axis=0).all()
    return "pos" in log.partial and "rate" not in log.partial and bool(has_acc)


@dataclass(frozen=True)
class InertialLog(FlightLog):
    """A flight whose pose is integrated from gyro and accelerometer."""

    pose_slope_b: np.ndarray | None = None
    """(N, 3, K) change of the drag's acceleration, in body axes, if one of the K parameters of the
    pose changes by its prior standard deviation [m/s^2]."""
    vel_noise_b: np.ndarray | None = None
    """(N, 3, `DRAWS`) draws of the velocity's error, by the tilt's random walk, in body axes
    [m/s]."""


def specific_force_w(log: FlightLog) -> np.ndarray | None:
    """Return the acceleration (N, 3) in the world by the accelerometer of an inertial log."""
    if not isinstance(log, InertialLog) or log.acc_b is None:
        return None
    return (log.rot_w @ log.acc_b[..., None])[..., 0] - [0.0, 0.0, GRAVITY]


def posed(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """Return `logs` of one vehicle; inertial ones get a pose from gyro and accelerometer."""
    flights = [_pieces(log) if is_inertial(log) else None for log in logs]
    drag = _fitted([pieces for pieces in flights if pieces]) if any(flights) else DRAG
    return [
        _whole(log, pieces, drag) if pieces else log
        for log, pieces in zip(logs, flights, strict=True)
    ]


def _fitted(flights: Sequence[Sequence[_Piece]]) -> np.ndarray:
    """Fit the parameters of all pieces in place, and return the drag (3,) that they share.

    A piece's start stays fixed: coupled starts make the rounds diverge in long flights. Noise of
    the force and random walk of the tilt are estimated as well, the walk by expectation
    maximisation (Dempster et al. 1977).
    """
    drag, noise = DRAG, FORCE_NOISE
    pieces = [piece for flight in flights for piece in flight]
    for _ in range(ROUNDS):
        hessian, gradient = np.diag(DRAG_PRIOR**-2), (DRAG - drag) / DRAG_PRIOR**2
        eliminated_pieces, variances = [], []
        for piece in pieces:
            design, right_side = piece.sides(drag, noise)
            own, shared = design[:, :-3], np.column_stack([right_side, design[:, -3:]])
            covariance = np.linalg.inv(own.T @ own)
            to_own = covariance @ (own.T @ shared)
            # What the piece's own parameters do not explain is information on the shared drag
            # (Schur complement).
            unexplained = shared - own @ to_own
            hessian = hessian + unexplained[:, 1:].T @ unexplained[:, 1:]
            gradient = gradient + unexplained[:, 1:].T @ unexplained[:, 0]
            eliminated_pieces.append((piece, to_own))
            variances.append(np.diag(covariance)[12:])
        change = np.maximum(np.linalg.solve(hessian, gradient), -drag)
        # Back-substitution: the change of the drag gives the changes of each piece's parameters.
        for piece, to_own in eliminated_pieces:
            piece.numbers = piece.numbers + to_own[:, 0] - to_own[:, 1:] @ change
        drag = drag + change
        # New estimates of the noise and of the tilt's random walk.
        residuals = np.concatenate([piece.off(drag, *piece.flown()) for piece in pieces])
        old_noise, noise = noise, max(float(np.sqrt((residuals**2).mean())), LEAST_NOISE)
        changes = np.concatenate([piece.numbers[12:] for piece in pieces])
        if len(changes):
            walk = float(np.sqrt(np.mean(changes**2 + np.concatenate(variances))))
            for piece in pieces:
                piece.prior[12:] = max(walk, LEAST_WALK)
        if np.abs(change).max() < SETTLED and abs(noise / old_noise - 1.0) < SETTLED:
            break
    return drag


def _pieces(log: FlightLog) -> list[_Piece]:
    """Return the pieces of a flight, each fitted alone; a piece starts where the previous ends."""
    assert log.acc_b is not None
    time_s = log.time_s
    rate_b, acc_b = (interpolate(time_s, time_s, value) for value in (log.rate_b, log.acc_b))
    known = np.flatnonzero(np.isfinite(log.quat_wxyz).all(axis=1))
    # If the log has an attitude, its first value is within a few rows of the log's first row.
    rot = log.rot_w[known[0]] if len(known) else _start(time_s, acc_b)
    count = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    edges = np.linspace(0, len(time_s) - 1, count + 1).astype(int)
    parts = [slice(first, last + 1) for first, last in pairwise(edges)]
    pieces = list[_Piece]()
    for part in parts:
        prior = LATER if pieces else PRIOR
        pieces.append(_Piece(time_s[part], rate_b[part], acc_b[part], rot, prior))
        if len(pieces) > 1:  # start where the previous piece ends
            rot_w, vel_w = pieces[-2].flown()
            pieces[-1].rot, pieces[-1].vel = rot_w[-1], vel_w[-1]
        if len(parts) > 1:
            _fitted([pieces[-1:]])
    return pieces


def _whole(log: FlightLog, pieces: Sequence[_Piece], drag: np.ndarray) -> InertialLog:
    """Return `log` with the pose of its `pieces`; neighbouring pieces share one row."""
    rot_w, vel_w = np.empty((len(log.time_s), 3, 3)), np.zeros((len(log.time_s), 3))
    pose_slope_b = np.zeros((len(log.time_s), 3, sum(len(piece.prior) for piece in pieces)))
    vel_noise_b, rng = np.zeros((*vel_w.shape, DRAWS)), np.random.default_rng(0)
    first, column = 0, 0
    for piece in pieces:
        part = slice(first, first + len(piece.time_s))
        first = part.stop - 1
        rot_w[part], vel_w[part] = piece.flown()
        slopes = np.swapaxes(rot_w[part], 1, 2) @ piece.slopes(rot_w[part])
        errors_w = [piece.velocity_error(rot_w[part], rng) for _ in range(DRAWS)]
        vel_noise_b[part] = np.swapaxes(rot_w[part], 1, 2) @ np.stack(errors_w, axis=-1)
        drag_xy = drag[:2] + drag[2] * float(np.linalg.norm(vel_w[part], axis=1).mean())
        drag_xyz = np.append(drag_xy, drag_xy.mean())[:, None]
        columns = slice(column, column + len(piece.prior))
        column = columns.stop
        pose_slope_b[part, :, columns] = -drag_xyz * slopes * piece.prior
    pos_w = np.zeros_like(vel_w)
    pos_w[1:] = np.cumsum(vel_w[1:] * np.diff(log.time_s)[:, None], axis=0)
    pos_w[:, 2] += HIGH_M
    quat = np.asarray(rot_to_quat(rot_w))
    fields: dict[str, Any] = {**vars(log), "pos_w": pos_w, "quat_wxyz": quat, "vel_w": vel_w}
    fields["velocity_derived"] = False
    return InertialLog(**fields, pose_slope_b=pose_slope_b, vel_noise_b=vel_noise_b)


class _Piece:
    """A piece of a flight: its signals, its start, and its parameters `numbers` (P,).

    The P = 12 + 2 K parameters are the 12 of `PRIOR`, and the change of the tilt about x and y at
    each of K knots. The signals have N rows, which form M groups of `WIDTH_S`.
    """

    def __init__(self, time_s: np.ndarray, rate_b: np.ndarray, acc_b: np.ndarray,
                 rot: np.ndarray, prior: np.ndarray) -> None:  # fmt: skip
        self.time_s, self.rate_b, self.acc_b, self.rot = time_s, rate_b, acc_b, rot
        self.vel, self.span = np.zeros(3), np.diff(time_s)
        times = np.arange(time_s[0] + KNOT_S, time_s[-1] - 0.5 * KNOT_S, KNOT_S)
        self.knots = np.searchsorted(time_s, times)
        self.prior = np.append(prior, np.full(2 * len(self.knots), WALK))
        self.numbers = np.zeros(len(self.prior))
        each = max(1, round(WIDTH_S / float(np.median(self.span))))
        self.first = np.arange(0, len(time_s), each)
        self.rows = np.diff(np.append(self.first, len(time_s)))

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (M, ...) of `values` (N, ...) over each group of rows."""
        sums = np.add.reduceat(values, self.first, axis=0)
        return sums / self.rows.reshape(-1, *[1] * (values.ndim - 1))

    def flown(self) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude (N, 3, 3) and velocity (N, 3) in the world by the present parameters."""
        tilt, vel, gyro, _ = self.numbers[:12].reshape(4, 3)
        rate_b = self.rate_b - gyro
        turns = Rotation.from_rotvec(0.5 * (rate_b[1:] + rate_b[:-1]) * self.span[:, None])
        rot_w = np.empty((len(self.time_s), 3, 3))
        rot_w[0] = Rotation.from_rotvec(tilt).as_matrix() @ self.rot
        for k, turn in enumerate(turns.as_matrix()):
            rot_w[k + 1] = rot_w[k] @ turn
        walk = np.zeros((len(self.time_s), 3))
        for knot, change in zip(self.knots, self.numbers[12:].reshape(-1, 2), strict=True):
            walk[knot:, :2] += change
        rot_w = Rotation.from_rotvec(walk).as_matrix() @ rot_w
        moved = self._integral(self._force_w(rot_w) - [0.0, 0.0, GRAVITY])
        return rot_w, self.vel + vel + moved

    def off(self, drag: np.ndarray, rot_w: np.ndarray, vel_w: np.ndarray) -> np.ndarray:
        """Return the residuals (M, 2) of mean forces along body x and y [m/s^2] for `drag`."""
        vel_b = (np.swapaxes(rot_w, 1, 2) @ vel_w[..., None])[:, :2, 0]
        drag_xy = drag[:2] + drag[2] * np.linalg.norm(vel_w, axis=1)[:, None]
        return self.means(self.acc_b[:, :2] - self.numbers[9:11] + drag_xy * vel_b)

    def sides(self, drag: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the linear equations of a round: their matrix (R, P + 3) and right side (R,).

        Unknown are the changes of the P parameters and of the drag's coefficients. The first rows
        are the mean forces, the last P rows the priors of the parameters.
        """
        rot_w, vel_w = self.flown()
        to_body = np.swapaxes(rot_w, 1, 2)
        vel_b = (to_body @ vel_w[..., None])[:, :2, 0]
        speed = np.linalg.norm(vel_w, axis=1)[:, None]
        drag_xy = drag[:2] + drag[2] * speed
        count = len(self.prior)
        columns = np.zeros((len(speed), 2, count + 3))
        columns[..., :count] = -drag_xy[..., None] * (to_body @ self.slopes(rot_w))[:, :2]
        columns[:, [0, 1], [9, 10]] += 1.0
        columns[:, [0, 1], [count, count + 1]] = -vel_b
        columns[..., -1] = -speed * vel_b
        design = self.means(columns).reshape(-1, count + 3) / noise
        residual = self.off(drag, rot_w, vel_w).reshape(-1) / noise
        prior = np.eye(count, count + 3) / self.prior[:, None]
        return np.concatenate([design, prior]), np.append(residual, -self.numbers / self.prior)

    def velocity_error(self, rot_w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return a random draw (N, 3) of the velocity's error from the tilt's random walk."""
        walk = float(self.prior[12]) if len(self.knots) else 0.0
        step = float(np.median(self.span))
        steps = walk * np.sqrt(step / KNOT_S) * rng.normal(size=(len(self.time_s), 3))
        return self._integral(np.cross(np.cumsum(steps, axis=0), self._force_w(rot_w)))

    def _integral(self, values: np.ndarray) -> np.ndarray:
        """Return the integral (N, ...) over time of `values` (N, ...), from the first row on."""
        return np.asarray(cumulative_trapezoid(values, self.time_s, axis=0, initial=0))

    def _force_w(self, rot_w: np.ndarray) -> np.ndarray:
        """Return the specific force (N, 3) in the world, without the accelerometer's bias."""
        return (rot_w @ (self.acc_b - self.numbers[9:12])[..., None])[..., 0]

    def slopes(self, rot_w: np.ndarray) -> np.ndarray:
        """Return the derivative (N, 3, P) of the velocity by the P parameters."""
        count = len(self.time_s)
        each = np.broadcast_to(np.eye(3), (count, 3, 3))
        force_w = self._force_w(rot_w)[:, :, None]
        by_bias = -self._integral(rot_w)
        tilts = np.concatenate([each, by_bias], axis=2)  # by tilt and gyro bias
        by_tilt, by_gyro = np.split(self._integral(np.cross(tilts, force_w, axis=1)), 2, axis=2)
        row, by_xy = np.arange(count)[:, None, None], by_tilt[..., :2]
        by_walk = [np.where(row >= knot, by_xy - by_xy[knot], 0.0) for knot in self.knots]
        return np.concatenate([by_tilt, each, by_gyro, by_bias, *by_walk], axis=2)


def _start(time_s: np.ndarray, acc_b: np.ndarray) -> np.ndarray:
    """Return the attitude (3, 3) in which the first specific force points up."""
    up = acc_b[time_s <= time_s[0] + START_S].mean(axis=0)
    if abs(float(np.linalg.norm(up)) - GRAVITY) > LIKE_GRAVITY:
        return np.eye(3)
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
