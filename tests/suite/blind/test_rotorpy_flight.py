"""What RotorPy is told of a vehicle, worked by hand; it need not be installed for that."""

import numpy as np
import pytest

from suite.blind.rotorpy_flight import rotorpy_parameters
from tests.support.vehicles import PLAIN, with_effects


def test_our_numbers_become_rotorpys():
    truth = with_effects(
        quadratic_drag=((0.1, 0.2, 0.3),), rotor_drag=(1e-5,), blade_flapping=(2e-6,),
        translational_lift=(0.4,), mass_offset=(0.05,),
    )  # fmt: skip
    told = rotorpy_parameters(truth)
    assert told["mass"] == pytest.approx(0.8)
    assert [told[key] for key in ("c_Dx", "c_Dy", "c_Dz")] == pytest.approx([0.08, 0.16, 0.24])
    assert told["k_d"] == 1e-5 and told["k_flap"] == -2e-6, "of the opposite sign there"
    assert told["k_h"] == pytest.approx(0.25 * 0.8 * 0.4) and told["k_z"] == 0.0
    assert [told[key] for key in ("Ixx", "Iyy", "Izz")] == pytest.approx(PLAIN.inertia)
    assert told["k_eta"] == pytest.approx(1.6e-6) and told["k_m"] == pytest.approx(2.2e-8)
    np.testing.assert_array_equal(told["rotor_directions"], [-1, 1, -1, 1])
    np.testing.assert_allclose(told["rotor_pos"]["r2"], PLAIN.rotors.position[1])


def test_an_effect_that_rotorpy_does_not_have_is_refused():
    with pytest.raises(ValueError, match="effects.linear_drag: RotorPy does not have it; allowed:"):
        rotorpy_parameters(with_effects(linear_drag=((0.1, 0.1, 0.1),)))
