"""True constants, worked by hand from the catalogue's table."""

from dataclasses import replace

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from suite.blind.continuous.quadrotor import leaning_z, quadrotor_of
from tests.support.vehicles import PLAIN, drawn_effects, with_effects


def test_a_plain_vehicle_is_its_file():
    q = quadrotor_of(PLAIN)
    assert (q.mass, q.time_constant, q.delay) == (0.75, 0.0, 0.0)
    np.testing.assert_array_equal(q.inertia, [0.0025, 0.0021, 0.0043])
    np.testing.assert_allclose(q.gravity_w, [0.0, 0.0, -9.81])
    np.testing.assert_array_equal(q.thrust_coefficient, np.full(4, 1.6e-6))
    np.testing.assert_array_equal(q.thrust_axis, [0.0, 0.0, 1.0])
    assert q.believed.thrust_max == pytest.approx(1.6e-6 * 2100.0**2)
    assert q.believed.period_s == 0.002
    # A quarter of a collective each; roll pushes up the left rotors (y > 0), which are 3 and 4.
    np.testing.assert_allclose(q.believed.shares[:, 0], 0.25)
    np.testing.assert_allclose(q.believed.shares[:, 1], [-2.5, -2.5, 2.5, 2.5])
    np.testing.assert_allclose(q.believed.shares[:, 2], np.array([-1, 1, 1, -1]) / 0.3)
    # Yaw to the left: the clockwise rotors, 2 and 4, which turn the body the other way.
    ratio = 1.6e-6 / 2.2e-8 / 4.0
    np.testing.assert_allclose(q.believed.shares[:, 3], np.array([-1, 1, -1, 1]) * ratio)


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
    assert q.mass == pytest.approx(0.8) and q.believed.mass == 0.75
    np.testing.assert_allclose(q.inertia, [0.00275, 0.00189, 0.00516])
    np.testing.assert_array_equal(q.believed.inertia, [0.0025, 0.0021, 0.0043])
    np.testing.assert_allclose(q.believed.rate_gain, [10.0, 40.0, 12.0])
    # True k_T: the scale and the weak rotor; k_Q: the weak rotor alone.
    np.testing.assert_allclose(q.thrust_coefficient, np.array([1.44, 1.152, 1.44, 1.44]) * 1e-6)
    np.testing.assert_allclose(q.torque_coefficient, np.array([2.2, 1.76, 2.2, 2.2]) * 1e-8)
    assert q.believed.thrust_coefficient == 1.6e-6
    np.testing.assert_allclose(q.arm[0], [0.07, -0.09, -0.02])


def test_a_tilt_rolls_first_and_then_pitches():
    # Small angles: Rot(a_x, a_y, 0) e3 = (a_y, -a_x, 1).
    np.testing.assert_allclose(leaning_z(np.array([1e-4, 2e-4])), [2e-4, -1e-4, 1.0], atol=1e-7)
    # Rolled by a right angle e3 lies along -y, where no pitch moves it.
    np.testing.assert_allclose(leaning_z(np.array([np.pi / 2, 0.7])), [0, -1, 0], atol=1e-15)
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
