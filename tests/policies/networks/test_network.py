"""A fresh network can be trained: its first steps leave its memory able to tell things apart."""

import jax
import jax.numpy as jnp
import optax
import pytest

from policies.networks import network
from policies.spec import PolicySpec

SPEC = PolicySpec(rate_hz=15.0)
CLIMB_B = jnp.asarray([1.0, 0.0, 1.0])
ADAMW = optax.adamw(2e-3, b2=0.99, weight_decay=1e-2)


def error(params, states, images):
    """Return how far all actions are from CLIMB_B, and the memory after the last."""

    def step(hidden, seen):
        action, hidden = network.step(params, hidden, *seen)
        return hidden, ((action - CLIMB_B) ** 2).sum(-1).mean()

    start = jnp.zeros((states.shape[1], SPEC.hidden_size))
    hidden, errors = jax.lax.scan(step, start, (states, images))
    return errors.mean(), hidden


@jax.jit
def learn(params, optimizer, key):
    states = jax.random.normal(key, (4, 16, SPEC.state_size))
    images = jax.random.uniform(key, (4, 16, SPEC.camera.height, SPEC.camera.width))
    (loss, hidden), gradient = jax.value_and_grad(error, has_aux=True)(params, states, images)
    change, optimizer = ADAMW.update(gradient, optimizer, params)
    return optax.apply_updates(params, change), optimizer, loss, hidden


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_one_action_for_all_is_learned_without_saturating_the_memory(seed):
    # What the first gradient steps of a training ask for. With outputs that start near zero the
    # memory's mean size comes to 0.85 to 0.91, and nothing that is seen changes it any more.
    params = network.init(jax.random.key(seed), SPEC)
    optimizer = ADAMW.init(params)
    loss, hidden = jnp.inf, jnp.zeros(1)
    for i in range(30):
        params, optimizer, loss, hidden = learn(params, optimizer, jax.random.key(100 + i))
    assert loss < 0.1
    assert jnp.abs(hidden).mean() < 0.65
