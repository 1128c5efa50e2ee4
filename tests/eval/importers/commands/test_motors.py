"""Motors come into the vehicle's order by where they are."""

from dataclasses import replace

import numpy as np

from eval.importers.commands import SHIPPED_ORDER, order_motors
from tests.support.vehicles import PLAIN


def rows():
    return {"motor": np.array([[10.0, 20.0, 30.0, 40.0]]), "motor_cmd": np.array([[1.0, 2, 3, 4]])}


def test_without_places_the_order_stays():
    found = rows()
    assert order_motors(found, None, None) == []
    np.testing.assert_array_equal(found["motor"], [[10, 20, 30, 40]])
    assert order_motors({}, SHIPPED_ORDER, None) == []


def test_places_in_any_unit_set_the_order():
    found = rows()
    backwards = tuple((90.0 * x, 70.0 * y) for x, y in reversed(SHIPPED_ORDER))
    (finding,) = order_motors(found, backwards, None)
    np.testing.assert_array_equal(found["motor"], [[40, 30, 20, 10]])
    np.testing.assert_array_equal(found["motor_cmd"], [[4, 3, 2, 1]])
    assert finding.text == "put in the order of the shipped vehicles: the file's 4, 3, 2, 1"


def test_the_vehicles_own_hubs_go_before_the_shipped_ones():
    hubs = PLAIN.rotors.position
    turned = replace(PLAIN.rotors, position=(hubs[1], hubs[2], hubs[3], hubs[0]))
    found = rows()
    (finding,) = order_motors(found, SHIPPED_ORDER, replace(PLAIN, rotors=turned))
    np.testing.assert_array_equal(found["motor"], [[20, 30, 40, 10]])
    assert "vehicle 'plain'" in finding.text
