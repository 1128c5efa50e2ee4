"""A Kalman filter with delayed observations: its state is one delay in the past (NumPy and JAX).

A buffer holds the IMU samples of the last delay. The filter uses each sample when it leaves the
buffer, so an observation that arrives one delay late updates the state of its own time, and the
covariance is that of a filter without delay. The buffered samples then propagate that state to the
present. This is the delayed fusion horizon of PX4's EKF2; Khosravian et al. 2015, "Recursive
attitude estimation in the presence of delayed measurements", compare such predictors.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.filter.kalman import FilterState, ImuNoise, move, predict
from tracks.common.masks import select
from tracks.geometry.scene import Array


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
