"""A name that is in no table is answered with those that may have been meant."""

from tracks.common.names import unknown_name

EFFECTS = ("linear_drag", "quadratic_drag", "rotor_drag", "motor_lag", "gusts")


def said(name):
    return str(unknown_name("effect", name, EFFECTS))


def test_a_slip_of_the_finger_has_its_nearest_name():
    assert "Did you mean 'motor_lag'?" in said("moter_lag")


def test_a_part_of_names_has_those_that_hold_it():
    assert "Did you mean 'linear_drag', 'quadratic_drag', 'rotor_drag'?" in said("drag")
    assert "Did you mean" not in said("xy") and "Known: linear_drag" in said("xy")
