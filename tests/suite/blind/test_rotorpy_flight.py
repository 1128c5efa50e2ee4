"""What the blind set has RotorPy fly, and the damping by its moving hubs."""

from dataclasses import replace

import numpy as np
import pytest

from eval.flights.follow import FlightFailed
from eval.flights.simulate import fly
from eval.flights.trajectory import Trajectory
from eval.quadrotor.plant import Motion
from suite.blind.rotorpy_flight import check_effects, fly_rotorpy, hub_damping
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.geometry.rotation import to_world

WAYS = [Trajectory("figure_eight", 0.4, speed=2.0), Trajectory("hover", 0.2)]
LAGGED = with_lag(PLAIN, 0.03)
G = np.array([0.0, 0.0, 9.81])


def test_an_effect_that_rotorpy_does_not_have_as_it_is_is_refused():
    check_effects(with_effects(rotor_drag=(1e-5,)))
    with pytest.raises(ValueError, match="effects.linear_drag: RotorPy does not have it; allowed:"):
        check_effects(with_effects(linear_drag=((0.1, 0.1, 0.1),)))


def test_flights_side_by_side_are_each_as_if_alone_and_move_as_their_accelerometers_say():
    pytest.importorskip("rotorpy")
    truth = with_effects(LAGGED, rotor_drag=(4e-4,))
    short = [replace(way, duration_s=0.5 * way.duration_s) for way in WAYS]
    eight, hover = fly_rotorpy(LAGGED, truth, short, 100.0)
    assert (len(eight.time_s), len(hover.time_s), eight.period) == (100, 50, 5)
    assert eight.integrator is None
    (alone,) = fly_rotorpy(LAGGED, truth, short[1:], 100.0)
    np.testing.assert_allclose(alone.motion.pos_w, hover.motion.pos_w, atol=1e-9)
    felt_w = to_world(eight.motion.rot_w, eight.acc_b) - G
    between = 0.5 * (felt_w[1:-1] + felt_w[2:])
    moved = np.diff(eight.motion.vel_w, axis=0)[1:] / eight.dt
    np.testing.assert_allclose(moved, between, atol=2e-3)


def test_without_air_it_flies_as_mujoco_does_and_into_the_ground_it_fails():
    pytest.importorskip("rotorpy")
    (here,) = fly(LAGGED, LAGGED, WAYS[:1])
    (there,) = fly_rotorpy(LAGGED, LAGGED, WAYS[:1], 100.0)
    off = Motion(*(np.abs(a - b).max() for a, b in zip(here.motion, there.motion, strict=True)))
    assert off.pos_w < 1e-3 and off.vel_w < 3e-3 and off.rate_b < 0.03
    with pytest.raises(FlightFailed, match=r"flight 1 failed at \d\.\d\d s"):
        fly_rotorpy(LAGGED, LAGGED, [Trajectory("hover", 0.3, height=0.0)], 100.0)


K = 2e-6


@pytest.mark.parametrize(
    ("name", "plane"), [("rotor_drag", (1.0, 1.0, 0.0)), ("inflow", (0.0, 0.0, 1.0))]
)
def test_torque_of_hubs_in_a_turning_body(name, plane):
    place = np.asarray(PLAIN.rotors.position)
    speed = np.sqrt(PLAIN.mass * 9.81 / 4 / PLAIN.rotors.thrust_coefficient)
    rate_b = np.array([0.7, -1.1, 2.0])
    force = -K * speed * np.cross(rate_b, place) * plane
    torque = np.cross(place, force).sum(axis=0)
    found = hub_damping([{"name": name, "parameters": {"coefficient": K}}], PLAIN)
    np.testing.assert_allclose(-found * rate_b * PLAIN.inertia, torque, rtol=1e-3, atol=1e-9)
