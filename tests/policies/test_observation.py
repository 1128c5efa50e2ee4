"""What a policy sees, worked by hand and with scipy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies.observation import View, observe, view_of
from policies.spec import PolicySpec
from tracks.geometry.camera import Camera
from tracks.geometry.gates import square_gates

EXTRAS = ("second_gate", "gate_axis", "second_axis")
"""In the order in which they follow the twelve numbers."""


@pytest.mark.parametrize("keys", [EXTRAS[:1], EXTRAS[1:2], EXTRAS[2:], EXTRAS[:2], EXTRAS])
def test_what_a_spec_adds_follows_the_twelve_numbers_in_body_axes(keys):
    """Worked with scipy: R^T (p - x) of the second gate, R^T e of both gates' axes."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    pos, vel, gate, last, second = np.random.default_rng(0).normal(size=(5, 3))
    axes = np.array([[0.6, -0.8, 0.0], [0.0, 0.8, 0.6]])
    added = dict(zip(EXTRAS, turn.inv().apply([second - pos, *axes]), strict=True))
    view = View(pos, turn.as_matrix(), vel, gate, second, *axes)
    spec = PolicySpec(**dict.fromkeys(keys, True))
    state, twelve = observe(spec, view, last).state, observe(PolicySpec(), view, last).state
    assert state.shape == (spec.state_size,) and twelve.shape == (12,)
    np.testing.assert_array_equal(state[:12], twelve)
    np.testing.assert_allclose(state[12:], np.ravel([added[key] for key in keys]), atol=1e-12)


def test_how_fast_to_fly_comes_last_as_the_spec_or_each_row_says():
    zero = np.zeros((2, 3))
    ahead = zero + [1.0, 0, 0]
    view = View(zero, np.broadcast_to(np.eye(3), (2, 3, 3)), zero, zero, zero, ahead, ahead)
    axis = PolicySpec(gate_axis=True)
    spec = replace(axis, speed_input=True, speed=0.3)
    assert spec.state_size == 16
    without = observe(axis, view, zero).state
    own = observe(spec, view, zero).state
    np.testing.assert_array_equal(own[:, :15], without)
    np.testing.assert_array_equal(own[:, 15], 0.3)
    observed = observe(spec, view, zero, np.array([0.0, 0.9])).state
    np.testing.assert_array_equal(observed[:, 15], [0.0, 0.9])


def test_the_papers_twelve_numbers():
    """Rolled a quarter turn to the right, so that its left points up and its top to the right."""
    rolled = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pos, vel, gate = np.array([1.0, 2.0, 3.0]), np.array([0.0, 5.0, 1.0]), np.array([1.0, 6.0, 2.0])
    view = View(pos, rolled, vel, gate, gate, vel, vel)
    state = observe(PolicySpec(), view, np.array([7.0, 8.0, 9.0])).state
    expected = [0, 1, -5, 0, 1, 0, 0, -1, -4, 7, 8, 9]
    np.testing.assert_allclose(state, expected, atol=1e-15)


def test_depths_are_inverse_and_clipped_on_both_sides():
    """3 / d - 0.6, from 0.3 m to the camera's range of 6 m."""
    spec = PolicySpec(camera=Camera(range_m=6.0))
    zero, depth = np.zeros(3), np.array([[0.1, 0.3], [2.0, 50.0]])
    view = View(zero, np.eye(3), zero, zero, zero, zero, zero, depth)
    image = observe(spec, view, zero).image
    np.testing.assert_allclose(image, [[9.4, 9.4], [0.9, -0.1]], atol=1e-12)
    assert observe(spec, view._replace(depth_m=None), zero).image is None


def test_the_gates_axis_is_its_frames_x():
    one, zero = np.ones(2), np.zeros((2, 3))
    gates = square_gates(zero, np.array([0.0, 0.5 * np.pi]), one, one, one)
    after = square_gates(zero, np.array([np.pi, 0.0]), one, one, one)
    view = view_of(zero, np.tile(np.eye(3), (2, 1, 1)), zero, gates, after, None)
    np.testing.assert_allclose(view.axis_w, [[1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(view.second_axis_w, [[-1, 0, 0], [1, 0, 0]], atol=1e-15)
