"""Rotor speeds are the input where the nominal loop does not ask for them, or it is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.verdict.actuators import flown_by_other_controller, rotors_are_input
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, REMEMBERING, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)


def test_a_moved_centre_of_mass_is_no_other_controller():
    moved = with_effects(LAGGED, com_offset=((0.006, -0.004, 0.0),))
    assert not flown_by_other_controller([fly(moved, 0, duration_s=4.0, motors=True)], LAGGED)


def test_speeds_that_the_loop_does_not_ask_for_are_another_controllers():
    log = fly(LAGGED, 0, duration_s=4.0, motors=True)
    assert log.rotor_speed is not None
    other = replace(log, rotor_speed=np.roll(log.rotor_speed, 1, axis=1))
    assert flown_by_other_controller([other], LAGGED)
    assert not flown_by_other_controller([fly(LAGGED, 0, duration_s=2.0)], LAGGED)


def test_the_columns_decide_what_can_be_the_input():
    log = fly(LAGGED, 0, duration_s=2.0, motors=True)
    no_motors = replace(log, rotor_speed=None)
    no_commands = replace(log, thrust_cmd=None, rate_cmd_b=None)
    assert not rotors_are_input([log], "auto", LAGGED)
    assert rotors_are_input([log], "motors", LAGGED)
    assert rotors_are_input([log, no_commands], "auto", LAGGED)
    with pytest.raises(ValueError, match="not every flight"):
        rotors_are_input([log, no_motors], "motors", LAGGED)
    with pytest.raises(ValueError, match="auto, commands, motors"):
        rotors_are_input([log], "wheels", LAGGED)


def test_commands_drive_no_loop_that_remembers():
    log = fly(LAGGED, 0, duration_s=2.0, motors=True)
    assert rotors_are_input([log], "auto", REMEMBERING)
    for given, drive in ((log, "commands"), (replace(log, rotor_speed=None), "auto")):
        with pytest.raises(ValueError, match="state of its crazyflie rate loop"):
            rotors_are_input([given], drive, REMEMBERING)
