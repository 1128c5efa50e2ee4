"""Logs of simulated flights: their noise, what they leave out, and their faults."""

import numpy as np
import pytest

from suite.diagnose.plans.simulate import SENSORS, fly, log_of
from tests.support.ways import BARE, EIGHT, bare_flights, having


@pytest.fixture(scope="module")
def flights():
    return bare_flights()


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


def test_a_log_says_how_its_simulator_stepped_where_the_step_shows(flights):
    assert log_of(flights[0], BARE, SENSORS["capture"], None).integrator == "euler"
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
