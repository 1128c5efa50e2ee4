"""What a step is measured against: the gate to pass, the point to fly to, the nearest solid."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.train.config import LossConfig
from suite.train.dynamics import point_mass
from suite.train.losses import speed_to_goal, weighted
from suite.train.step import BEYOND_M, PATH_SAMPLES, approach_shift, make_step, target_gate
from tests.support.training import boxes_worlds, small_config

stepped = jax.jit(make_step, static_argnums=0)


@pytest.mark.parametrize(
    ("place_g", "shift"),
    [
        ((-4.0, 0.2, 0.1), 0.0),  # on the axis: straight on
        ((-4.0, 0.0, 1.0), 0.7),  # as much before the gate as it is off the axis, less 0.3
        ((0.0, 0.0, 1.2), 0.9),  # above the frame
        ((0.8, 0.6, 0.0), 1.1),  # beyond the plane
        ((2.0, 3.0, 0.0), 1.5),  # at most so far
    ],
)
def test_the_point_before_the_gate_that_progress_is_measured_to(place_g, shift):
    config = LossConfig(approach_m=1.5)
    found = approach_shift(config, jnp.array([place_g]))
    np.testing.assert_allclose(found, [shift], atol=1e-6)
    assert approach_shift(LossConfig(), jnp.array([place_g])) == 0.0


def test_past_the_last_gate_the_point_to_fly_to_lies_behind_it():
    worlds = boxes_worlds(small_config(3))
    gates, rows = worlds.scene.gates, np.arange(3)
    gate, goal_w = target_gate(gates, jnp.array([0, 7, 8]))
    number = np.array([0, 7, 7])
    np.testing.assert_allclose(gate.center_w, gates.center_w[rows, number])
    beyond = gates.rot_w[rows, number, :, 0] * np.array([0.0, 0.0, BEYOND_M])[:, None]
    np.testing.assert_allclose(goal_w, gate.center_w + beyond, atol=1e-5)
    after, _ = target_gate(gates, jnp.array([0, 7, 8]), ahead=1)
    np.testing.assert_allclose(after.center_w, gates.center_w[rows, [1, 7, 7]])


@pytest.mark.parametrize(("pass_first", "speed"), [(False, -3.0), (True, 3.0)])
def test_a_step_through_a_gate_and_its_numbers(pass_first, speed):
    """From 0.1 m before the first gate to 0.1 m behind it at 3 m/s; the second is straight on."""
    worlds = boxes_worlds(small_config(2))
    gates = worlds.scene.gates
    forward, center = gates.rot_w[:, 0, :, 0], np.array(gates.center_w)
    center[:, 1] = center[:, 0] + 4 * forward
    worlds = worlds._replace(scene=worlds.scene._replace(gates=gates._replace(center_w=center)))
    before, after = (
        point_mass.start(center[:, 0] + x * forward, 3 * forward, worlds.heading_w)
        for x in (-0.1, 0.1)
    )
    after = after._replace(acc_w=jnp.asarray([[1.0, 0, 0], [0, 2.0, 0]]))
    config = LossConfig(pass_first=pass_first)
    step = stepped(config, worlds, before, after, jnp.zeros(2, int))
    assert step.passed.all()
    np.testing.assert_allclose(speed_to_goal(step), [speed, speed], atol=1e-3)
    aim = center[:, int(pass_first)]
    turn = gates.rot_w[:, int(pass_first)]
    place = np.einsum("bij,bi->bj", turn, np.array(after.pos_w) - aim)
    np.testing.assert_allclose(step.place_g, place, atol=1e-4)
    np.testing.assert_allclose(step.jerk_w, after.acc_w / worlds.constants.time_step[:, None])
    assert step.gap.shape == (2, PATH_SAMPLES)
    np.testing.assert_allclose(step.clearance, step.gap.min(-1) + config.safety_radius_m, atol=1e-6)
    past = stepped(config, worlds, before, after, jnp.full(2, 8))
    assert not past.passed.any(), "all gates are passed already"


STILL = {
    "drag": (0.0, 0.0),
    "drag_up": (0.0, 0.0),
    "wind_std": (0.0, 0.0, 0.0),
    "action_delay": (0.0, 0.0),
}


@partial(jax.jit, static_argnums=0)
def flown(config, worlds):
    """Return the progress of one step without an action, and whether it passed a gate."""
    before = point_mass.start(worlds.pos_w, worlds.vel_w, worlds.heading_w)
    action_b, target_w = jnp.zeros_like(worlds.pos_w), worlds.pos_w + worlds.heading_w
    after = point_mass.step(before, worlds.constants, action_b, target_w, 0.0)
    step = make_step(config.loss, worlds, before, after, worlds.target)
    return weighted(config.loss, step)["progress"], step.passed


def at_first_gate(config, ahead_m):
    """Worlds that fly at 3 m/s along the first gate's axis, the next one 4 m behind it."""
    worlds = boxes_worlds(config)
    gates = worlds.scene.gates
    forward = gates.rot_w[:, 0, :, 0]
    center = np.array(gates.center_w)
    center[:, 1] = center[:, 0] + 4 * forward
    return worlds._replace(
        scene=worlds.scene._replace(gates=gates._replace(center_w=center)),
        pos_w=center[:, 0] - ahead_m * forward, vel_w=3 * forward,
        target=np.zeros(len(center), np.int32),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("ahead_m", "pass_first", "progress"),
    [(0.02, True, -3.0), (0.02, False, 3.0), (1.0, False, -3.0)],
)
def test_progress_of_the_step_that_passes_a_gate_and_of_the_one_before(
    ahead_m, pass_first, progress
):
    loss = {"progress": 1.0, "pass_first": pass_first}
    config = small_config(2, 1, physics=STILL, loss=loss)
    term, passed = flown(config, at_first_gate(config, ahead_m))
    assert passed.all() == (ahead_m < 0.1)
    np.testing.assert_allclose(term, progress, atol=0.2)


def test_hovering_above_the_frame_there_is_progress_to_be_made_backwards():
    """1.2 m above the gate the way to its centre is down, through the bar; the goal lies before."""
    terms = {}
    for approach in (0.0, 1.5):
        loss = {"progress": 1.0, "approach_m": approach}
        config = small_config(2, 1, physics=STILL, loss=loss)
        worlds = at_first_gate(config, 0.0)
        turn = worlds.scene.gates.rot_w[:, 0]
        worlds = worlds._replace(pos_w=worlds.pos_w + 1.2 * turn[:, :, 2], vel_w=-2 * turn[:, :, 0])
        terms[approach] = np.asarray(flown(config, worlds)[0])
    assert np.all(terms[0.0] > -0.3) and np.all(terms[1.5] < -0.8)
