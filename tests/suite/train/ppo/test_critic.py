"""What the critic sees, worked by hand: two gates along x, a sphere beside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.spec import PolicySpec
from suite.train.dynamics import point_mass
from suite.train.ppo import critic
from tests.suite.train.ppo.test_reward import worlds_with


def test_the_features_of_a_state():
    worlds = worlds_with((-1.0, 2.0, 50.0), 0.5)
    pos, vel, ahead = ([-1.0, 0.5, 50.0], [2.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    body = point_mass.start(*(jnp.asarray([x]) for x in (pos, vel, ahead)))
    body = body._replace(acc_w=jnp.asarray([[0.0, 5.0, 0.0]]))
    # The sphere's centre is 1.5 m to the left, and further behind as time goes on.
    distance = np.hypot(1.5, 2.0 * np.array(critic.AHEAD_S)) - 0.5
    expected = np.concatenate([
        [-0.2, 0.1, 0.0], [0.4, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.8, 0.0],
        ahead, [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], np.tanh([-2.0, 1.0, 0.0]),
        distance, np.exp(-distance / 0.2),
        [0.5], [1.0, 0.0], [1.0], [1.0],  # the plane in half a second, at the opening's edge
    ])  # fmt: skip
    features = jax.jit(critic.features)
    found = features(worlds, body, jnp.asarray([0]))
    assert found.shape == (1, critic.FEATURES)
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
    last = features(worlds, body, jnp.asarray([2]))[0]
    assert last[-1] == -1.0 and not np.any(last[9:12]), "no gate is left, and none comes after"


def test_the_features_gradient_is_that_of_finite_differences():
    """But for the direction away from the obstacle, which is held."""
    worlds = worlds_with((-1.0, 2.0, 50.0), 0.5)
    ahead = jnp.asarray([[1.0, 0.0, 0.0]])

    @jax.jit
    def seen(motion):
        body = point_mass.start(motion[None, :3], motion[None, 3:], ahead)
        return critic.features(worlds, body, jnp.asarray([0]))[0]

    motion, step = jnp.asarray([-1.0, 0.4, 50.1, 2.0, 0.3, -0.2]), 0.01
    found = jax.jacfwd(seen)(motion)
    sides = [(seen(motion + e) - seen(motion - e)) / (2 * step) for e in step * jnp.eye(6)]
    kept = np.delete(np.arange(critic.FEATURES), np.s_[18:21])
    np.testing.assert_allclose(found[kept], np.stack(sides, -1)[kept], atol=0.01)
    assert np.abs(found[24:29, 1]).min() > 0.5, "the distances are among them"


def test_the_last_number_is_how_fast_to_fly_where_the_policy_is_told():
    spec = PolicySpec(speed_input=True)
    assert critic.features_of(PolicySpec()) == critic.FEATURES == critic.features_of(spec) - 1
    worlds = worlds_with((-1.0, 2.0, 50.0), 0.5)._replace(wanted=jnp.asarray([0.3]))
    body = point_mass.start(*(jnp.asarray([x]) for x in ([-1.0, 0, 50], [2.0, 0, 0], [1.0, 0, 0])))
    found = critic.features(worlds, body, jnp.asarray([0]))
    assert found.shape == (1, critic.features_of(spec)) and found[0, -1] == pytest.approx(0.3)


def test_a_fresh_value_is_near_zero_and_is_that_of_a_plain_loop():
    params = jax.jit(critic.init, static_argnums=1)(jax.random.key(0), 6)
    seen = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, critic.FEATURES)))
    found = critic.value(params, seen)
    assert found.shape == (5, 3) and 0 < np.abs(found).max() < 0.05
    hidden = np.asarray(seen[2, 1])
    for layer in range(2):
        hidden = np.tanh(hidden @ params[f"weight{layer}"] + params[f"bias{layer}"])
    out = hidden @ params["weight2"] + params["bias2"]
    np.testing.assert_allclose(found[2, 1], out[0], rtol=1e-4, atol=1e-7)
