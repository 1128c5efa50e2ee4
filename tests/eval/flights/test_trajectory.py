"""Commanded trajectories: their start, their slope, and words that are none."""

import numpy as np
import pytest

from eval.flights.trajectory import KINDS, Trajectory
from tests.support.ways import CIRCLE


@pytest.mark.parametrize("kind", KINDS)
def test_a_trajectory_starts_at_rest_and_its_velocity_is_its_slope(kind):
    way = Trajectory(kind, duration_s=4.0, speed=2.0, size=2.0, direction=0.7)
    time_s = np.linspace(0.0, 4.0, 2001)
    now = way.reference(time_s)
    np.testing.assert_allclose(now.vel_w[0], 0.0, atol=0.01)
    slope = np.gradient(now.pos_w, time_s, axis=0)[1:-1]
    np.testing.assert_allclose(now.vel_w[1:-1], slope, atol=2e-3)
    assert np.isfinite(now.acc_w).all()


def test_a_constant_circle_is_one():
    now = CIRCLE.reference(np.array([20.0]))
    assert np.linalg.norm(now.vel_w) == pytest.approx(3.0, rel=1e-3)
    assert np.linalg.norm(now.acc_w) == pytest.approx(3.0, rel=1e-3)  # v^2 / r


def test_unknown_words_are_refused():
    with pytest.raises(ValueError, match="cirkle"):
        Trajectory("cirkle").reference(np.zeros(1))
    with pytest.raises(ValueError, match="turn"):
        Trajectory("hover", turn="swep").reference(np.zeros(1))
