"""How much flights tell of each number of the catalogue."""

import numpy as np
import pytest

from eval.effects import nameable_effects
from suite.blind.oracle.information import Column, columns_of, detectable, information, left_over
from suite.blind.oracle.stretches import cut
from suite.diagnose.plans.sensors import SENSORS
from tests.support.ways import BARE, bare_flights


@pytest.fixture(scope="module")
def flights():
    return bare_flights()


def test_information_grows_with_flights_and_knows_hand_worked_parts(flights):
    sensors = SENSORS["estimator"]
    both, one = (information(BARE, cut(f), sensors) for f in (flights, flights[:1]))
    assert (np.diag(both.matrix) >= np.diag(one.matrix) - 1e-9).all()
    # A gyro bias moves one channel by itself; each row says 1 / sigma^2, less what the unknown
    # start takes (its rate and its drift in attitude).
    index = one.columns.index(Column("gyro_bias", "bias", 2))
    rows = 51 * sum(1 for _ in range(25, 1250 - 250, 250))
    most = rows / sensors.gyro**2
    assert 0.1 * most < one.matrix[index, index] < most


def test_lookalikes_look_alike_and_strangers_do_not(flights):
    info = information(BARE, cut(flights), SENSORS["capture"])
    change = {"rotor_drag": 6.0 * detectable(info.block("rotor_drag"), np.ones(1)) * np.ones(1)}
    near = left_over(info, change, "rotor_drag", "linear_drag", BARE)
    far = left_over(info, change, "rotor_drag", "com_offset", BARE)
    whole = 36.0 * 12.5
    assert near < 0.05 * whole and 0.5 * whole < far <= whole * (1 + 1e-6)


def test_every_effect_has_columns_but_what_cannot_be_told():
    names = {column.effect for column in columns_of(False)}
    assert names == set(nameable_effects()) - {"gusts"}
    assert Column("com_offset", "offset", 2) not in columns_of(False)
    sag = [c.parameter for c in columns_of(True) if c.effect == "battery_sag"]
    assert sag == ["per_volt"]
