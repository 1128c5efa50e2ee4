"""Flights without a pose: attitude and velocity by gyro and accelerometer from where they start.

A log begins at rest or in hover, so that its first specific force points up. From there the gyro
turns the attitude, and the specific force in it, less gravity, moves the body. What that drifts by
follows from few numbers: the tilt and the velocity at the start, and the biases of gyro and
accelerometer. Drag tells them, as the force across the thrust is against the velocity (Leishman et
al. 2014, doi 10.1109/MCS.2013.2287362); how large it is along each axis is found with them, for the
vehicle file may lack it. All are estimated by least squares with their usual sizes as priors, for
pieces of `PIECE_S` of a flight. Yaw and position start from none, far above any ground.

What is compared in such flights is no derivative of this velocity but the accelerometer itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.sampling import interpolate
from tracks.geometry.rotation import rot_to_quat

PIECE_S = 12.0
"""Tilt, velocity and biases are estimated anew after this [s]."""
WIDTH_S = 0.2
"""Forces are compared as means over this time [s]."""
START_S = 0.1
"""The first specific force is the mean over this time [s]."""
LIKE_GRAVITY = 1.0
"""It is up where it is within this of gravity [m/s^2]; the body starts level otherwise."""
PRIOR = np.repeat([0.03, 0.1, 0.005, 0.1], 3)
"""Standard deviations: tilt [rad] and velocity [m/s] at the start, biases of gyro [rad/s] and
accelerometer [m/s^2], three each."""
LATER = np.repeat([0.05, 1.0, 0.005, 0.1], 3)
"""The same of later pieces."""
DRAG, DRAG_PRIOR = np.array([0.3, 0.3, 0.0]), np.array([0.4, 0.4, 0.02])
"""Usual drag across the thrust and its standard deviation: linear along x and y [1/s], and with the
speed [1/m]."""
FORCE_NOISE = 0.2
"""What a mean force is off a linear drag by [m/s^2]."""
ROUNDS = 6
HIGH_M = 1000.0
"""Height of the start: nothing near."""
UNSEEN = (
    "position, heading and height: wind, ground, and faults of pose or velocity",
    "the accelerometer's own scale, which looks like thrust over mass",
)
"""What a flight without a pose does not show, in words."""


def is_inertial(log: FlightLog) -> bool:
    """Return whether `log` has no position, and an accelerometer and a gyro in its place."""
    has = log.acc_b is not None and np.isfinite(log.acc_b).any(axis=0).all()
    return "pos" in log.partial and "rate" not in log.partial and bool(has)


@dataclass(frozen=True)
class InertialLog(FlightLog):
    """A flight whose pose is by inertia."""

    sway_b: np.ndarray | None = None
    """(N, 3, K) how the drag's acceleration changes with what is not known of the pose, each by its
    standard deviation before the flight [m/s^2]."""


def specific_force_w(log: FlightLog) -> np.ndarray | None:
    """Return the acceleration (N, 3) in the world by the accelerometer of an inertial log."""
    if not isinstance(log, InertialLog) or log.acc_b is None:
        return None
    return (log.rot_w @ log.acc_b[..., None])[..., 0] - [0.0, 0.0, GRAVITY]


def by_inertia(log: FlightLog) -> InertialLog:
    """Return an inertial `log` with position, velocity and attitude by gyro and accelerometer."""
    assert log.acc_b is not None
    time_s = log.time_s
    rate_b, acc_b = (interpolate(time_s, time_s, value) for value in (log.rate_b, log.acc_b))
    rot_w, vel_w = np.empty((len(time_s), 3, 3)), np.zeros((len(time_s), 3))
    known = np.flatnonzero(np.isfinite(log.quat_wxyz).all(axis=1))
    rot, vel, prior = _start(time_s, acc_b), np.zeros(3), PRIOR
    if len(known):
        rot = log.rot_w[known[0]]  # within moments of the first row
    count = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    edges = np.linspace(0, len(time_s) - 1, count + 1).astype(int)
    sway_b = np.zeros((len(time_s), 3, 12 * count))
    for k, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        part = slice(first, last + 1)
        piece = _Piece(time_s[part], rate_b[part], acc_b[part], rot, vel)
        numbers, drag = piece.fitted(prior)
        rot_w[part], vel_w[part] = piece.flown(numbers)
        slopes = np.swapaxes(rot_w[part], 1, 2) @ piece.slopes(rot_w[part], numbers)
        along = np.append(drag, drag.mean())[:, None]
        sway_b[part, :, 12 * k : 12 * k + 12] = -along * slopes * prior
        rot, vel, prior = rot_w[last], vel_w[last], LATER
    pos_w = np.zeros_like(vel_w)
    pos_w[1:] = np.cumsum(vel_w[1:] * np.diff(time_s)[:, None], axis=0)
    pos_w[:, 2] += HIGH_M
    quat = np.asarray(rot_to_quat(rot_w))
    about = {**vars(log), "pos_w": pos_w, "quat_wxyz": quat, "vel_w": vel_w}
    return InertialLog(**{**about, "velocity_derived": False}, sway_b=sway_b)


class _Piece:
    """A piece of a flight, and what its start and the sensors' biases make of it."""

    def __init__(self, time_s: np.ndarray, rate_b: np.ndarray, acc_b: np.ndarray,
                 rot: np.ndarray, vel: np.ndarray) -> None:  # fmt: skip
        self.time_s, self.rate_b, self.acc_b, self.rot, self.vel = time_s, rate_b, acc_b, rot, vel
        self.span = np.diff(time_s)
        each = max(1, round(WIDTH_S / float(np.median(self.span))))
        self.first = np.arange(0, len(time_s), each)
        self.rows = np.diff(np.append(self.first, len(time_s)))

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (M, ...) of `values` (N, ...)."""
        sums = np.add.reduceat(values, self.first, axis=0)
        return sums / self.rows.reshape(-1, *[1] * (values.ndim - 1))

    def flown(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return attitude (N, 3, 3) and velocity (N, 3) with these (12,), see `PRIOR`."""
        tilt, vel, gyro, acc = numbers.reshape(4, 3)
        rate_b = self.rate_b - gyro
        turns = Rotation.from_rotvec(0.5 * (rate_b[1:] + rate_b[:-1]) * self.span[:, None])
        rot_w = np.empty((len(self.time_s), 3, 3))
        rot_w[0] = Rotation.from_rotvec(tilt).as_matrix() @ self.rot
        for k, turn in enumerate(turns.as_matrix()):
            rot_w[k + 1] = rot_w[k] @ turn
        moved = self.summed(self._force_w(rot_w, acc) - [0.0, 0.0, GRAVITY])
        return rot_w, self.vel + vel + moved

    def fitted(self, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (12,) by which drag is against the velocity, and its usual size."""
        numbers, drag, usual = np.zeros(12), DRAG, DRAG[:2]
        for _ in range(ROUNDS):
            rot_w, vel_w = self.flown(numbers)
            to_body = np.swapaxes(rot_w, 1, 2)
            vel_b = (to_body @ vel_w[..., None])[:, :2, 0]
            speed = np.linalg.norm(vel_w, axis=1)[:, None]
            per = drag[:2] + drag[2] * speed
            columns = np.zeros((len(speed), 2, 15))
            columns[..., :12] = -per[..., None] * (to_body @ self.slopes(rot_w, numbers))[:, :2]
            columns[:, [0, 1], [9, 10]] += 1.0
            columns[:, [0, 1], [12, 13]] = -vel_b
            columns[..., 14] = -speed * vel_b
            force = self.acc_b[:, :2] - numbers[9:11]
            left = self.means(force + per * vel_b).reshape(-1) / FORCE_NOISE
            design = self.means(columns).reshape(-1, 15) / FORCE_NOISE
            now, middle = np.append(numbers, drag), np.append(np.zeros(12), DRAG)
            size = np.append(prior, DRAG_PRIOR)
            design = np.concatenate([design, np.diag(1.0 / size)])
            left = np.concatenate([left, (middle - now) / size])
            now = now + np.linalg.lstsq(design, left, rcond=None)[0]
            numbers, drag = now[:12], np.maximum(now[12:], 0.0)
            usual = drag[:2] + drag[2] * float(speed.mean())
        return numbers, usual

    def summed(self, values: np.ndarray) -> np.ndarray:
        """Return the integral (N, ...) of `values` (N, ...) from the first row."""
        out = np.zeros_like(values)
        span = self.span.reshape(-1, *[1] * (values.ndim - 1))
        out[1:] = np.cumsum(0.5 * (values[1:] + values[:-1]) * span, axis=0)
        return out

    def _force_w(self, rot_w: np.ndarray, bias_b: np.ndarray) -> np.ndarray:
        return (rot_w @ (self.acc_b - bias_b)[..., None])[..., 0]

    def slopes(self, rot_w: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return how the velocity changes with the numbers (N, 3, 12)."""
        count = len(self.time_s)
        each = np.broadcast_to(np.eye(3), (count, 3, 3))
        force_w = self._force_w(rot_w, numbers[9:])[:, :, None]
        tilts = np.concatenate([each, -self.summed(rot_w)], axis=2)  # by tilt and gyro bias
        by_tilt, by_gyro = np.split(self.summed(np.cross(tilts, force_w, axis=1)), 2, axis=2)
        return np.concatenate([by_tilt, each, by_gyro, -self.summed(rot_w)], axis=2)


def _start(time_s: np.ndarray, acc_b: np.ndarray) -> np.ndarray:
    """Return the attitude (3, 3) in which the first specific force is up."""
    up = acc_b[time_s <= time_s[0] + START_S].mean(axis=0)
    size = float(np.linalg.norm(up))
    if abs(size - GRAVITY) > LIKE_GRAVITY:
        return np.eye(3)
    left = np.cross(up / size, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up / size), left, up / size])
