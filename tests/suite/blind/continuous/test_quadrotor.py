"""A vehicle's true constants, its rate loop and its mixer, worked by hand."""

from dataclasses import replace

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from suite.blind.continuous.quadrotor import (
    allocate_thrust,
    commanded_speeds,
    quadrotor_of,
    tilted_z,
)
from tests.support.vehicles import PLAIN, drawn_effects, with_effects


def test_a_plain_vehicle_is_its_file():
    q = quadrotor_of(PLAIN)
    assert (q.mass, q.time_constant, q.delay) == (0.75, 0.0, 0.0)
    np.testing.assert_array_equal(q.inertia, [0.0025, 0.0021, 0.0043])
    np.testing.assert_allclose(q.gravity_w, [0.0, 0.0, -9.81])
    np.testing.assert_array_equal(q.thrust_coefficient, np.full(4, 1.6e-6))
    np.testing.assert_array_equal(q.thrust_axis, [0.0, 0.0, 1.0])
    assert q.nominal.thrust_max == pytest.approx(1.6e-6 * 2100.0**2)
    assert q.nominal.period_s == 0.002
    # A quarter of a collective each; roll pushes up the left rotors (y > 0), which are 3 and 4.
    np.testing.assert_allclose(q.nominal.shares[:, 0], 0.25)
    np.testing.assert_allclose(q.nominal.shares[:, 1], [-2.5, -2.5, 2.5, 2.5])
    np.testing.assert_allclose(q.nominal.shares[:, 2], np.array([-1, 1, 1, -1]) / 0.3)
    # Yaw to the left: the clockwise rotors, 2 and 4, which turn the body the other way.
    ratio = 1.6e-6 / 2.2e-8 / 4.0
    np.testing.assert_allclose(q.nominal.shares[:, 3], np.array([-1, 1, -1, 1]) * ratio)


def test_constants_that_effects_change():
    q = quadrotor_of(
        with_effects(
            motor_lag=(0.04,),
            command_delay=(0.013,),
            thrust_scale=(0.9,),
            mass_offset=(0.05,),
            com_offset=((0.005, -0.01, 0.02),),
            inertia_scale=((1.1, 0.9, 1.2),),
            rate_gain=((0.5, 2.0, 1.5),),
            weak_motor=((1.0, 0.8, 1.0, 1.0),),
        )
    )
    assert (q.time_constant, q.delay) == (0.04, 0.013)
    assert q.mass == pytest.approx(0.8) and q.nominal.mass == 0.75
    np.testing.assert_allclose(q.inertia, [0.00275, 0.00189, 0.00516])
    np.testing.assert_array_equal(q.nominal.inertia, [0.0025, 0.0021, 0.0043])
    np.testing.assert_allclose(q.nominal.rate_gain, [10.0, 40.0, 12.0])
    # True k_T: the scale and the weak rotor; k_Q: the weak rotor alone.
    np.testing.assert_allclose(q.thrust_coefficient, np.array([1.44, 1.152, 1.44, 1.44]) * 1e-6)
    np.testing.assert_allclose(q.torque_coefficient, np.array([2.2, 1.76, 2.2, 2.2]) * 1e-8)
    assert q.nominal.thrust_coefficient == 1.6e-6
    np.testing.assert_allclose(q.arm[0], [0.07, -0.09, -0.02])


def test_a_tilt_rolls_first_and_then_pitches():
    # Small angles: Rot(a_x, a_y, 0) e3 = (a_y, -a_x, 1).
    np.testing.assert_allclose(tilted_z(np.array([1e-4, 2e-4])), [2e-4, -1e-4, 1.0], atol=1e-7)
    # Rolled by a right angle e3 lies along -y, where no pitch moves it.
    np.testing.assert_allclose(tilted_z(np.array([np.pi / 2, 0.7])), [0, -1, 0], atol=1e-15)
    tilted = quadrotor_of(with_effects(frame_tilt=((0.0, 0.02),), thrust_tilt=((0.03, 0.0),)))
    np.testing.assert_allclose(tilted.gravity_w, -9.81 * np.array([np.sin(0.02), 0, np.cos(0.02)]))
    np.testing.assert_allclose(tilted.thrust_axis, [0.0, -np.sin(0.03), np.cos(0.03)])


def test_every_effect_of_the_catalogue_has_an_equation_and_another_is_refused():
    drawn = drawn_effects(np.random.default_rng(0)).effects
    assert set(drawn) == set(EFFECTS)
    quadrotor_of(replace(PLAIN, effects={name: drawn[name] for name in nameable_effects()}))
    with pytest.raises(ValueError, match="effects.slung_load: .* no equation for it"):
        quadrotor_of(with_effects(slung_load=(0.05, 0.5)))
    odd = with_effects()
    object.__setattr__(odd, "effects", {"ripple": None})
    with pytest.raises(ValueError, match="effects.ripple: .* no equation for it; allowed: .*gusts"):
        quadrotor_of(odd)


NOMINAL = quadrotor_of(PLAIN).nominal
MOST = NOMINAL.thrust_max  # 7.056 N


def wrench(thrust):
    """Collective and torque of rotor thrusts (4,), from the rotors' places."""
    (x, y), spin = np.array(PLAIN.rotors.position).T[:2], np.array(PLAIN.rotors.spin)
    turning = -(spin * thrust).sum() * 2.2e-8 / 1.6e-6
    return np.array([thrust.sum(), (y * thrust).sum(), -(x * thrust).sum(), turning])


def test_what_is_asked_is_given_where_it_fits():
    asked = np.array([8.0, 0.05, -0.04, 0.01])
    thrust = allocate_thrust(NOMINAL, asked[:1], asked[None, 1:])[0]
    np.testing.assert_allclose(wrench(thrust), asked, atol=1e-14)


def test_the_torque_of_the_rate_loop():
    # J K (cmd - w) + w x (J w), with w = (1, 2, 3): w x (J w) =
    # ((0.0043 - 0.0021) 6, (0.0025 - 0.0043) 3, (0.0021 - 0.0025) 2)
    command = np.array([[10.0, 1.5, 2.5, 2.0]])
    speed = commanded_speeds(NOMINAL, command, np.array([[1.0, 2.0, 3.0]]))[0]
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
    thrust = allocate_thrust(NOMINAL, np.array([10.0]), np.array([[2.0, 1.5, 0.0]]))[0]
    given, factor = wrench(thrust), MOST / 20.0
    np.testing.assert_allclose(given[1:3], [2.0 * factor, 1.5 * factor])
    # The spread leaves no room: the collective is the one that fits.
    assert given[0] == pytest.approx(2.0 * MOST) and given[3] == pytest.approx(0.0, abs=1e-12)
    assert thrust.min() == pytest.approx(0.0, abs=1e-12) and thrust.max() == pytest.approx(MOST)


def test_the_collective_gives_way_to_roll_and_yaw_to_both():
    # Roll of 0.4 Nm: rotors +-1 N, so that the collective must be from 4 to 4 (MOST - 1).
    low = wrench(allocate_thrust(NOMINAL, np.array([1.0]), np.array([[0.4, 0.0, 0.0]]))[0])
    np.testing.assert_allclose(low, [4.0, 0.4, 0.0, 0.0], atol=1e-14)
    high = wrench(allocate_thrust(NOMINAL, np.array([40.0]), np.array([[0.4, 0.0, 0.0]]))[0])
    np.testing.assert_allclose(high[:2], [4.0 * (MOST - 1.0), 0.4])
    # 8 N in all: each rotor may lose 2 N to yaw, that is 8 x k_Q / k_T = 0.11 Nm.
    yawing = wrench(allocate_thrust(NOMINAL, np.array([8.0]), np.array([[0.0, 0.0, 0.5]]))[0])
    np.testing.assert_allclose(yawing, [8.0, 0.0, 0.0, 8.0 * 2.2e-8 / 1.6e-6], atol=1e-14)


def test_flights_beside_each_other_do_not_mix():
    collective = np.array([8.0, 1.0])
    torque = np.array([[0.05, -0.04, 0.01], [0.4, 0.0, 0.0]])
    both = allocate_thrust(NOMINAL, collective, torque)
    alone = [
        allocate_thrust(NOMINAL, collective[i : i + 1], torque[i : i + 1])[0] for i in range(2)
    ]
    np.testing.assert_array_equal(both, alone)
