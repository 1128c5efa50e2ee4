"""The filter with observations that come late: it lives one delay ago (numpy and JAX).

IMU samples wait in a buffer as long as the delay. The filter takes each when it leaves the buffer,
so an observation meets the state of its own time, and the covariance stays that of an undelayed
filter; the buffer carries that state to the present (the delayed horizon of PX4's EKF2; Khosravian
et al. 2015, "Recursive attitude estimation in the presence of delayed measurements", compare such
predictors). Observations that come sooner wait until the horizon is there.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.filter.kalman import FilterState, ImuNoise, move, predict
from tracks.common.masks import select
from tracks.geometry.scene import Array


class Delayed(NamedTuple):
    """Filters of N drones, and their pending measurements."""

    state: FilterState
    """At the horizon, one delay ago."""
    waiting: Array
    """(N, L, 7) the last L IMU samples, oldest first: gyro [rad/s], specific force [m/s^2] and
    their length [s], 0 before the flight began."""


def wait(state: FilterState, samples: int) -> Delayed:
    """Return filters that start from `state`, for a delay of `samples` IMU samples."""
    xp = state.pos_w.__array_namespace__()
    return Delayed(state, xp.zeros((state.pos_w.shape[0], samples, 7)))


def step(
    filters: Delayed, gyro_b: Array, acc_b: Array, dt: Array, flew: Array, noise: ImuNoise
) -> Delayed:
    """Return the filters after an IMU sample has come; see `predict`.

    Args:
        filters: before.
        gyro_b: (N, 3) [rad/s].
        acc_b: (N, 3) [m/s^2].
        dt: (N,) its length [s].
        flew: (N,) bool, the rows that it is for; the others stay as they are.
        noise: of the IMU.
    """
    xp = gyro_b.__array_namespace__()
    new = xp.concatenate([gyro_b, acc_b, dt[:, None]], axis=-1)[:, None]
    queue = xp.concatenate([filters.waiting, new], axis=1)
    first = queue[:, 0]
    state = predict(filters.state, first[:, :3], first[:, 3:6], first[:, 6], noise)
    return select(flew, Delayed(state, queue[:, 1:]), filters)


def present(filters: Delayed) -> FilterState:
    """Return the current nominal states, with the covariance of the delayed horizon."""
    state = filters.state
    for place in range(filters.waiting.shape[1]):
        sample = filters.waiting[:, place]
        state = move(state, sample[:, :3], sample[:, 3:6], sample[:, 6])
    return state
