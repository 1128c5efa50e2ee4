"""Flights in continuous time and in RotorPy, and the logs that are written of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.flights.follow import FlightFailed
from eval.flights.simulate import SENSORS, fly
from eval.flights.trajectory import Trajectory
from eval.quadrotor.plant import Motion
from suite.blind import continuous_flight, outside, rotorpy_flight
from suite.blind.continuous.body import POS, QUAT
from suite.blind.continuous.engine import Rows
from suite.blind.continuous.timing import Conditions
from tests.support.log_tables import assert_same
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.geometry.rotation import to_world

LAGGED = with_lag(PLAIN, 0.02)
WAYS = (
    Trajectory("figure_eight", 0.3, speed=4.0, size=2.0, turn="wobble"),
    Trajectory("climb", 0.2, speed=2.0, size=1.5),
)
SHORT = (Trajectory("figure_eight", 0.4, speed=2.0), Trajectory("hover", 0.2))
CONDITIONS = Conditions(733.0, 90.0, 0.3, 1e-4, 0.01, 0.7, 0.05)


def run(seed, truth=LAGGED, conditions=CONDITIONS, extra=None):
    rng = np.random.default_rng(seed)
    flown = continuous_flight.fly_continuous(LAGGED, truth, WAYS, conditions, rng, extra)
    return flown, continuous_flight.logs_of(flown, WAYS, truth, SENSORS["full"], conditions, rng)


@pytest.fixture(scope="module")
def fifth():
    return run(5)


@pytest.mark.extended
def test_the_same_seed_gives_the_same_bits_and_another_one_does_not(fifth):
    (_, first), (_, again), (_, other) = fifth, run(5), run(6)
    for one, two in zip(first, again, strict=True):
        assert_same(one, two)
    assert first[0].time_s[3] != other[0].time_s[3] and first[0].pos_w[3, 0] != other[0].pos_w[3, 0]


def test_logs_are_as_long_as_their_trajectories_and_say_nothing(fifth):
    flown, logs = fifth
    for log, way in zip(logs, WAYS, strict=True):
        assert abs(log.time_s[0]) <= 1e-4 and way.duration_s - 0.03 < log.time_s[-1]
        assert log.time_s[-1] < way.duration_s + 1e-4
        assert log.about == {"source": "suite blind", "vehicle": "plain"}
        assert log.integrator is None
        # The controller keeps it on its trajectory.
        assert np.abs(log.pos_w - way.reference(log.time_s).pos_w).max() < 1.5
    assert flown.schedule.stamp_s[0].max() < -0.2, "it flew before the first row"


def test_a_flight_that_cannot_be_flown_fails_by_name():
    heavy = with_effects(LAGGED, mass_offset=(2.0,))
    with pytest.raises(FlightFailed, match="flight [12] failed at .* off its trajectory"):
        run(5, heavy)


@pytest.mark.extended
def test_physics_from_outside_acts_and_is_recorded(fifth):
    plain, _ = fifth
    flown, _ = run(5, extra=outside.KINDS["tether"].make(0.1, 0.75))
    state = flown.state[:-1].reshape(-1, 13)
    turn = Rotation.from_quat(state[:, QUAT], scalar_first=True)
    # A spring of 0.1 1/s^2 x 0.75 kg to (1, -1, 0), held for a step at a time.
    pull_w = turn.apply(flown.push_b.reshape(-1, 3))
    np.testing.assert_allclose(pull_w, -0.075 * (state[:, POS] - [1.0, -1.0, 0.0]), atol=1e-9)
    assert np.abs(flown.state[-1] - plain.state[-1]).max() > 1e-3
    bent, _ = run(5, extra=outside.KINDS["bent_thrust"].make(0.2, 0.75))
    given = bent.command[..., 0]
    np.testing.assert_allclose(bent.acting[..., 0], given + 0.2 * (given - 9.81) ** 2 / 9.81)


def test_the_loop_of_the_conditions_is_the_one_that_flies():
    slow = Conditions(200.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.1)
    flown, _ = run(5, conditions=slow)
    ticks = flown.schedule.start_s[flown.schedule.is_tick[:, 0], 0]
    np.testing.assert_allclose(np.diff(ticks), 0.005, atol=1e-9)
    assert continuous_flight.with_loop_frequency(LAGGED, 321.0).controller.frequency == 321.0


def test_a_flight_is_not_checked_after_its_end():
    stamp_s = np.array([[0.4, 0.4], [0.5, 0.5]])  # the log of the second one needs 0.45 s
    pilot = continuous_flight._Pilot(LAGGED, WAYS, stamp_s, None)
    level, still, off_m = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.array([[0.0], [99.0]])
    before, after = (
        Rows(row, stamp_s[row], pilot.reference(row).pos_w + off_m, level, still, still)
        for row in range(2)
    )
    assert np.isfinite(pilot(after)[0]).all()
    with pytest.raises(FlightFailed, match="flight 2"):
        pilot(before)


def test_an_effect_that_rotorpy_does_not_have_as_it_is_is_refused():
    truth = with_effects(linear_drag=((0.1, 0.1, 0.1),), rotor_drag=(1e-5,))
    with pytest.raises(ValueError, match="effects.linear_drag: RotorPy does not have it; allowed:"):
        rotorpy_flight.fly_rotorpy(LAGGED, truth, SHORT, 100.0)


@pytest.mark.extended
def test_flights_side_by_side_are_each_as_if_alone_and_move_as_their_accelerometers_say():
    pytest.importorskip("rotorpy")
    truth = with_effects(LAGGED, rotor_drag=(4e-4,))
    short = [replace(way, duration_s=0.5 * way.duration_s) for way in SHORT]
    eight, hover = rotorpy_flight.fly_rotorpy(LAGGED, truth, short, 100.0)
    assert (len(eight.time_s), len(hover.time_s), eight.period) == (100, 50, 5)
    assert eight.integrator is None
    (alone,) = rotorpy_flight.fly_rotorpy(LAGGED, truth, short[1:], 100.0)
    np.testing.assert_allclose(alone.motion.pos_w, hover.motion.pos_w, atol=1e-9)
    felt_w = to_world(eight.motion.rot_w, eight.acc_b) - [0.0, 0.0, 9.81]
    between = 0.5 * (felt_w[1:-1] + felt_w[2:])
    moved = np.diff(eight.motion.vel_w, axis=0)[1:] / eight.dt
    np.testing.assert_allclose(moved, between, atol=2e-3)


@pytest.mark.extended
def test_without_air_it_flies_as_mujoco_does_and_into_the_ground_it_fails():
    pytest.importorskip("rotorpy")
    way = [replace(SHORT[0], duration_s=0.2)]
    (here,) = fly(LAGGED, LAGGED, way)
    (there,) = rotorpy_flight.fly_rotorpy(LAGGED, LAGGED, way, 100.0)
    off = Motion(*(np.abs(a - b).max() for a, b in zip(here.motion, there.motion, strict=True)))
    assert off.pos_w < 1e-3 and off.vel_w < 3e-3 and off.rate_b < 0.03
    with pytest.raises(FlightFailed, match=r"flight 1 failed at \d\.\d\d s"):
        rotorpy_flight.fly_rotorpy(LAGGED, LAGGED, [Trajectory("hover", 0.3, height=0.0)], 100.0)


@pytest.mark.parametrize(
    ("name", "plane"), [("rotor_drag", (1.0, 1.0, 0.0)), ("inflow", (0.0, 0.0, 1.0))]
)
def test_torque_of_hubs_in_a_turning_body(name, plane):
    place, drag = np.asarray(PLAIN.rotors.position), 2e-6
    speed = np.sqrt(PLAIN.mass * 9.81 / 4 / PLAIN.rotors.thrust_coefficient)
    rate_b = np.array([0.7, -1.1, 2.0])
    force = -drag * speed * np.cross(rate_b, place) * plane
    torque = np.cross(place, force).sum(axis=0)
    found = rotorpy_flight.hub_damping([{"name": name, "parameters": {"coefficient": drag}}], PLAIN)
    np.testing.assert_allclose(-found * rate_b * PLAIN.inertia, torque, rtol=1e-3, atol=1e-9)
