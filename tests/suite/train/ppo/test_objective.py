"""Advantages against a plain loop; the clipped objective against the policy gradient."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import network
from suite.train.ppo.config import PpoConfig
from suite.train.ppo.objective import Actor, Sequences, action_means, advantages, clipped_loss
from suite.train.ppo.rollout import log_probability
from tests.support.training import SPEC, doubled, fresh_params

STEPS, BATCH = 5, 3
CONFIG = PpoConfig(spec=SPEC, entropy=0.0)


pytestmark = pytest.mark.usefixtures("float64")


def test_advantages_are_those_of_a_plain_loop():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(7, 4)), rng.normal(size=(8, 4))
    done = rng.uniform(size=(7, 4)) < 0.3
    done[6] = [True, False, False, True]
    discount, trace = 0.9, 0.7
    expected = np.zeros_like(reward)
    for world, first in np.ndindex(4, 7):
        # The sum of later errors, each discounted, up to the end of its own episode.
        for step in range(first, 7):
            after = 0.0 if done[step, world] else discount * value[step + 1, world]
            error = reward[step, world] + after - value[step, world]
            expected[first, world] += (discount * trace) ** (step - first) * error
            if done[step, world]:
                break
    arrays = map(jnp.asarray, (reward, value, done))
    np.testing.assert_allclose(jax.jit(advantages)(*arrays, discount, trace), expected, rtol=1e-12)


def rollout_of(actor, seed=1, done=False):
    """Return embeddings and sequences of actions drawn from the actor itself."""
    rng = np.random.default_rng(seed)
    embeddings = jnp.asarray(rng.normal(size=(STEPS, BATCH, SPEC.hidden_size)))
    ends = np.zeros((STEPS, BATCH), bool)
    ends[2, 1] = done
    sequences = Sequences(
        state=jnp.asarray(rng.normal(size=(STEPS, BATCH, SPEC.state_size))),
        action_b=jnp.zeros((STEPS, BATCH, 3)),
        log_prob=jnp.zeros((STEPS, BATCH)),
        done=jnp.asarray(ends),
        advantage=jnp.asarray(rng.normal(size=(STEPS, BATCH))),
        start=jnp.asarray(rng.normal(size=(1, BATCH, SPEC.hidden_size))),
    )
    mean = means(actor.params, embeddings, sequences)
    action = mean + jnp.exp(actor.log_deviation) * rng.normal(size=mean.shape)
    log_prob = density(mean, actor.log_deviation, action)
    return embeddings, sequences._replace(action_b=action, log_prob=log_prob)


means, density, recur = map(jax.jit, (action_means, log_probability, network.recur))
loss_and_slope = jax.jit(
    jax.value_and_grad(clipped_loss, argnums=1, has_aux=True), static_argnums=0
)


def actor_of(seed=0):
    return doubled(Actor(fresh_params(seed=seed), jnp.log(jnp.asarray([0.5, 1.0, 2.0]))))


def test_where_nothing_has_changed_its_gradient_is_the_policy_gradient():
    """Central differences of -mean(log density x advantage) along random directions."""
    actor = actor_of()
    embeddings, sequences = rollout_of(actor, done=True)

    @jax.jit
    def surrogate(actor):
        mean = action_means(actor.params, embeddings, sequences)
        logs = log_probability(mean, actor.log_deviation, sequences.action_b)
        return -(logs * sequences.advantage).mean()

    (_, numbers), gradient = loss_and_slope(CONFIG, actor, embeddings, sequences)
    assert float(numbers["clipped"]) == 0 and float(numbers["divergence"]) == pytest.approx(0)
    rng = np.random.default_rng(3)
    actor, gradient = jax.tree.map(np.asarray, (actor, gradient))
    way = jax.tree.map(lambda x: rng.normal(size=x.shape), actor)
    moved = [jax.tree.map(lambda x, d, h=h: x + h * d, actor, way) for h in (1e-6, -1e-6)]
    slope = float(surrogate(moved[0]) - surrogate(moved[1])) / 2e-6
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: (g * d).sum(), gradient, way)))
    assert abs(slope) > 1e-2
    assert float(along) == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize(("ratio", "advantage", "gain", "learns"), [
    (1.5, 1.0, 1.2, False), (0.5, 1.0, 0.5, True), (1.5, -1.0, -1.5, True),
    (0.5, -1.0, -0.8, False),
])  # fmt: skip
def test_a_change_beyond_the_clip_is_not_rewarded(ratio, advantage, gain, learns):
    actor = actor_of()
    embeddings, sequences = rollout_of(actor)
    sequences = sequences._replace(
        log_prob=sequences.log_prob - np.log(ratio), advantage=np.full((STEPS, BATCH), advantage)
    )
    config = replace(CONFIG, clip=0.2)
    (loss, numbers), gradient = loss_and_slope(config, actor, embeddings, sequences)
    assert float(loss) == pytest.approx(-gain) and float(numbers["clipped"]) == 1
    assert bool(np.any(gradient.params["action.weight"])) == learns


def test_an_episode_that_ended_leaves_no_memory():
    """The world starts anew with its start's recurrent state, and its past has no gradient."""
    actor = actor_of()
    embeddings, sequences = rollout_of(actor, done=True)
    mean = means(actor.params, embeddings, sequences)
    hidden, again = sequences.start[0], []
    for step in (3, 4):
        action, hidden = recur(actor.params, hidden, embeddings[step], sequences.state[step])
        again.append(action)
    np.testing.assert_allclose(mean[3:, 1], jnp.stack(again)[:, 1], rtol=1e-12)
    assert not np.allclose(mean[3:, 0], jnp.stack(again)[:, 0])


def test_entropy_widens_the_exploration():
    actor = actor_of()
    embeddings, sequences = rollout_of(actor)
    sequences = sequences._replace(advantage=jnp.zeros((STEPS, BATCH)))
    _, gradient = loss_and_slope(replace(CONFIG, entropy=0.3), actor, embeddings, sequences)
    np.testing.assert_allclose(gradient.log_deviation, -0.3 * np.ones(3), rtol=1e-12)
