"""What the blind set has RotorPy fly; it need not be installed for that."""

import pytest

from suite.blind.rotorpy_flight import exact_parameters
from tests.support.vehicles import with_effects


def test_the_parameters_are_those_of_the_world():
    assert exact_parameters(with_effects(rotor_drag=(1e-5,)))["k_d"] == 1e-5


def test_an_effect_that_rotorpy_does_not_have_as_it_is_is_refused():
    with pytest.raises(ValueError, match="effects.linear_drag: RotorPy does not have it; allowed:"):
        exact_parameters(with_effects(linear_drag=((0.1, 0.1, 0.1),)))
