"""How much flights tell of each number of the catalogue, and the table of strengths made of it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from eval.effects import nameable_effects
from eval.flights.simulate import SENSORS, log_of
from suite.blind.oracle import information as oracle
from suite.blind.oracle import strength
from suite.blind.oracle.strength import columns_in_table, detectable_along, strengths
from tests.support.ways import BARE, bare_flights

NAMES = ("rotor_drag", "linear_drag", "com_offset", "gyro_bias", "weak_motor")


@pytest.fixture(scope="module")
def flights():
    return [log_of(flight, BARE, SENSORS["capture"], None) for flight in bare_flights()]


@pytest.fixture(scope="module")
def info(flights):
    return oracle.information(BARE, flights, SENSORS["capture"])


def test_information_grows_with_flights_and_knows_hand_worked_parts(flights, info):
    one = oracle.information(BARE, flights[:1], SENSORS["capture"], NAMES)
    of_both = [info.columns.index(column) for column in one.columns]
    assert (np.diag(info.matrix)[of_both] >= np.diag(one.matrix) - 1e-9).all()
    # A gyro bias moves one channel by itself; each row says 1 / sigma^2, less what the unknown
    # start takes (its rate and its drift in attitude).
    index = one.columns.index(oracle.Column("gyro_bias", "bias", 2))
    stretches = int(flights[0].time_s[-1] - 0.3)
    most = 101 * stretches / SENSORS["capture"].gyro ** 2
    assert 0.1 * most < one.matrix[index, index] < most


def test_lookalikes_look_alike_and_strangers_do_not(info):
    size = 6.0 * oracle.detectable(info.block("rotor_drag"), np.ones(1))
    change = {"rotor_drag": size * np.ones(1)}
    near = oracle.remaining_ratio(info, change, "rotor_drag", "linear_drag", BARE)
    far = oracle.remaining_ratio(info, change, "rotor_drag", "com_offset", BARE)
    whole = 36.0 * 12.5
    assert near < 0.05 * whole and 0.5 * whole < far <= whole * (1 + 1e-6)
    (found,) = oracle.alternatives(info, change, BARE).values()
    assert "com_offset" not in found and "accelerometer_bias" not in found


def test_every_effect_has_columns_but_what_cannot_be_told():
    names = {column.effect for column in oracle.columns_of(False)}
    assert names == set(nameable_effects()) - {"gusts"}
    assert oracle.Column("com_offset", "offset", 2) not in oracle.columns_of(False)
    sag = [c.parameter for c in oracle.columns_of(True) if c.effect == "battery_sag"]
    assert sag == ["per_volt"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vehicle", "sensors", "names"),
    [
        ("dragged", "full", ["rotor_drag", "clock_offset", "weak_motor", "gusts"]),
        ("bare", "capture", ["constant_wind", "gusts"]),
    ],
)
def test_the_committed_table_is_what_is_worked_out(vehicle, sensors, names):
    stored = json.loads(strength.TABLE.read_text())["vehicles"][vehicle][sensors]
    assert list(stored) and set(stored) == set(nameable_effects())
    for name, entry in strengths(vehicle, sensors, names).items():
        assert entry["columns"] == stored[name]["columns"]
        if "matrix" in entry:
            np.testing.assert_allclose(entry["matrix"], stored[name]["matrix"], rtol=1e-6)
        else:
            kept = np.inf if stored[name]["detectable"] is None else stored[name]["detectable"]
            assert entry["detectable"] == pytest.approx(kept, rel=1e-6)


@pytest.mark.parametrize(("size", "strong"), [(0.0, False), (0.02, False), (1.0, True)])
def test_a_wind_beyond_its_bound_is_never_detectable(monkeypatch, size, strong):
    """What rotors in forward flight pass on of a wind would show a gust of 30 m/s."""
    rows = np.random.default_rng(0).standard_normal((40 * oracle.GUST_DRAWS, 30))
    monkeypatch.setattr(oracle, "fly", lambda *_, **__: [])
    monkeypatch.setattr(oracle, "linearised", lambda *_: SimpleNamespace(residual=size * rows))
    found = oracle.gust_strength(BARE, (), SENSORS["capture"], "gusts", np.random.default_rng(0))
    assert np.isfinite(found) == strong and (not strong or found < 8.0)


def test_an_effect_that_is_not_in_the_table_is_worked_out(monkeypatch):
    monkeypatch.setattr(strength, "_entry", strength._entry.__wrapped__)
    entry = {"columns": [["turn", 0], ["late", 0]], "matrix": [[25.0, 0.0], [0.0, 100.0]]}
    monkeypatch.setattr(strength, "strengths", lambda vehicle, sensors, names: {names[0]: entry})
    assert columns_in_table("bare", "full", "imu_fault")[1] == oracle.Column("imu_fault", "late", 0)
    assert detectable_along("bare", "full", "imu_fault", np.eye(2)[0]) == pytest.approx(1.0)
    assert detectable_along("bare", "full", "imu_fault", np.eye(2)[1]) == pytest.approx(0.5)
