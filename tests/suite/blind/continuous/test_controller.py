"""Rate loop and mixer, worked by hand."""

import numpy as np
import pytest

from suite.blind.continuous.quadrotor import allotted, quadrotor_of, wanted_speeds
from tests.support.vehicles import PLAIN

BELIEVED = quadrotor_of(PLAIN).believed
MOST = BELIEVED.thrust_max  # 7.056 N


def wrench(thrust):
    """Collective and torque of rotor thrusts (4,), from the rotors' places."""
    (x, y), spin = np.array(PLAIN.rotors.position).T[:2], np.array(PLAIN.rotors.spin)
    turning = -(spin * thrust).sum() * 2.2e-8 / 1.6e-6
    return np.array([thrust.sum(), (y * thrust).sum(), -(x * thrust).sum(), turning])


def test_what_is_asked_is_given_where_it_fits():
    asked = np.array([8.0, 0.05, -0.04, 0.01])
    thrust = allotted(BELIEVED, asked[:1], asked[None, 1:])[0]
    np.testing.assert_allclose(wrench(thrust), asked, atol=1e-14)


def test_the_torque_of_the_rate_loop():
    # J K (cmd - w) + w x (J w), with w = (1, 2, 3): w x (J w) =
    # ((0.0043 - 0.0021) 6, (0.0025 - 0.0043) 3, (0.0021 - 0.0025) 2)
    command = np.array([[10.0, 1.5, 2.5, 2.0]])
    speed = wanted_speeds(BELIEVED, command, np.array([[1.0, 2.0, 3.0]]))[0]
    given = wrench(1.6e-6 * speed**2)
    hand = [
        7.5,
        0.0025 * 20 * 0.5 + 0.0132,
        0.0021 * 20 * 0.5 - 0.0054,
        0.0043 * 8 * -1.0 - 0.0008,
    ]
    np.testing.assert_allclose(given, hand, atol=1e-13)


def test_roll_and_pitch_shrink_together_until_their_spread_fits():
    # Roll alone moves the rotors by +-2.5 tau, pitch by +-tau / 0.3: (2, 1.5) spreads 20 N.
    thrust = allotted(BELIEVED, np.array([10.0]), np.array([[2.0, 1.5, 0.0]]))[0]
    given, factor = wrench(thrust), MOST / 20.0
    np.testing.assert_allclose(given[1:3], [2.0 * factor, 1.5 * factor])
    # The spread leaves no room: the collective is the one that fits.
    assert given[0] == pytest.approx(2.0 * MOST) and given[3] == pytest.approx(0.0, abs=1e-12)
    assert thrust.min() == pytest.approx(0.0, abs=1e-12) and thrust.max() == pytest.approx(MOST)


def test_the_collective_gives_way_to_roll_and_yaw_to_both():
    # Roll of 0.4 Nm: rotors +-1 N, so that the collective must be from 4 to 4 (MOST - 1).
    low = wrench(allotted(BELIEVED, np.array([1.0]), np.array([[0.4, 0.0, 0.0]]))[0])
    np.testing.assert_allclose(low, [4.0, 0.4, 0.0, 0.0], atol=1e-14)
    high = wrench(allotted(BELIEVED, np.array([40.0]), np.array([[0.4, 0.0, 0.0]]))[0])
    np.testing.assert_allclose(high[:2], [4.0 * (MOST - 1.0), 0.4])
    # 8 N in all: each rotor may lose 2 N to yaw, that is 8 x k_Q / k_T = 0.11 Nm.
    yawing = wrench(allotted(BELIEVED, np.array([8.0]), np.array([[0.0, 0.0, 0.5]]))[0])
    np.testing.assert_allclose(yawing, [8.0, 0.0, 0.0, 8.0 * 2.2e-8 / 1.6e-6], atol=1e-14)


def test_flights_beside_each_other_do_not_mix():
    collective = np.array([8.0, 1.0])
    torque = np.array([[0.05, -0.04, 0.01], [0.4, 0.0, 0.0]])
    both = allotted(BELIEVED, collective, torque)
    alone = [allotted(BELIEVED, collective[i : i + 1], torque[i : i + 1])[0] for i in range(2)]
    np.testing.assert_array_equal(both, alone)
