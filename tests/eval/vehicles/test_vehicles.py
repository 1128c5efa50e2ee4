"""A vehicle and the checks of whether it can exist and fly; the file's words are tested there."""

from dataclasses import replace

import pytest

from eval.vehicles.vehicle import CollisionBox
from eval.vehicles.vehicle_check import check_vehicle
from tests.support.vehicles import PLAIN


def rotors(**changes):
    return replace(PLAIN, rotors=replace(PLAIN.rotors, **changes))


def test_a_vehicle_that_flies_passes_and_is_a_key():
    check_vehicle(PLAIN)
    assert PLAIN.rotors.thrust_max == pytest.approx(7.056)
    assert hash(PLAIN.rotors) == hash(replace(PLAIN.rotors))
    # A flat body has the largest moment exactly at the sum of the other two.
    check_vehicle(replace(PLAIN, inertia=(0.1, 0.2, 0.1 + 0.2)))


@pytest.mark.parametrize(
    ("vehicle", "message"),
    [
        (replace(PLAIN, mass=0.0), "mass = 0.0: must be from 0.0001 to 10000 kg"),
        (replace(PLAIN, mass=1e-300), "mass = 1e-300: must be from 0.0001"),
        (replace(PLAIN, inertia=(1e-300,) * 3), "inertia = .*must be from 1e-10"),
        (replace(PLAIN, inertia=(0.1, 0.2, 0.31)), "sum of the other two"),
        (replace(PLAIN, body=CollisionBox((0.1, 0.0, 0.1))), "body.half_size"),
        (rotors(spin=(1, 1, -1, -1)), "independently"),
        (rotors(speed_max=1070.0), "too weak to hover; a rotor gives 1.83 N and 1.84 N"),
        (rotors(position=tuple((x + 0.08, y, z) for x, y, z in PLAIN.rotors.position)), "between"),
    ],
)
def test_what_cannot_fly_is_refused(vehicle, message):
    with pytest.raises(ValueError, match=message):
        check_vehicle(vehicle)
