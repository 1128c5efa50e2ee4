"""The reward and what the critic sees, worked by hand: gates along x, a sphere beside."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.spec import PolicySpec
from suite.train import losses
from suite.train.config import LossConfig
from suite.train.dynamics import point_mass
from suite.train.ppo import critic
from suite.train.ppo.reward import make_reward
from tests.support.training import boxes_worlds, small_config
from tracks.geometry.gates import square_gates
from tracks.geometry.scene import Gates, Spheres

CONFIG = small_config(1, 1, loss={"safety_radius_m": 0.2})
DT = 0.1
CENTERS = np.array([[0.0, 0, 50], [0, 4, 50]])
"""Of the two gates, both flown through along x; the ground is too far down to matter."""


@pytest.fixture(autouse=True)
def _gentle_barrier(monkeypatch):
    """Let the barrier reach as far as the sphere: the paper's ends after 0.1 m."""
    monkeypatch.setattr(losses, "BARRIER_SLOPE", -8.0)


def worlds_with(sphere_w):
    """Return a world of two gates and a sphere; the gates' frames are no solids."""
    worlds = boxes_worlds(CONFIG)
    zero, one = np.zeros(2), np.ones(2)
    gates = Gates(*(x[None] for x in square_gates(CENTERS, zero, one, 0.2 * one, 0.1 * one)))
    boxes = type(worlds.scene.boxes)(*(array[:, :0] for array in worlds.scene.boxes))
    spheres = Spheres(np.array([[sphere_w]], float), np.array([[0.5]]))
    scene = worlds.scene._replace(gates=gates, boxes=boxes, spheres=spheres)
    assert isinstance(worlds.constants, point_mass.PointMassParams)
    constants = worlds.constants._replace(time_step=np.full(1, DT))
    return jax.tree.map(np.asarray, worlds._replace(scene=scene, constants=constants))


def body_at(pos_w, vel_w=(0.0, 0, 0), acc_w=(0.0, 0, 0)):
    pos, vel, acc = (jnp.asarray([x], float) for x in (pos_w, vel_w, acc_w))
    return point_mass.start(pos, vel, jnp.asarray([[1.0, 0, 0]]))._replace(acc_w=acc)


@cache
def reward_of(config):
    """Return the reward, compiled once: op by op there is more to compile than to test."""
    return jax.jit(make_reward(config))


def rewarded(before, body, sphere_w=(0, 0, 90), target=0, config=CONFIG, wanted=None):
    """Return (terms as numbers by name, their sum, clearance, passed) of the step."""
    worlds = worlds_with(sphere_w)
    if wanted is not None:
        worlds = worlds._replace(speed_command=jnp.asarray([wanted]))
    terms, clearance, passed = reward_of(config)(worlds, before, body, jnp.asarray([target]))
    named = {name: float(term[0]) for name, term in terms._asdict().items()}
    return named, float(terms.total()[0]), float(clearance[0]), bool(passed[0])


def test_far_from_everything_there_is_progress_and_smoothness_alone():
    before = body_at((-3, 0, 54), acc_w=(1, 0, 0))
    body = body_at((-3, 0, 54), vel_w=(5, 7, 0), acc_w=(1, 2, 0))
    terms, total, _, passed = rewarded(before, body)
    # The gate is 5 m away in direction (3, 0, -4) / 5; the acceleration changed by 2 in 0.1 s.
    assert terms["progress"] == pytest.approx(0.4 * 5 * 3 / 5, rel=1e-5)
    assert terms["smooth"] == pytest.approx(-1e-2 * 5 - 1e-3 * 20**2, rel=1e-5)
    assert terms["collision"] == terms["passing"] == 0 and not passed
    assert terms["avoid"] == pytest.approx(0, abs=1e-6)
    assert total == pytest.approx(sum(terms.values()))


def test_a_solid_that_comes_closer_costs_by_distance_and_speed_and_within_the_radius_a_collision():
    place = (-3.0, 0, 50)
    body = body_at(place, vel_w=(0, 2, 0))
    # A sphere of 0.5 m whose centre is 0.9 m to the left: 0.4 m away, closing in at 2 m/s.
    terms, _, clearance, _ = rewarded(body_at(place), body, sphere_w=(-3, 0.9, 50))
    assert clearance == pytest.approx(0.4, abs=1e-5)
    barrier = np.log1p(np.exp(-8.0 * (0.4 - 0.2)))
    assert terms["avoid"] == pytest.approx(-6 * barrier - 3 * 2 * (1 - 0.4 + 0.2) ** 2, rel=1e-4)
    assert terms["collision"] == 0
    away, *_ = rewarded(body_at(place), body_at(place, (0, -2, 0)), sphere_w=(-3, 0.9, 50))
    assert away["avoid"] == pytest.approx(-6 * barrier, rel=1e-4)
    here = body_at((-3, 0, 50))
    for gap, collision in ((0.21, 0.0), (0.19, -30.0), (-0.1, -30.0)):
        terms, *_ = rewarded(here, here, sphere_w=(-3, 0.5 + gap, 50))
        assert terms["collision"] == collision
    before, body = body_at((-4, 0, 50)), body_at((-2, 0, 50))
    terms, _, clearance, _ = rewarded(before, body, sphere_w=(-3, 0.6, 50))
    assert clearance == pytest.approx(0.1, abs=1e-5) and terms["collision"] == -30


def test_a_pass_pays_once_and_the_progress_is_to_the_next_gate():
    before = body_at((-0.1, 0.3, 50))
    body = body_at((0.1, 0.3, 50), vel_w=(2, 3, 0))
    terms, _, _, passed = rewarded(before, body)
    assert passed and terms["passing"] == 110
    to_next = np.array([-0.1, 3.7])
    assert terms["progress"] == pytest.approx(
        0.4 * (to_next @ [2, 3]) / np.linalg.norm(to_next), rel=1e-5
    )
    beside, *_ = rewarded(before, body, target=1)
    beyond, *_ = rewarded(before, body, target=2)
    assert beside["passing"] == beyond["passing"] == 0
    backwards, *_ = rewarded(body_at((0.1, 0.3, 50)), body_at((-0.1, 0.3, 50)))
    assert backwards["passing"] == 0


def test_a_trainings_own_weights_change_nothing():
    before, body = body_at((-3, 0, 50)), body_at((-2.9, 0.1, 50), (1, 2, 0), (1, 2, 3))
    own = LossConfig(
        clearance=1.0, collide=7.0, acceleration=1.0, jerk=1.0, progress=9.0, progress_norm=3.0,
        projection=2.0, approach_m=1.0, pass_first=True, field_gain=0.0, safety_radius_m=0.2,
        crash_depth_m=1.0, speed_range=(0.1, 0.2), tilt=2.0,
    )  # fmt: skip
    near = (-2.9, 0.9, 50)
    changed = replace(CONFIG, loss=own)
    assert rewarded(before, body, near, config=changed) == rewarded(before, body, near)
    careful = rewarded(before, body, near, config=changed, wanted=0.1)
    assert careful == rewarded(before, body, near), "nor how fast a policy is asked to fly"


features = jax.jit(critic.features)


def test_the_feature_count_a_state():
    speed, spec = jnp.asarray([0.3]), PolicySpec(speed_input=True)
    worlds = worlds_with((-1.0, 2.0, 50.0))._replace(speed_command=speed)
    body = body_at([-1.0, 0.5, 50.0], [2.0, 0.0, 0.0])
    body = body._replace(acc_w=jnp.asarray([[0.0, 5.0, 0.0]]))
    # The sphere's centre is 1.5 m to the left, and further behind as time goes on.
    distance = np.hypot(1.5, 2.0 * np.array(critic.AHEAD_S)) - 0.5
    expected = np.concatenate([
        [-0.2, 0.1, 0.0], [0.4, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.8, 0.0],
        [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], np.tanh([-2.0, 1.0, 0.0]),
        distance, np.exp(-distance / 0.2),
        [0.5], [1.0, 0.0], [1.0], [1.0],  # the plane in half a second, at the opening's edge
        speed,
    ])  # fmt: skip
    found = features(worlds, body, jnp.asarray([0]))
    np.testing.assert_allclose(found, [expected], atol=1e-5)
    assert found.shape[1] == critic.feature_count(spec) == critic.feature_count(PolicySpec()) + 1
    last = features(worlds, body, jnp.asarray([2]))[0]
    assert last[-2] == -1.0 and not np.any(last[9:12]), "no gate is left, and none comes after"


def test_a_fresh_value_is_near_zero_and_is_that_of_a_plain_loop():
    params = jax.jit(critic.init, static_argnums=1)(jax.random.key(0), 6)
    seen = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, critic.FEATURES)))
    found = jax.jit(critic.value)(params, seen)
    assert found.shape == (5, 3) and 0 < np.abs(found).max() < 0.05
    value = np.asarray(seen[2, 1])
    for layer in range(3):
        value = value @ params[f"weight{layer}"] + params[f"bias{layer}"]
        value = np.tanh(value) if layer < 2 else value
    np.testing.assert_allclose(found[2, 1], value[0], rtol=1e-4, atol=1e-7)
