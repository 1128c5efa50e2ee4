"""From an action to a command and a wrench: frames, limits, attitudes without obvious answer."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.autopilot import autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Controller
from tests.support.vehicles import PLAIN
from tracks.geometry.rotation import exp_rot

CONTROLLER = Controller(rate_gain=(20.0, 20.0, 8.0), frequency=500.0)
NORTH = np.array([1.0, 0.0, 0.0])
LEVEL = np.eye(3)
HOVER = np.array([0.0, 0.0, 9.81])


def command(force_w, rot_w=LEVEL, heading_w=NORTH):
    return attitude_command(CONTROLLER, np.asarray(force_w, dtype=float), rot_w, heading_w)


@pytest.mark.parametrize(
    ("force_w", "heading_w", "expected"),
    [
        # Forward: nose down, +y, at 8 1/s; left: roll left side down, -x.
        ([9.81 * np.tan(0.1), 0.0, 9.81], NORTH, [0.0, 0.8, 0.0]),
        ([0.0, 9.81 * np.tan(0.1), 9.81], NORTH, [-0.8, 0.0, 0.0]),
        # Heading 0.2 rad to the left: yaw left at 4 1/s.
        (HOVER, [np.cos(0.2), np.sin(0.2), 0.0], [0.0, 0.0, 0.8]),
        # Right behind: as fast as it goes.
        (HOVER, [np.cos(3.0), np.sin(3.0), 0.0], [0.0, 0.0, 6.0]),
        ([9.81, 0.0, 0.0], NORTH, [0.0, 6.0, 0.0]),
    ],
)
def test_rates_by_hand(force_w, heading_w, expected):
    np.testing.assert_allclose(command(force_w, LEVEL, np.array(heading_w)).rate_b, expected)


def test_thrust_is_what_body_z_can_give_and_never_negative():
    assert command([5.0, 0.0, 8.0]).thrust == pytest.approx(8.0)
    assert command([0.0, 0.0, -5.0]).thrust == 0.0


def test_no_force_holds_the_tilt():
    tilted = Rotation.from_euler("xyz", [0.4, -0.3, 0.0]).as_matrix()
    np.testing.assert_allclose(command([1e-9, 0.0, -1e-9], tilted).rate_b[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(command([0.0, 0.0, 0.0], LEVEL).rate_b, 0.0, atol=1e-12)


def test_force_along_the_heading_holds_the_heading():
    pitched = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    thrust, rate = command([15.0, 0.0, 0.0], pitched)
    assert thrust == pytest.approx(15.0)
    np.testing.assert_allclose(rate, 0.0, atol=1e-9)


def test_upside_down_rolls_over():
    _, rate = command([0.0, 0.0, -9.81])
    np.testing.assert_allclose(np.abs(rate), [6.0, 0.0, 0.0], atol=1e-9)


DIRECTIONS = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)
ANGLES = st.floats(-np.pi, np.pi)


@given(DIRECTIONS, st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3), ANGLES)
def test_the_error_is_the_turn_to_the_goal(direction, start, heading):
    """The tilt by the shortest arc and then the yaw lead exactly to where it was asked to be."""
    size = np.linalg.norm(direction)
    up_w = direction / size if size > 0.1 else np.array([0.0, 0.0, 1.0])
    heading_w = np.array([np.cos(heading), np.sin(heading), 0.0])
    rot_w = exp_rot(np.array(start))
    unlimited = replace(CONTROLLER, rate_max=(100.0, 100.0, 100.0))
    rate = attitude_command(unlimited, 12.0 * up_w, rot_w, heading_w).rate_b
    tilt, yaw = np.array([rate[0] / 8.0, rate[1] / 8.0, 0.0]), np.array([0.0, 0.0, rate[2] / 4.0])
    tilted = rot_w @ exp_rot(tilt)
    np.testing.assert_allclose(tilted[:, 2], up_w, atol=1e-5)
    flat = heading_w - (heading_w @ up_w) * up_w
    if np.linalg.norm(flat) > 0.01 and up_w @ rot_w[:, 2] > -0.999:
        turned = tilted @ exp_rot(yaw)
        np.testing.assert_allclose(turned[:, 0], flat / np.linalg.norm(flat), atol=1e-4)


def test_gradients_are_finite_everywhere():
    """Those in hover and around it have their size in test_gradients.py."""
    slopes = jax.jit(jax.vmap(jax.jacobian(partial(attitude_command, CONTROLLER), (0, 1, 2))))
    force_w = np.array([HOVER, -HOVER, 0 * HOVER, [9.81, 0.0, 0.0], [1.0, 2.0, 9.81], HOVER])
    heading_w = np.array([*[NORTH] * 4, [0.0, 1.0, 0.0], -NORTH])
    for part in jax.tree.leaves(slopes(force_w, np.tile(LEVEL, (6, 1, 1)), heading_w)):
        assert np.isfinite(part).all()


def test_heading_turns_with_first_order():
    gate = np.array([0.0, 4.0, 2.0])
    heading = blend_heading(NORTH, gate, 0.1)
    left = np.arctan2(heading[0], heading[1])
    assert left == pytest.approx(np.pi / 2 * np.exp(-0.6))
    # Two half steps are one whole step.
    twice = blend_heading(blend_heading(NORTH, gate, 0.05), gate, 0.05)
    np.testing.assert_allclose(twice, heading, atol=1e-12)


def test_heading_leaves_a_gate_right_behind_and_holds_for_one_straight_above():
    heading = NORTH
    for _ in range(100):
        heading = blend_heading(heading, np.array([-1.0, 0.0, 0.0]), 0.02)
    np.testing.assert_allclose(heading, [-1.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(blend_heading(NORTH, np.array([0.0, 0.0, 3.0]), 0.1), NORTH)


def test_level_heading():
    pitched = Rotation.from_euler("ZY", [0.5, 0.7]).as_matrix()
    np.testing.assert_allclose(level_heading(pitched), [np.cos(0.5), np.sin(0.5), 0.0], atol=1e-12)
    down = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(np.linalg.norm(level_heading(down)), 1.0)


AUTOPILOT = make_autopilot(PLAIN)
RESTING = Motion(
    np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros((2, 3))
)
AHEAD = np.tile([5.0, 0.0, 0.0], (2, 1))


def test_action_is_in_body_axes_and_gravity_in_the_world():
    yawed = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    force_w = action_to_force(np.array([1.0, 0.0, 0.5]), yawed)
    np.testing.assert_allclose(force_w, [0.0, 1.0, 10.31], atol=1e-12)


def test_no_action_hovers():
    state = start_autopilot(AUTOPILOT, RESTING)
    _, wrench = autopilot_step(AUTOPILOT, state, RESTING, np.zeros((2, 3)), AHEAD, np.zeros(2, int))
    np.testing.assert_allclose(wrench.force_b, np.tile([0.0, 0.0, 0.75 * 9.81], (2, 1)))
    np.testing.assert_allclose(wrench.torque_b, 0.0, atol=1e-12)


def test_a_command_is_held_between_steps_of_the_attitude_loop():
    state = start_autopilot(AUTOPILOT, RESTING)
    aside = np.tile([0.0, 5.0, 0.0], (2, 1))
    action_b = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]])
    after, _ = autopilot_step(AUTOPILOT, state, RESTING, action_b, aside, np.array([5, 6]))
    np.testing.assert_allclose(after.command.thrust, [12.81, 9.81])
    # 6 1/s for 10 ms towards a gate at 90 degrees.
    turn = np.pi / 2 * (1 - np.exp(-0.06))
    np.testing.assert_allclose(after.heading_w[0], [np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(after.command.rate_b[:, 2], [4.0 * turn, 0.0])
    np.testing.assert_array_equal(after.heading_w[1], state.heading_w[1])
