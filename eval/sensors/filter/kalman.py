"""An error-state Kalman filter that uses an IMU and the corners of known gates (NumPy and JAX).

The nominal state is position p, velocity v, attitude R (body to world) and the biases of
accelerometer and gyro. Its error dx = (dp, dv, dtheta, da, dw) is small, with
R_true = R Exp(dtheta), and has the covariance P (Solà 2017, "Quaternion kinematics for the
error-state Kalman filter", sections 5 and 6: local angular error). With a = acc - bias_a and
w = gyro - bias_w, means over dt:

    predict   v += (R Exp(w dt / 2) a + g) dt,  p += (v_before + v_after) dt / 2,  R = R Exp(w dt)
              dp += dv dt,  dv += -R [a]x dtheta dt - R da dt,  dtheta = Exp(-w dt) dtheta - dw dt
    observe   c = C R^T (m - p),  (u, v) = (c_y, c_z) / c_x     of a corner m, camera axes C
              dc = C [R^T (m - p)]x dtheta - C R^T dp
    update    P' = (P^-1 + H^T H / r)^-1,  dx = P' H^T z / r    of residuals z with variance r
    reset     dtheta -> (I - [dtheta / 2]x) dtheta              when R is corrected

The matrix that an update solves is 6 x 6 for any number of corners, because H has nonzero columns
for dp and dtheta only. The first axis of all arrays is the drone.

With delayed observations the filter's state is one delay in the past. A buffer holds the IMU
samples of the last delay. The filter uses each sample when it leaves the buffer, so an observation
that arrives one delay late updates the state of its own time, and the covariance is that of a
filter without delay. The buffered samples then propagate that state to the present. This is the
delayed fusion horizon of PX4's EKF2; Khosravian et al. 2015, "Recursive attitude estimation in the
presence of delayed measurements", compare such predictors.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import GRAVITY
from tracks.common.masks import select
from tracks.geometry.rotation import cross, exp_rot, to_local, to_world
from tracks.geometry.scene import Array

SIZE = 15
"""Size of the error state: position, velocity, attitude, accelerometer bias, gyro bias."""


class ImuNoise(NamedTuple):
    """The IMU's errors as assumed by the filter: spectral densities, each a number or (N,)."""

    acc: Array
    """White noise of the accelerometer [m/s^2/sqrt(Hz)]."""
    gyro: Array
    """White noise of the gyro [rad/s/sqrt(Hz)]."""
    acc_walk: Array
    """Random walk of the accelerometer's bias [m/s^3/sqrt(Hz)]."""
    gyro_walk: Array
    """Random walk of the gyro's bias [rad/s^2/sqrt(Hz)]."""


class FilterState(NamedTuple):
    """State and covariance of the filters of N drones."""

    pos_w: Array
    """(N, 3) position [m]."""
    vel_w: Array
    """(N, 3) velocity [m/s]."""
    rot_w: Array
    """(N, 3, 3) attitude, body to world."""
    acc_bias_b: Array
    """(N, 3) accelerometer bias [m/s^2]."""
    gyro_bias_b: Array
    """(N, 3) gyro bias [rad/s]."""
    covariance: Array
    """(N, 15, 15) covariance of the error state."""


class Corners(NamedTuple):
    """Gate corners in the image of a camera at the body's origin, K for each drone."""

    image: Array
    """(N, K, 2) image coordinates (left, up): tangents of the angles to the optical axis."""
    corner_w: Array
    """(N, K, 3) positions in the map [m]."""
    seen: Array
    """(N, K) bool: whether a corner is detected; others are ignored."""


def start(pos_w: Array, vel_w: Array, rot_w: Array, sigma: Array) -> FilterState:
    """Return the state at the start, with biases of zero.

    Args:
        pos_w: (N, 3) position [m].
        vel_w: (N, 3) velocity [m/s].
        rot_w: (N, 3, 3) attitude, body to world.
        sigma: (15,) or (N, 15) standard deviations of the error, in SI units.
    """
    xp = pos_w.__array_namespace__()
    zero_bias, variance = xp.zeros_like(pos_w), xp.zeros((pos_w.shape[0], SIZE)) + sigma**2
    return FilterState(
        pos_w, vel_w, rot_w, zero_bias, zero_bias, variance[..., None] * xp.eye(SIZE)
    )


def move(state: FilterState, gyro_b: Array, acc_b: Array, dt: Array) -> FilterState:
    """Return the nominal state after `dt`, with the covariance unchanged; see `predict`."""
    xp = gyro_b.__array_namespace__()
    step_s = dt[:, None]
    rotation_b = (gyro_b - state.gyro_bias_b) * step_s
    middle_w = xp.matmul(state.rot_w, exp_rot(0.5 * rotation_b))
    acc_w = to_world(middle_w, acc_b - state.acc_bias_b) - xp.asarray([0.0, 0.0, GRAVITY])
    vel_w = state.vel_w + step_s * acc_w
    return state._replace(
        pos_w=state.pos_w + 0.5 * step_s * (state.vel_w + vel_w),
        vel_w=vel_w,
        rot_w=xp.matmul(state.rot_w, exp_rot(rotation_b)),
    )


def predict(
    state: FilterState, gyro_b: Array, acc_b: Array, dt: Array, noise: ImuNoise
) -> FilterState:
    """Return the state one IMU sample later.

    Args:
        state: the state before.
        gyro_b: (N, 3) measured mean body rates during `dt` [rad/s].
        acc_b: (N, 3) measured mean specific force, in the body axes at the middle of `dt` [m/s^2].
        dt: (N,) duration of the sample [s]; a drone with 0 does not change.
        noise: noise of the IMU.
    """
    xp = gyro_b.__array_namespace__()
    step_s = dt[:, None, None]
    zeros, identity = xp.zeros_like(state.rot_w), xp.zeros_like(state.rot_w) + xp.eye(3)
    acc_by_angle = xp.matmul(state.rot_w, _skew(acc_b - state.acc_bias_b))
    angle_by_angle = exp_rot(-(gyro_b - state.gyro_bias_b) * dt[:, None])
    transition = _blocks(
        [
            [identity, identity * step_s, zeros, zeros, zeros],
            [zeros, identity, -acc_by_angle * step_s, -state.rot_w * step_s, zeros],
            [zeros, zeros, angle_by_angle, zeros, -identity * step_s],
            [zeros, zeros, zeros, identity, zeros],
            [zeros, zeros, zeros, zeros, identity],
        ]
    )
    # Process noise of dp, dv, dtheta, da and dw.
    densities = xp.stack([0.0 * dt + part for part in (0.0, noise.acc, noise.gyro, *noise[2:])], -1)
    process_noise = xp.repeat(densities**2 * dt[:, None], 3, axis=-1)
    covariance = xp.matmul(xp.matmul(transition, state.covariance), xp.matrix_transpose(transition))
    covariance = covariance + process_noise[..., None] * xp.eye(SIZE)
    return move(state, gyro_b, acc_b, dt)._replace(covariance=covariance)


def project(pos_w: Array, rot_w: Array, camera_b: Array, corner_w: Array) -> tuple[Array, Array]:
    """Return the corners' image coordinates (left, up) (N, K, 2), and depths (N, K) [m].

    Image coordinates are tangents of the angles to the optical axis.

    Args:
        pos_w: (N, 3) position [m].
        rot_w: (N, 3, 3) attitude, body to world.
        camera_b: (3, 3) camera axes (forward, left, up) as rows in body axes.
        corner_w: (N, K, 3) positions of the corners [m].
    """
    corner_b = to_local(rot_w[:, None], corner_w - pos_w[:, None])
    corner_c = to_world(camera_b, corner_b)
    return corner_c[..., 1:] / corner_c[..., :1], corner_c[..., 0]


def update_gate(
    state: FilterState, observation: Corners, variance: Array, camera_b: Array
) -> FilterState:
    """Return the state after a measurement of gate corners.

    Args:
        state: the state at the time of the image.
        observation: the detected corners.
        variance: (N, K) variance of each coordinate in `Corners.image`, or one for all.
        camera_b: (3, 3) camera axes (forward, left, up) as rows in body axes.
    """
    xp = state.pos_w.__array_namespace__()
    corner_b = to_local(state.rot_w[:, None], observation.corner_w - state.pos_w[:, None])
    corner_c = to_world(camera_b, corner_b)
    seen = observation.seen & (corner_c[..., 0] > 0.0)
    forward = xp.where(seen, corner_c[..., 0], 1.0)[..., None]
    expected = corner_c[..., 1:] / forward
    # Derivative of the image coordinates by the corner's position in body axes, (N, K, 2, 3).
    image_by_corner = (camera_b[1:] - expected[..., None] * camera_b[0]) / forward[..., None]
    by_pos = -xp.matmul(image_by_corner, xp.matrix_transpose(state.rot_w)[:, None])
    by_angle = xp.matmul(image_by_corner, _skew(corner_b))
    jacobian = xp.concatenate([by_pos, by_angle], axis=-1)  # (N, K, 2, 6)
    weight = (xp.where(seen, 1.0, 0.0) / variance)[..., None]
    residual = xp.where(seen[..., None], observation.image - expected, 0.0)
    rows = jacobian.reshape(*jacobian.shape[:-3], -1, 6)
    weights = (weight + 0.0 * residual).reshape(*rows.shape[:-1], 1)
    transposed = xp.matrix_transpose(rows * weights)
    information = xp.matmul(transposed, rows)  # (N, 6, 6)
    gradient = xp.matmul(transposed, residual.reshape(*rows.shape[:-1], 1))
    # With A the information, g the gradient and U the unit columns of dp and dtheta:
    # P' = P - P U (I + A U^T P U)^-1 A U^T P,  dx = P U (I + A U^T P U)^-1 g.
    covariance_before = state.covariance
    p_u = xp.concatenate(
        [covariance_before[..., 0:3], covariance_before[..., 6:9]], axis=-1
    )  # (N, 15, 6)
    u_p_u = xp.concatenate([p_u[..., 0:3, :], p_u[..., 6:9, :]], axis=-2)
    solved = xp.linalg.solve(xp.eye(6) + xp.matmul(information, u_p_u), xp.concatenate(
        [xp.matmul(information, xp.matrix_transpose(p_u)), gradient], axis=-1))  # fmt: skip
    covariance = covariance_before - xp.matmul(p_u, solved[..., :-1])
    error = xp.matmul(p_u, solved[..., -1:])[..., 0]
    return _corrected(state, error, covariance)


def _corrected(state: FilterState, error: Array, covariance: Array) -> FilterState:
    """Return the state corrected by the error (N, 15), with the covariance after the reset."""
    xp = error.__array_namespace__()
    rotation_b = error[:, 6:9]
    zeros, identity = xp.zeros_like(state.rot_w), xp.zeros_like(state.rot_w) + xp.eye(3)
    reset_angle = identity - 0.5 * _skew(rotation_b)
    reset = _blocks([
        [reset_angle if row == col == 2 else identity if row == col else zeros for col in range(5)]
        for row in range(5)
    ])  # fmt: skip
    covariance = xp.matmul(xp.matmul(reset, covariance), xp.matrix_transpose(reset))
    return FilterState(
        state.pos_w + error[:, 0:3],
        state.vel_w + error[:, 3:6],
        xp.matmul(state.rot_w, exp_rot(rotation_b)),
        state.acc_bias_b + error[:, 9:12],
        state.gyro_bias_b + error[:, 12:15],
        0.5 * (covariance + xp.matrix_transpose(covariance)),
    )


def _skew(vector: Array) -> Array:
    """Return the matrices (..., 3, 3) with [a]x b = a x b."""
    xp = vector.__array_namespace__()
    eye = xp.eye(3)
    return xp.stack([cross(vector, eye[k] + 0.0 * vector) for k in range(3)], axis=-1)


def _blocks(rows: list[list[Array]]) -> Array:
    xp = rows[0][0].__array_namespace__()
    return xp.concatenate([xp.concatenate(row, axis=-1) for row in rows], axis=-2)


class Delayed(NamedTuple):
    """Filters of N drones, and their buffered IMU samples."""

    state: FilterState
    """The state one delay ago."""
    buffer: Array
    """(N, L, 7) the last L IMU samples, oldest first: gyro [rad/s], specific force [m/s^2] and
    duration [s], which is 0 before the flight began."""


def start_delayed(state: FilterState, samples: int) -> Delayed:
    """Return filters that start from `state`, with a delay of `samples` IMU samples."""
    xp = state.pos_w.__array_namespace__()
    return Delayed(state, xp.zeros((state.pos_w.shape[0], samples, 7)))


def step(
    filters: Delayed, gyro_b: Array, acc_b: Array, dt: Array, flew: Array, noise: ImuNoise
) -> Delayed:
    """Return the filters after a new IMU sample; see `predict`.

    Args:
        filters: the filters before.
        gyro_b: (N, 3) measured body rates [rad/s].
        acc_b: (N, 3) measured specific force [m/s^2].
        dt: (N,) duration of the sample [s].
        flew: (N,) bool, drones that have a new sample; the others do not change.
        noise: noise of the IMU.
    """
    xp = gyro_b.__array_namespace__()
    new_sample = xp.concatenate([gyro_b, acc_b, dt[:, None]], axis=-1)[:, None]
    buffer_and_new = xp.concatenate([filters.buffer, new_sample], axis=1)
    oldest = buffer_and_new[:, 0]
    state = predict(filters.state, oldest[:, :3], oldest[:, 3:6], oldest[:, 6], noise)
    return select(flew, Delayed(state, buffer_and_new[:, 1:]), filters)


def current_state(filters: Delayed) -> FilterState:
    """Return the current nominal states, with the covariance of the delayed horizon."""
    state = filters.state
    for index in range(filters.buffer.shape[1]):
        sample = filters.buffer[:, index]
        state = move(state, sample[:, :3], sample[:, 3:6], sample[:, 6])
    return state
