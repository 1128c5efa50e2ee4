"""Fitted numbers become entries of a vehicle file, and only identified ones are put in."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.body import lag_unknowns
from suite.diagnose.identify.entries import (
    DELAY,
    inertia_from,
    loop_entries,
    with_entries,
    with_entry,
    with_reachable_speed,
)
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.numbers import Number
from tests.support.vehicles import PLAIN, with_effects


def test_the_inertia_about_z_follows_within_what_a_body_can_have():
    found = inertia_from(PLAIN, {"inertia_x": 0.2, "inertia_y": 0.0})
    np.testing.assert_allclose(found[2], PLAIN.inertia[2] * np.exp(0.1))
    assert np.all(found <= found.sum() - found + 1e-15)


def test_what_was_told_is_put_in_and_the_rest_stays():
    lag = Number("rotors.time_constant", "s", [0.05], [(0.04, 0.06)])
    assert with_entry(PLAIN, lag).rotors.time_constant == 0.05
    assert with_entry(PLAIN, lag._replace(ci95=[None])) == PLAIN
    drag = Number("effects.linear_drag.coefficient", "1/s", [0.3, 0.1, 0.0], [(0.2, 0.4)] * 3)
    assert with_entry(PLAIN, drag).effects["linear_drag"].coefficient == (0.3, 0.1, 0.0)


def test_what_no_file_may_hold_is_said_as_it_is_in_the_file():
    spans = [(0.2, 0.4), (-0.2, 0.0), None]
    drag = Number("effects.linear_drag.coefficient", "1/s", [0.3, -0.1, 0.0], spans)
    vehicle, (entry,), (note,) = with_entries(PLAIN, [drag])
    assert vehicle.effects["linear_drag"].coefficient == tuple(entry.value) == (0.3, 0.0, 0.0)
    assert entry.ci95 == spans
    assert note == (
        "effects.linear_drag.coefficient[1]: these flights give -0.1 (-0.2 to 0) 1/s; "
        "the file has 0, the nearest allowed value"
    )


def test_a_delay_that_flights_deny_goes_and_is_said_to():
    late = with_effects(PLAIN, command_delay=(0.03,), linear_drag=((0.1, 0.1, 0.1),))
    none = Number(DELAY, "s", [-0.001], [(-0.002, 0.0)])
    vehicle, numbers, (note,) = with_entries(late, [none])
    assert set(vehicle.effects) == {"linear_drag"} and numbers == []
    assert note.endswith("these flights give -0.001 (-0.002 to 0) s; the file has none")
    not_identified = none._replace(ci95=[None])
    assert with_entries(late, [not_identified])[0] == late


@pytest.mark.parametrize(("half", "identified"), [(0.008, True), (0.009, False)])
def test_a_delay_is_no_better_known_than_the_lag_however_well_their_sum_is(half, identified):
    """12 ms is the most: a sum of 8 ms less a lag of 8 ms is in doubt by 11.3 ms."""
    covariance = np.diag([half**2, half**2]) / 1.96**2
    fitted = Fitted(
        tuple(lag_unknowns(0.03, 0.01)), np.array([0.05, 0.03]), np.full(2, half), covariance
    )
    (delay,) = [entry for entry in loop_entries(PLAIN, fitted, 0.03) if entry.key == DELAY]
    assert (delay.ci95 != [None]) == identified
    assert delay.follows != identified
    # The file keeps the sum.
    assert with_entries(PLAIN, [delay])[0].effects["command_delay"].delay == pytest.approx(0.02)
    gone = delay._replace(value=[-0.003])
    assert "command_delay" not in with_entries(PLAIN, [gone])[0].effects


def test_rotors_that_are_too_slow_to_hover_get_the_speed_that_they_flew_at():
    """1.6e-6 x 1000^2 = 1.6 N a rotor, of 1.84 N that are needed."""
    speeds = [np.full((50, 4), 1100.0), np.full((60, 4), 1200.0), np.full((1, 4), 9e4)]
    slow = replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=1000.0))
    assert with_reachable_speed(slow, speeds).rotors.speed_max == 1200.0
    assert with_reachable_speed(PLAIN, speeds) == PLAIN
