"""What a policy sees, worked by hand and with scipy."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from policies.observation import View, observe, view_of
from policies.spec import PolicySpec
from tests.policies.conftest import SPEC
from tracks.geometry.camera import Camera
from tracks.geometry.gates import square_gates

SECOND = replace(SPEC, second_gate=True)
AXIS = replace(SPEC, gate_axis=True)
BOTH = replace(SECOND, gate_axis=True)


def state_of(spec, pos_w, vel_w, rot_w, gate_w, last_b, second_w, axis_w, second_axis_w=None):
    axes_w = axis_w, axis_w if second_axis_w is None else second_axis_w
    return observe(spec, View(pos_w, rot_w, vel_w, gate_w, second_w, *axes_w), last_b).state


def test_the_last_three_numbers_are_the_second_gate_in_body_axes():
    """Worked with scipy: R^T (p - x); the first twelve are as without it."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    rng = np.random.default_rng(0)
    pos, vel, gate, last, second = rng.normal(size=(5, 3))
    known = pos, vel, turn.as_matrix(), gate, last, second, np.array([1.0, 0.0, 0.0])
    without, seen = state_of(PolicySpec(), *known), state_of(SECOND, *known)
    assert without.shape == (12,) == (PolicySpec().state_size,)
    np.testing.assert_array_equal(seen[:12], without)
    np.testing.assert_allclose(seen[12:], turn.inv().apply(second - pos), atol=1e-12)


def test_the_gates_direction_comes_last_and_turns_with_the_body():
    """Worked with scipy: R^T e, whatever the position; alone it stands after the twelve."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    rng = np.random.default_rng(0)
    pos, vel, gate, last, second = rng.normal(size=(5, 3))
    axis = np.array([0.6, -0.8, 0.0])
    body = turn.as_matrix()
    known = vel, body, gate, last, second, axis
    with_both = state_of(BOTH, pos, *known)
    np.testing.assert_array_equal(with_both[:15], state_of(SECOND, pos, *known))
    np.testing.assert_allclose(with_both[15:], turn.inv().apply(axis), atol=1e-12)
    alone = state_of(AXIS, pos + 5, *known)
    np.testing.assert_array_equal(alone[12:], with_both[15:])


def test_the_second_gates_direction_follows_the_first_ones():
    """Worked with scipy: R^T e of each; alone it stands after the twelve."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    pos, vel, gate, last, second = np.random.default_rng(0).normal(size=(5, 3))
    axes = np.array([0.6, -0.8, 0.0]), np.array([0.0, 0.8, 0.6])
    known = pos, vel, turn.as_matrix(), gate, last, second, *axes
    both = state_of(replace(AXIS, second_axis=True), *known)
    np.testing.assert_allclose(both[12:], np.ravel(turn.inv().apply(axes)), atol=1e-12)
    alone = state_of(PolicySpec(second_axis=True), *known)
    np.testing.assert_array_equal(alone[12:], both[15:])


def test_how_fast_to_fly_comes_last_as_the_spec_or_each_row_says():
    zero = np.zeros((2, 3))
    ahead = zero + [1.0, 0, 0]
    view = View(zero, np.broadcast_to(np.eye(3), (2, 3, 3)), zero, zero, zero, ahead, ahead)
    spec = replace(AXIS, speed_input=True, speed=0.3)
    assert spec.state_size == 16
    without = observe(AXIS, view, zero).state
    own = observe(spec, view, zero).state
    np.testing.assert_array_equal(own[:, :15], without)
    np.testing.assert_array_equal(own[:, 15], 0.3)
    observed = observe(spec, view, zero, np.array([0.0, 0.9])).state
    np.testing.assert_array_equal(observed[:, 15], [0.0, 0.9])


def test_the_papers_twelve_numbers():
    """Rolled a quarter turn to the right, so that its left points up and its top to the right."""
    rolled = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pos, vel, gate = np.array([1.0, 2.0, 3.0]), np.array([0.0, 5.0, 1.0]), np.array([1.0, 6.0, 2.0])
    last = np.array([7.0, 8.0, 9.0])
    state = state_of(PolicySpec(), pos, vel, rolled, gate, last, gate, vel)
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
