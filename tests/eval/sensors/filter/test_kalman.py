"""The error-state filter: its equations against finite differences, and its consistency (NEES)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from eval.sensors.filter.kalman import (
    SIZE,
    Corners,
    FilterState,
    ImuNoise,
    move,
    predict,
    project,
    start,
    update_gate,
)
from eval.sensors.interface import rotation_since
from tests.support.marks import more
from tracks.geometry.rotation import exp_rot

FLIGHTS, IMU_HZ, FRAME_EVERY = 100, 100.0, 5
NOISE = ImuNoise(acc=0.03, gyro=0.002, acc_walk=0.01, gyro_walk=0.0005)
SIGMA = np.repeat([0.05, 0.05, 0.02, 0.1, 0.01], 3)
PIXEL = 2.0 / 640.0
CAMERA_B = np.eye(3)
SQUARE = np.array([[0.0, y, z] for y in (-0.6, 0.6) for z in (-0.6, 0.6)])
CORNERS_W = np.concatenate([SQUARE + [4.0, 1.0, 1.0], SQUARE + [7.0, -2.0, 2.0]])


def moved_by(state: FilterState, error: np.ndarray) -> FilterState:
    return FilterState(
        state.pos_w + error[:, :3],
        state.vel_w + error[:, 3:6],
        state.rot_w @ exp_rot(error[:, 6:9]),
        state.acc_bias_b + error[:, 9:12],
        state.gyro_bias_b + error[:, 12:],
        state.covariance,
    )


def begin(rng: np.random.Generator, flights: int = FLIGHTS) -> tuple[FilterState, FilterState]:
    """Return true states and estimates of them whose errors are drawn as `SIGMA` says."""
    still = np.zeros((flights, 3))
    given = start(still + [0.0, 0.0, 1.0], still, np.tile(np.eye(3), (flights, 1, 1)), SIGMA)
    error = rng.normal(size=(flights, SIZE)) * SIGMA
    return moved_by(given, error), given


def seen_by(truth: FilterState, rng: np.random.Generator) -> Corners:
    corner_w = np.tile(CORNERS_W, (len(truth.pos_w), 1, 1))
    image, forward = project(truth.pos_w, truth.rot_w, CAMERA_B, corner_w)
    seen = (forward > 0.3) & (np.abs(image) < 1.0).all(-1)
    return Corners(image + PIXEL * rng.normal(size=image.shape), corner_w, seen)


class Believed(NamedTuple):
    """What the filter takes the variances for, over what they are."""

    imu: float = 1.0
    corners: float = 1.0
    start: float = 1.0


RIGHT = Believed()


def flown(steps: int, believed: Believed = RIGHT, seed: int = 0) -> np.ndarray:
    """Return the NEES (steps, FLIGHTS) along simulated flights."""
    rng, dt = np.random.default_rng(seed), np.full(FLIGHTS, 1.0 / IMU_HZ)
    truth, state = begin(rng)
    state = state._replace(covariance=believed.start * state.covariance)
    noise = ImuNoise(*(np.sqrt(believed.imu) * np.asarray(NOISE)))
    found = []
    for step in range(steps):
        time_s = step / IMU_HZ
        rate_b = [0.4, 0.3, 0.2] * np.sin(np.array([3.0, 2.0, 1.0]) * time_s + [0, np.pi / 2, 0])
        acc_b = np.array([2.0 * np.sin(2 * time_s), 2.0 * np.cos(3 * time_s), 9.8])
        white = rng.normal(size=(4, FLIGHTS, 3))
        truth_move = truth._replace(acc_bias_b=0.0 * white[0], gyro_bias_b=0.0 * white[0])
        moved = move(truth_move, rate_b + 0.0 * white[0], acc_b + 0.0 * white[0], dt)
        per_root = np.sqrt(IMU_HZ)
        gyro_b = rate_b + truth.gyro_bias_b + NOISE.gyro * per_root * white[0]
        felt_b = acc_b + truth.acc_bias_b + NOISE.acc * per_root * white[1]
        state = predict(state, gyro_b, felt_b, dt, noise)
        truth = moved._replace(
            acc_bias_b=truth.acc_bias_b + NOISE.acc_walk / per_root * white[2],
            gyro_bias_b=truth.gyro_bias_b + NOISE.gyro_walk / per_root * white[3],
        )
        if step % FRAME_EVERY == 0:
            state = update_gate(state, seen_by(truth, rng), believed.corners * PIXEL**2, CAMERA_B)
        found.append(nees(state, truth))
    return np.array(found)


def error_of(state, truth):
    """Return truth minus estimate (N, 15), the attitude's as axis times sine."""
    turned_b = rotation_since(truth.rot_w, state.rot_w)
    biases = (truth.acc_bias_b - state.acc_bias_b, truth.gyro_bias_b - state.gyro_bias_b)
    return np.hstack([truth.pos_w - state.pos_w, truth.vel_w - state.vel_w, turned_b, *biases])


def nees(state, truth):
    """Return the normalised estimation error squared (N,), chi-squared with 15 degrees of freedom.

    See Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2.
    """
    error = error_of(state, truth)
    return np.einsum("nk,nk->n", error, np.linalg.solve(state.covariance, error[..., None])[..., 0])


def share_within(nees_of_flights):
    """Return the share of steps at which the mean NEES is within its 95 % bounds."""
    low, high = chi2.ppf([0.025, 0.975], SIZE * FLIGHTS) / FLIGHTS
    mean = nees_of_flights.mean(axis=1)
    return np.mean((low < mean) & (mean < high))


def test_nees_is_within_its_bounds():
    assert share_within(flown(300)[100:]) > 0.9


@pytest.mark.parametrize(
    ("which", "factor"), [more("imu", 4.0), ("corners", 0.25), ("start", 0.25)]
)
def test_nees_leaves_its_bounds_where_a_variance_is_wrong_by_four(which, factor):
    # What was believed at the start is forgotten later.
    window = slice(0, 10) if which == "start" else slice(100, 150)
    assert share_within(flown(window.stop, Believed(**{which: factor}))[window]) < 0.5


def test_the_covariance_is_carried_as_finite_differences_say():
    _, state = begin(np.random.default_rng(1), SIZE)
    rate_b, acc_b = np.tile([1.0, -2.0, 0.5], (SIZE, 1)), np.tile([3.0, -1.0, 12.0], (SIZE, 1))
    dt, size = np.full(SIZE, 0.002), 1e-6
    nothing = ImuNoise(0.0, 0.0, 0.0, 0.0)
    after = predict(state, rate_b, acc_b, dt, nothing)
    other = predict(moved_by(state, size * np.eye(SIZE)), rate_b, acc_b, dt, nothing)
    slope = error_of(after, other).T / size
    wanted = slope @ state.covariance[0] @ slope.T
    # The slopes leave out what is of second order in dt.
    np.testing.assert_allclose(after.covariance[0], wanted, atol=2e-4 * wanted.max())


def test_a_corner_pulls_the_state_as_finite_differences_say():
    rng, size = np.random.default_rng(2), 1e-6
    _, state = begin(rng, SIZE)
    corner_w = np.tile(CORNERS_W[:1], (SIZE, 1, 1))
    other = moved_by(state, size * np.eye(SIZE))
    image = [project(s.pos_w, s.rot_w, CAMERA_B, corner_w)[0] for s in (state, other)]
    slope = (image[1] - image[0])[:, 0].T / size  # (2, 15)
    seen = Corners(image[0] + [0.003, -0.002], corner_w, np.ones((SIZE, 1), bool))
    found = update_gate(state, seen, PIXEL**2, CAMERA_B)
    before = state.covariance[0]
    gain = before @ slope.T @ np.linalg.inv(slope @ before @ slope.T + PIXEL**2 * np.eye(2))
    error = gain @ [0.003, -0.002]
    np.testing.assert_allclose(error_of(state, found)[0], error, atol=2e-6)
    left = (np.eye(SIZE) - gain @ slope) @ before
    np.testing.assert_allclose(found.covariance[0], left, atol=3e-6)


def test_corners_that_are_not_seen_and_a_step_of_no_time_change_nothing():
    _, state = begin(np.random.default_rng(3), 2)
    unseen = Corners(
        np.full((2, 8, 2), np.nan), np.tile(CORNERS_W, (2, 1, 1)), np.zeros((2, 8)) > 0
    )
    still = predict(state, np.ones((2, 3)), np.ones((2, 3)), np.zeros(2), NOISE)
    for found in (update_gate(state, unseen, 1.0, CAMERA_B), still):
        for one, two in zip(state, found, strict=True):
            np.testing.assert_allclose(one, two, atol=1e-15)


def test_jax_computes_the_same():
    rng = np.random.default_rng(5)
    truth, state = begin(rng, 4)
    seen, dt = seen_by(truth, rng), np.full(4, 0.01)

    def both(state, seen, dt, camera_b):
        state = predict(state, 0.1 * state.pos_w, 9.81 + state.pos_w, dt * state.pos_w[:, 2], NOISE)
        return update_gate(state, seen, PIXEL**2, camera_b)

    given = state, seen, dt, CAMERA_B
    in_jax = jax.jit(both)(*jax.tree.map(jnp.asarray, given))
    for one, two in zip(both(*given), in_jax, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=2e-5)
