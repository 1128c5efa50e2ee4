"""Frames of logs against turns worked by hand."""

import numpy as np
import pytest

from eval.importers.frames import (
    attitude,
    body_vector,
    conjugate,
    from_euler,
    multiply,
    rotation_vector,
    turn,
    world_vector,
)

ROOT_HALF = np.sqrt(0.5)
LEFT_TURN = np.array([ROOT_HALF, 0.0, 0.0, ROOT_HALF])
"""A quarter turn about z: forward becomes left."""
NOSE_UP = np.array([ROOT_HALF, 0.0, -ROOT_HALF, 0.0])
"""A quarter turn about -y: forward becomes up."""


@pytest.mark.parametrize(
    ("world", "expected"), [("z-up", [1, 2, 3]), ("ned", [1, -2, -3]), ("y-up", [1, -3, 2])]
)
def test_world_axes(world, expected):
    found = world_vector(np.array([[1.0, 2.0, 3.0]]), world)
    np.testing.assert_allclose(found, [expected], atol=1e-15)


def test_body_axes():
    vector = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(body_vector(vector, "frd"), [1, -2, -3])
    np.testing.assert_array_equal(body_vector(vector, "flu"), vector)


def test_turns_follow_one_another_from_right_to_left():
    forward = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turn(LEFT_TURN, forward), [0, 1, 0], atol=1e-15)
    # Nose up first, which the turn about the vertical then leaves up.
    both = multiply(LEFT_TURN, NOSE_UP)
    np.testing.assert_allclose(turn(both, forward), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(turn(multiply(NOSE_UP, LEFT_TURN), forward), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(multiply(both, conjugate(both)), [1, 0, 0, 0], atol=1e-15)


def test_a_turn_to_the_right_of_a_forward_right_down_body_is_one_to_the_right_of_ours():
    level = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(attitude(level, "ned", "frd"), level, atol=1e-15)
    # About down, forward turns right: in our axes that is the left turn's inverse.
    np.testing.assert_allclose(attitude(LEFT_TURN, "ned", "frd"), conjugate(LEFT_TURN), atol=1e-15)


def test_euler_angles_and_rotation_vectors():
    quarter = 0.5 * np.pi
    np.testing.assert_allclose(from_euler(np.array([0.0, 0.0, quarter])), LEFT_TURN, atol=1e-15)
    yaw_then_pitch = from_euler(np.array([0.0, -quarter, quarter]))
    np.testing.assert_allclose(yaw_then_pitch, multiply(LEFT_TURN, NOSE_UP), atol=1e-15)
    for sign in (1.0, -1.0):  # the same attitude, told with either sign
        np.testing.assert_allclose(rotation_vector(sign * LEFT_TURN), [0, 0, quarter], atol=1e-15)
    np.testing.assert_array_equal(rotation_vector(np.array([1.0, 0.0, 0.0, 0.0])), np.zeros(3))
