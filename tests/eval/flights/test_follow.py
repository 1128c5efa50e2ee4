"""The loop of a pilot, with bodies that do as they are told at once."""

import numpy as np
import pytest

from eval.flights.follow import FlightFailed, Step, follow, reference_of
from eval.flights.trajectory import Trajectory
from eval.quadrotor.plant import Command, Motion, Wrench
from tests.support.vehicles import PLAIN
from tests.support.ways import CIRCLE, EIGHT, bare_flights

DT = 0.002
WAYS = [Trajectory("circle", 0.4, speed=1.0), Trajectory("hover", 0.2)]


class Points:
    """Bodies that stay level and fall off their trajectories by `off_m` a second."""

    integrator: str | None = "none"

    def __init__(self, wanted, off_m=0.0):
        self.off_m, self.steps, self.commands = off_m, 0, []
        self.start_w = wanted.pos_w[0]

    def motion(self):
        count = len(self.start_w)
        pos_w = self.start_w + np.array([self.off_m * self.steps * DT, 0.0, 0.0])
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        still = np.zeros((count, 3))
        return Motion(pos_w, np.tile(np.eye(3), (count, 1, 1)), still, still), quat

    def step(self, motion, command, time_s):
        assert time_s == pytest.approx(self.steps * DT)
        self.steps += 1
        self.commands.append(command)
        count = len(self.start_w)
        still, felt = np.zeros((count, 3)), np.full((count, 3), float(self.steps))
        speed = np.full((count, 4), 10.0 * self.steps)
        return Step(speed, np.full(count, 16.0), command, Wrench(still, still), felt)


def flown(off_m=0.0):
    wanted = reference_of(WAYS, 5, DT)
    bodies = Points(wanted, off_m)
    return bodies, follow(bodies, PLAIN, WAYS, wanted, 5, DT)


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


def test_the_pilot_stays_on_the_trajectory():
    for way, flight in zip((EIGHT, CIRCLE), bare_flights(), strict=True):
        off = np.linalg.norm(way.reference(flight.time_s).pos_w - flight.motion.pos_w, axis=1)
        assert off.max() < 0.5
