"""The validation on worlds built by hand: who coasts through, who must hit, and when it ends."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from suite.experiments.study import validation
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import sample_worlds
from tests.support.training import fresh_params, small_config, straight_worlds

CONFIG = small_config(
    batch=2, gates=2, physics={"drag": (0.0, 0.0), "wind_std": (0, 0, 0), "time_step_std": 0.0}
)
FLOWN = validation.validation_worlds(CONFIG, 2, 9, 1.0)
SPEED = 6.0


def params():
    """Return a policy that never accelerates: it coasts."""
    return {k: v * (k.split(".")[0] != "action") for k, v in fresh_params().items()}


def note(worlds, before, body, target):
    return jnp.ones_like(body.pos_w[:, 0]) * (1 + target)


@pytest.fixture(scope="module")
def measure():
    """Return a function from worlds to what coasting through them comes to."""
    flight = validation.make_flight(FLOWN, note)
    return lambda worlds: validation.mean_scores(flight(params(), worlds))


def straight(wall_x=50.0):
    """Return two worlds: gates 2 m and 4 m ahead, 6 m/s, and a wall across the second's path."""
    return straight_worlds(sample_worlds(FLOWN, 0), SPEED, wall_x)


def test_a_straight_flight_through_two_gates_is_a_success_and_a_wall_before_the_last_a_collision(
    measure,
):
    numbers = measure(straight())
    assert numbers["success_cross"] == numbers["collision_free"] == 1.0
    assert numbers["gates"] == 2 and numbers["v_max"] == pytest.approx(SPEED)
    # 0.2 m a step: the first gate in step 10 or 11 and the last in step 20 or 21, the trial's end.
    assert numbers["reward"] == pytest.approx(10 * 1 + 10 * 2, abs=2)
    numbers = measure(straight(wall_x=3.0))
    assert numbers["success_cross"] == numbers["collision_free"] == 0.5
    assert numbers["gates"] == 1.5 and numbers["v_max"] == pytest.approx(SPEED)
    assert measure(straight(wall_x=5.5))["collision_free"] == 1.0
    falling = straight()._replace(vel_w=np.array([[0, 0, -20]] * 2, np.float32))
    numbers = measure(falling)
    assert numbers["collision_free"] == numbers["success_cross"] == numbers["gates"] == 0.0


def test_scores_by_hand():
    clear, near = 1.0, BODY_RADIUS_M - 1e-3
    passed = np.array([[1, 1, 0, 1], [1, 0, 0, 1], [0, 1, 0, 0], [1, 1, 0, 0]], bool)
    clearance = np.array(
        [[clear] * 4, [clear, near, clear, near], [near, clear, clear, clear], [clear] * 4]
    )
    speed = np.array([[1.0, 4, 2, 1], [2, 5, 3, 2], [9, 9, 4, 9], [9, 9, 1, 9]])
    arrays = jnp.asarray(passed), jnp.asarray(clearance), jnp.asarray(speed)
    found = validation.score_trials(*arrays, 2, jnp.ones((4, 4)))
    # Both gates in two steps, a hit after it; a hit in step two; nothing; both in one step.
    assert found.gates.tolist() == [2, 1, 0, 1]
    assert found.crossed.tolist() == [True, False, False, False]
    assert found.collided.tolist() == [False, True, False, True]
    assert found.v_max.tolist() == [2, 5, 4, 2]
    assert found.reward.tolist() == [2, 2, 4, 2]


def test_worlds_are_fresh_fixed_and_all_at_rest():
    config = validation.validation_worlds(CONFIG, 5, 9, 2.0)
    one, two = sample_worlds(config, 0), sample_worlds(config, 0)
    assert np.array_equal(one.pos_w, two.pos_w) and not one.vel_w.any() and not one.target.any()
    assert one.scene.gates.center_w.shape[:2] == (5, 2) and config.episode.steps == 60
    assert (one.fov_scale == 1).all()
    trained = sample_worlds(validation.validation_worlds(CONFIG, 5, CONFIG.seed, 2.0), 0)
    assert not np.array_equal(one.pos_w, trained.pos_w)
    # A policy that takes a speed is commanded its own.
    spec = replace(CONFIG.spec, speed_input=True)
    asked = replace(CONFIG, spec=spec, episode=replace(CONFIG.episode, race_share=0.5))
    worlds = sample_worlds(validation.validation_worlds(asked, 40, 9, 2.0), 0)
    assert np.all(np.asarray(worlds.speed_command) == spec.speed)
