"""Trajectories, the loop of a pilot, and flights in MuJoCo: what is recorded, logged and fails."""

import numpy as np
import pytest

from eval.flights.follow import FlightFailed, Step, follow, reference_of
from eval.flights.simulate import FULL_V, SENSORS, fly, log_of
from eval.flights.trajectory import KINDS, Trajectory
from eval.quadrotor.plant import Command, Motion, Wrench, accelerations, make_plant
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tests.support.ways import BARE, CIRCLE, EIGHT, bare_flights, having

WAYS = [Trajectory("figure_eight", 1.5, speed=2.0), Trajectory("hover", 1.0)]
VEHICLE = with_effects(with_lag(PLAIN, 0.03), linear_drag=((0.3, 0.3, 0.1),))


class Wind:
    """A push along x, and commands that are a tenth too strong."""

    def command(self, command, time_s):
        return command._replace(thrust=1.1 * command.thrust)

    def wrench(self, motion, wrench, time_s, dt):
        return Wrench(np.full_like(motion.pos_w, [0.3, 0.0, 0.0]), np.zeros_like(motion.pos_w))


def test_a_recording_is_what_the_stepper_makes_of_its_commands():
    flight, hover = fly(PLAIN, VEHICLE, WAYS, extra=Wind())
    assert (len(flight.time_s), len(hover.time_s), flight.period) == (750, 500, 5)
    assert FULL_V == flight.voltage[0] > flight.voltage[-1]
    plant = make_plant(VEHICLE, flight.dt)
    state = PlantState(flight.rotor_speed, np.zeros((750, 4, 0)), {})
    acting = Inputs(Wind().command(flight.command, 0.0))
    state, wrench = plant_step(plant, state, flight.motion, acting, flight.time_s)
    np.testing.assert_allclose(state.rotor_speed[:-1], flight.rotor_speed[1:], rtol=1e-12)
    wrench = wrench._replace(force_b=wrench.force_b + [0.3, 0.0, 0.0])
    np.testing.assert_allclose(wrench.force_b[:-1] / 0.75, flight.acc_b[1:], atol=1e-9)
    acc_w, turn_b = accelerations(plant, flight.motion, wrench)
    moved = np.diff(flight.motion.vel_w, axis=0) / flight.dt
    np.testing.assert_allclose(moved, acc_w[:-1], atol=1e-8)
    turned = np.diff(flight.motion.rate_b, axis=0) / flight.dt
    np.testing.assert_allclose(turned, turn_b[:-1], atol=1e-8)


def test_a_flight_into_the_ground_fails_with_its_time():
    with pytest.raises(FlightFailed, match=r"flight 1 failed at \d\.\d\d s.*gentler"):
        fly(PLAIN, VEHICLE, [Trajectory("hover", 1.0, height=0.0)])


def test_a_rate_must_divide_the_rate_loops():
    with pytest.raises(ValueError, match="rate_hz = 130: must divide .* 500 Hz"):
        fly(PLAIN, VEHICLE, WAYS, rate_hz=130.0)


@pytest.fixture(scope="module")
def flights():
    return bare_flights()


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
        ("pos_w", sensors.pos), ("vel_w", sensors.vel), ("rate_b", sensors.gyro),
        ("acc_b", sensors.acc), ("rotor_speed", sensors.rotor), ("voltage", sensors.voltage),
    ):  # fmt: skip
        assert spread(name) == pytest.approx(stated, rel=0.06), name
    inner = np.abs([(draw.quat_wxyz * twin.quat_wxyz).sum(1) for draw in draws])
    angle = 2.0 * np.sqrt(np.maximum(2.0 * (1.0 - inner), 0.0))
    assert np.sqrt((angle**2).mean() / 3.0) == pytest.approx(sensors.attitude, rel=0.06)
    np.testing.assert_array_equal(twin.thrust_cmd, draws[0].thrust_cmd)


def test_a_log_says_how_its_simulator_stepped_and_holds_what_its_sensors_measure(flights):
    log = log_of(flights[0], BARE, SENSORS["capture"], None)
    assert log.velocity_derived and log.acc_b is None and log.rotor_speed is None
    assert log.integrator == "euler"
    continuous = flights[0]._replace(integrator=None)
    assert set(log_of(continuous, BARE, SENSORS["capture"], None).about) == {"source"}


def test_faults_of_the_log_are_in_the_log():
    truth = having(gyro_bias=((0.1, -0.2, 0.3),), clock_offset=(0.02,))
    flight = fly(BARE, truth, [EIGHT])[0]
    log = log_of(flight, truth, SENSORS["estimator"], None)
    rows = slice(None, None, flight.period)
    bias = log.rate_b - flight.motion.rate_b[rows]
    np.testing.assert_allclose(bias, np.tile([0.1, -0.2, 0.3], (len(bias), 1)), atol=1e-12)
    # 0.02 s are two rows of 0.01 s.
    np.testing.assert_allclose(log.pos_w[2:], flight.motion.pos_w[rows][:-2], atol=1e-9)


DT = 0.002
BOTH_WAYS = [Trajectory("circle", 0.4, speed=1.0), Trajectory("hover", 0.2)]


class Points:
    """Bodies that stay level and fall off their trajectories by `off_m` a second."""

    integrator: str | None = "none"

    def __init__(self, wanted, off_m=0.0):
        self.off_m, self.steps, self.commands = off_m, 0, []
        self.start_w = wanted.pos_w[0]

    def motion(self):
        count = len(self.start_w)
        pos_w = self.start_w + self.off_m * self.steps * DT * np.array([1.0, 0.0, 0.0])
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        still = np.zeros((count, 3))
        return Motion(pos_w, np.tile(np.eye(3), (count, 1, 1)), still, still), quat

    def step(self, motion, command, time_s):
        assert time_s == pytest.approx(self.steps * DT)
        self.steps += 1
        self.commands.append(command)
        count = len(self.start_w)
        felt = np.full((count, 3), float(self.steps))
        speed = np.full((count, 4), 10.0 * self.steps)
        return Step(speed, np.full(count, 16.0), felt)


def flown(off_m=0.0):
    wanted = reference_of(BOTH_WAYS, 5, DT)
    bodies = Points(wanted, off_m)
    return bodies, follow(bodies, PLAIN, BOTH_WAYS, wanted, 5, DT)


def test_each_flight_has_its_length_and_commands_are_held_for_a_period():
    bodies, (circle, hover) = flown()
    assert (len(circle.time_s), len(hover.time_s)) == (200, 100)
    assert circle.period == 5 and circle.integrator == "none"
    assert all(bodies.commands[k] is bodies.commands[5 * (k // 5)] for k in range(200))
    given = Command(*(np.array(part)[:100, 1] for part in zip(*bodies.commands, strict=True)))
    np.testing.assert_array_equal(hover.command.thrust, given.thrust)


def test_a_specific_force_stands_with_the_step_after_the_one_that_had_it():
    _, (circle, _) = flown()
    np.testing.assert_array_equal(circle.acc_b[0], [0.0, 0.0, 9.81])
    np.testing.assert_array_equal(circle.acc_b[1:, 0], np.arange(1.0, 200.0))
    np.testing.assert_array_equal(circle.rotor_speed[:, 0], 10.0 * np.arange(1.0, 201.0))


def test_a_flight_away_from_its_trajectory_fails_with_its_number():
    with pytest.raises(FlightFailed, match=r"flight [12] failed at 0\.\d\d s, 4\.\d m off"):
        flown(off_m=20.0)


def test_a_flight_is_not_judged_after_its_end():
    _, (_, hover) = flown(off_m=np.array([[0.0], [15.0]]))  # 3 m off at its end, then 6 m
    assert len(hover.time_s) == 100


def test_the_pilot_stays_on_the_trajectory():
    for way, flight in zip((EIGHT, CIRCLE), bare_flights(), strict=True):
        off = np.linalg.norm(way.reference(flight.time_s).pos_w - flight.motion.pos_w, axis=1)
        assert off.max() < 0.5


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
