"""Rotations against scipy, and turned vectors against matrix products."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tracks.geometry.rotation import cross, exp_rot, quat_to_rot, rot_to_quat, to_local, to_world

VECTORS = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


@given(VECTORS)
def test_rotations_against_scipy(vector):
    expected = Rotation.from_rotvec(vector)
    rot = exp_rot(vector)
    np.testing.assert_allclose(rot, expected.as_matrix(), atol=1e-12)
    x, y, z, w = expected.as_quat()
    np.testing.assert_allclose(quat_to_rot(np.array([w, x, y, z])), rot, atol=1e-12)
    quat = rot_to_quat(rot)
    assert abs(quat @ [w, x, y, z]) == pytest.approx(1.0)
    assert quat[0] >= 0.0


def test_small_rotations_are_exact_and_differentiable():
    tiny = np.array([3e-5, -2e-5, 1e-5])
    np.testing.assert_allclose(exp_rot(tiny), Rotation.from_rotvec(tiny).as_matrix(), atol=1e-16)
    slope = jax.jit(jax.jacobian(exp_rot))(jax.numpy.zeros(3))
    np.testing.assert_allclose(slope[..., 2], [[0, -1, 0], [1, 0, 0], [0, 0, 0]], atol=1e-6)


@given(st.integers(0, 10_000))
def test_quaternions_are_scipys(seed):
    rotation = Rotation.from_quat(np.random.default_rng(seed).normal(size=4))
    expected = rotation.as_quat(canonical=True, scalar_first=True)
    assert np.allclose(rot_to_quat(rotation.as_matrix()), expected)
    half_turn = Rotation.from_rotvec(np.pi * np.eye(3)[seed % 3])
    quat = rot_to_quat(half_turn.as_matrix())
    assert np.allclose(
        Rotation.from_quat(quat, scalar_first=True).as_matrix(), half_turn.as_matrix()
    )


@given(VECTORS, VECTORS, VECTORS)
def test_vectors_are_turned_and_turned_back(turn, vector, other):
    rot = Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(to_world(rot, vector), rot @ vector, atol=1e-12)
    np.testing.assert_allclose(to_local(rot, vector), rot.T @ vector, atol=1e-12)
    np.testing.assert_allclose(cross(vector, other), np.cross(vector, other), atol=1e-12)
