"""Held out is what can be spared; rotor speeds drive where the loop does not ask for them."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.hold_out import choose_held_out
from suite.diagnose.data.input_source import another_controller
from suite.diagnose.data.windows import cut
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)


@pytest.fixture(scope="module")
def three():
    logs = [replace(fly(LAGGED, k, duration_s=4.0), name=f"flight_{k}") for k in range(3)]
    windows, _ = cut(logs, LAGGED, False)
    return logs, windows


def test_a_flight_that_alone_tells_of_something_is_fitted(three):
    logs, windows = three
    told = np.ones((len(windows.flight), 2))
    told[windows.flight != 2, 1] = 1e-3
    inside, names = choose_held_out(logs, windows, told)
    assert names == ["flight_1"]
    assert set(windows.flight[inside]) == {0, 2}


def test_of_a_lone_flight_the_end_is_held_out(three):
    logs, _ = three
    windows, _ = cut(logs[:1], LAGGED, False)
    assert windows is not None
    inside, names = choose_held_out(logs[:1], windows, np.ones((len(windows.flight), 1)))
    assert names == ["flight_0 from 2.8 s"]
    assert inside.any() and not inside[-1]


def test_a_moved_centre_of_mass_is_no_other_controller():
    moved = with_effects(LAGGED, com_offset=((0.006, -0.004, 0.0),))
    assert not another_controller([fly(moved, 0, duration_s=4.0, motors=True)], LAGGED)


def test_speeds_that_the_loop_does_not_ask_for_are_another_controllers(three):
    log = fly(LAGGED, 0, duration_s=4.0, motors=True)
    assert log.rotor_speed is not None
    other = replace(log, rotor_speed=np.roll(log.rotor_speed, 1, axis=1))
    assert another_controller([other], LAGGED)
    assert not another_controller(three[0], LAGGED)
