"""Commanded flights, their logs, and what is truly in them."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from eval.effects import EFFECTS
from suite.blind.oracle.information import Column, columns_of, detectable, information, left_over
from suite.blind.oracle.strength import given_vehicle
from suite.blind.oracle.stretches import cut
from suite.blind.outside import KINDS as OUTSIDE
from suite.blind.outside import make_outside
from suite.blind.sensors import SENSORS, log_of
from suite.diagnose.plans.separating import SEPARATIONS, plan_for, separations_of
from suite.diagnose.plans.simulate import FlightFailed, fly
from suite.diagnose.plans.trajectory import KINDS, Trajectory

EIGHT = Trajectory("figure_eight", duration_s=2.5, speed=4.0, size=2.0, turn="wobble")
CIRCLE = Trajectory("circle", duration_s=2.5, speed=3.0, size=3.0)
BARE = given_vehicle("bare")


def having(vehicle=BARE, **effects):
    values = {name: EFFECTS[name].values(*numbers) for name, numbers in effects.items()}
    return replace(vehicle, effects=MappingProxyType({**vehicle.effects, **values}))


@pytest.fixture(scope="module")
def flights():
    return fly(BARE, BARE, [EIGHT, CIRCLE])


@pytest.mark.parametrize("kind", KINDS)
def test_a_trajectory_starts_at_rest_and_its_velocity_is_its_slope(kind):
    way = Trajectory(kind, duration_s=4.0, speed=2.0, size=2.0, direction=0.7)
    time_s = np.linspace(0.0, 4.0, 2001)
    now = way.reference(time_s)
    np.testing.assert_allclose(now.vel_w[0], 0.0, atol=0.01)
    slope = np.gradient(now.pos_w, time_s, axis=0)[1:-1]
    np.testing.assert_allclose(now.vel_w[1:-1], slope, atol=2e-3)
    assert np.isfinite(now.acc_w).all()


def test_a_constant_circle_is_one():
    now = CIRCLE.reference(np.array([20.0]))
    assert np.linalg.norm(now.vel_w) == pytest.approx(3.0, rel=1e-3)
    assert np.linalg.norm(now.acc_w) == pytest.approx(3.0, rel=1e-3)  # v^2 / r


def test_unknown_words_are_refused():
    with pytest.raises(ValueError, match="cirkle"):
        Trajectory("cirkle").reference(np.zeros(1))
    with pytest.raises(ValueError, match="turn"):
        Trajectory("hover", turn="swep").reference(np.zeros(1))
    with pytest.raises(ValueError, match="rate_hz"):
        fly(BARE, BARE, [EIGHT], rate_hz=120.0)


def test_the_pilot_stays_on_the_trajectory(flights):
    for way, flight in zip((EIGHT, CIRCLE), flights, strict=True):
        off = np.linalg.norm(way.reference(flight.time_s).pos_w - flight.motion.pos_w, axis=1)
        assert off.max() < 0.5


def test_a_flight_that_cannot_be_flown_is_refused():
    with pytest.raises(FlightFailed, match="gentler"):
        fly(BARE, having(thrust_scale=(0.2,)), [EIGHT])


def test_flights_side_by_side_are_those_flown_alone(flights):
    alone = fly(BARE, BARE, [CIRCLE])[0]
    np.testing.assert_array_equal(alone.motion.pos_w, flights[1].motion.pos_w)


def test_noise_is_as_stated(flights):
    flight, sensors = flights[0], SENSORS["full"]
    twin = log_of(flight, BARE, sensors, None)
    draws = [log_of(flight, BARE, sensors, np.random.default_rng(seed)) for seed in range(8)]

    def spread(name):
        return np.std([getattr(draw, name) - getattr(twin, name) for draw in draws])

    for name, stated in (
        ("pos_w", sensors.pos),
        ("vel_w", sensors.vel),
        ("rate_b", sensors.gyro),
        ("acc_b", sensors.acc),
        ("rotor_speed", sensors.rotor),
        ("voltage", sensors.voltage),
    ):
        assert spread(name) == pytest.approx(stated, rel=0.06), name
    inner = np.abs([(draw.quat_wxyz * twin.quat_wxyz).sum(1) for draw in draws])
    angle = 2.0 * np.sqrt(np.maximum(2.0 * (1.0 - inner), 0.0))
    assert np.sqrt((angle**2).mean() / 3.0) == pytest.approx(sensors.attitude, rel=0.06)
    np.testing.assert_array_equal(twin.thrust_cmd, draws[0].thrust_cmd)


def test_a_log_without_velocity_does_not_carry_it(flights):
    log = log_of(flights[0], BARE, SENSORS["capture"], np.random.default_rng(0))
    assert log.velocity_derived and log.acc_b is None and log.rotor_speed is None


def test_faults_of_the_log_are_in_the_log():
    truth = having(gyro_bias=((0.1, -0.2, 0.3),), clock_offset=(0.02,))
    flight = fly(BARE, truth, [EIGHT])[0]
    log = log_of(flight, truth, SENSORS["estimator"], None)
    rows = slice(None, None, flight.period)
    bias = log.rate_b - flight.motion.rate_b[rows]
    np.testing.assert_allclose(bias, np.tile([0.1, -0.2, 0.3], (len(bias), 1)), atol=1e-12)
    # 0.02 s are two rows of 0.01 s.
    np.testing.assert_allclose(log.pos_w[2:], flight.motion.pos_w[rows][:-2], atol=1e-9)


def test_drag_is_in_the_flight_as_worked_by_hand():
    """Decelerations: two flights under the same command differ by D v in the first moments."""
    truth = having(linear_drag=((0.5, 0.5, 0.0),))
    with_it, without = fly(BARE, truth, [CIRCLE])[0], fly(BARE, BARE, [CIRCLE])[0]
    row = 500
    drag = with_it.acc_b[row, :2]
    vel_b = with_it.motion.rot_w[row - 1].T @ with_it.motion.vel_w[row - 1]
    np.testing.assert_allclose(drag, -0.5 * vel_b[:2], rtol=1e-6)
    np.testing.assert_allclose(without.acc_b[row, :2], 0.0, atol=1e-12)


@pytest.mark.parametrize("name", OUTSIDE)
def test_physics_outside_the_catalogue_moves_the_vehicle(name):
    way = Trajectory("climb", duration_s=2.0, speed=3.0, size=1.0)
    plain = fly(BARE, BARE, [way])[0]
    moved = fly(BARE, BARE, [way], extra=make_outside(name, OUTSIDE[name].usual, BARE.mass))[0]
    pushed = (
        np.abs(moved.extra.force_b).max() + np.abs(moved.acting.thrust - moved.command.thrust).max()
    )
    assert pushed > 0.0 and np.abs(moved.motion.pos_w - plain.motion.pos_w).max() > 1e-5


def test_a_hanging_load_weighs_what_it_weighs():
    flight = fly(
        BARE, BARE, [Trajectory("hover", 1.0)], extra=make_outside("slung_load", 0.03, BARE.mass)
    )[0]
    assert flight.extra.force_b[0, 2] == pytest.approx(-0.03 * 9.81, rel=1e-6)


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
    assert names == set(EFFECTS) - {"gusts"}
    assert Column("com_offset", "offset", 2) not in columns_of(False)
    sag = [c.parameter for c in columns_of(True) if c.effect == "battery_sag"]
    assert sag == ["per_volt"]


def test_plans_name_catalogue_effects_and_end_in_flights():
    for entry in SEPARATIONS:
        assert set(entry.pair) <= set(EFFECTS) and entry.pair[0] != entry.pair[1]
        assert entry.separating and entry.blurred and entry.words
    assert separations_of(["rotor_drag", "linear_drag"])[0].pair == ("linear_drag", "rotor_drag")
    assert plan_for(["gusts", "inflow"]), "an unknown pair gets the flights that excite most"
