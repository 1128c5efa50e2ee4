"""Crossings against a plain geometric check, and what must not change them."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from scipy.spatial.transform import Rotation

from tracks.geometry.crossing import crossing, is_inside, is_near
from tracks.geometry.gates import rectangle, regular_polygon

SQUARE = rectangle(1.0, 1.0)
seeds = st.integers(0, 10_000)


def draw(seed, n=200):
    """Return a random gate pose, opening and n steps around it, in the gate's frame and outside."""
    rng = np.random.default_rng(seed)
    opening = (SQUARE, rectangle(1.3, 0.6), regular_polygon(7, 0.5))[seed % 3]
    rot_w = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    center_w = rng.normal(size=3) * 20
    before_g, after_g = rng.uniform(-1, 1, (2, n, 3))
    return center_w, rot_w, opening, before_g, after_g


def to_world(center_w, rot_w, point_g):
    return center_w + point_g @ rot_w.T


@given(seeds)
def test_a_crossing_is_what_it_looks_like_in_the_gates_frame(seed):
    center_w, rot_w, opening, before, after = draw(seed)
    ends = (to_world(center_w, rot_w, point) for point in (before, after))
    passed, missed = crossing(center_w, rot_w, opening, *ends)
    forward = (before[:, 0] < 0) & (after[:, 0] > 0)
    share = before[:, :1] / (before[:, :1] - after[:, :1])
    hit = (before + share * (after - before))[:, 1:]
    inside = Polygon(opening).contains_points(hit)
    assert np.array_equal(passed, forward & inside)
    assert np.array_equal(missed, forward & ~inside)
    assert passed.any() and missed.any()


@given(seeds, st.integers(2, 40))
def test_a_straight_flight_crosses_once_however_it_is_cut(seed, parts):
    center_w, rot_w, opening, before, after = draw(seed, 20)
    # Points exactly on the plane are among the cuts for some.
    before[::2, 0], after[::2, 0] = -0.5, 0.5
    share = np.linspace(0, 1, 2 * parts + 1)[:, None, None]
    path = before + share * (after - before)
    passed, missed = crossing(np.zeros(3), np.eye(3), opening, path[:-1], path[1:])
    whole = crossing(np.zeros(3), np.eye(3), opening, before, after)
    crosses = (before[:, 0] < 0) & (after[:, 0] > 0)
    assert np.array_equal(np.sum(np.logical_or(passed, missed), axis=0), crosses.astype(int))
    assert np.array_equal(passed.any(0), whole[0])


def test_repeated_corners_change_nothing():
    padded = np.concatenate([SQUARE, SQUARE[-1:], SQUARE[-1:]])
    point = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    assert np.array_equal(is_inside(padded, point), is_inside(SQUARE, point))
    assert is_inside(padded, np.zeros(2)) and not is_inside(padded, np.array([0.0, 0.51]))


def test_both_libraries_agree():
    center_w, rot_w, opening, before, after = draw(4, 12)
    steps = (to_world(center_w, rot_w, point) for point in (before, after))
    given = (center_w, rot_w, opening, *steps)
    np.testing.assert_array_equal(jax.jit(crossing)(*given), crossing(*given))


@pytest.mark.parametrize(("distance", "near"), [(0.34, True), (0.36, False)])
def test_the_radius_rule_is_a_ball_of_35_cm(distance, near):
    direction = np.array([2.0, -1.0, 2.0]) / 3
    assert is_near(np.ones(3), np.ones(3) + distance * direction) == near
