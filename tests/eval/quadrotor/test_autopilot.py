"""The loops between a policy's action and the wrench on the body."""

import numpy as np

from eval.quadrotor.autopilot import autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.plant import Motion
from tests.support.vehicles import PLAIN

AUTOPILOT = make_autopilot(PLAIN)
LEVEL = Motion(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros((2, 3)))
AHEAD = np.tile([5.0, 0.0, 0.0], (2, 1))


def test_the_attitude_loop_runs_at_100_hz():
    assert (AUTOPILOT.dt, AUTOPILOT.attitude_every) == (0.002, 5)


def test_no_action_hovers():
    state = start_autopilot(AUTOPILOT, LEVEL)
    _, wrench = autopilot_step(AUTOPILOT, state, LEVEL, np.zeros((2, 3)), AHEAD, np.zeros(2, int))
    np.testing.assert_allclose(wrench.force_b, np.tile([0.0, 0.0, 0.75 * 9.81], (2, 1)))
    np.testing.assert_allclose(wrench.torque_b, 0.0, atol=1e-12)


def test_a_command_is_held_between_steps_of_the_attitude_loop():
    state = start_autopilot(AUTOPILOT, LEVEL)
    aside = np.tile([0.0, 5.0, 0.0], (2, 1))
    action_b = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]])
    after, _ = autopilot_step(AUTOPILOT, state, LEVEL, action_b, aside, np.array([5, 6]))
    np.testing.assert_allclose(after.command.thrust, [12.81, 9.81])
    # 6 1/s for 10 ms towards a gate at 90 degrees.
    turn = np.pi / 2 * (1 - np.exp(-0.06))
    np.testing.assert_allclose(after.heading_w[0], [np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(after.command.rate_b[:, 2], [4.0 * turn, 0.0])
    np.testing.assert_array_equal(after.heading_w[1], state.heading_w[1])
