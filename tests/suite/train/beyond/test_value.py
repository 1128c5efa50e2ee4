"""The value of what comes after a rollout: its returns by hand, what it learns and what it does."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.networks import network
from suite.train.beyond import critic, value
from suite.train.config import CriticConfig
from suite.train.gradient import make_gradient
from suite.train.rollout import make_rollout
from tests.support.training import (
    KEY,
    SPEC,
    boxes_worlds,
    fresh_params,
    largest_difference,
    small_config,
)

CONFIG = replace(
    small_config(loss={"value": 1.6}), critic=CriticConfig(horizon_s=0.5, trace=0.8, size=16)
)
gradient_of = jax.jit(make_gradient(CONFIG))
FADE = np.exp(-1.0 / (0.5 * SPEC.rate_hz))


def way_of(worth, alive, hit, stopped=None):
    """Return a rollout of one world, of which the critic sees nothing but zeros."""
    stopped = np.zeros_like(hit) if stopped is None else stopped
    worth, alive, hit, stopped = (jnp.asarray(x)[:, None] for x in (worth, alive, hit, stopped))
    return value.Way(jnp.zeros((*alive.shape, critic.FEATURES)), worth, 1.0 * alive, hit, stopped)


@pytest.mark.parametrize("ends", ["not", "crash", "crash at the end", "finish", "stop"])
def test_returns_are_those_of_a_plain_loop(ends):
    worth, says = np.array([3.0, 5.0, 1.0]), np.array([2.0, 3.0, 7.0, 6.0])
    goes_on = ends in ("not", "crash at the end")
    on = np.array([True, True, goes_on, ends == "not"])
    hit = np.arange(3) == {"crash": 1, "crash at the end": 2}.get(ends)
    way = way_of(worth, on, hit, (np.arange(3) >= 1) & (ends == "stop"))
    found = value.returns(CONFIG, jnp.asarray(says)[:, None], way)[:, 0]
    expected, later = np.zeros(3), says[3]
    for t in (2, 1, 0):
        ahead = 0.2 * says[t + 1] + 0.8 * later
        if hit[t]:
            ahead = 0.0
        elif not on[t + 1]:
            ahead = says[t + 1] if ends == "stop" else worth[t - 1]
        expected[t] = later = (1 - FADE) * worth[t] + FADE * ahead
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_constant_speed_is_worth_itself_and_its_loss_is_that_of_all_the_way_to_come():
    way = way_of(np.full(4, 5.0), np.ones(5, bool), np.zeros(4, bool))
    np.testing.assert_allclose(value.returns(CONFIG, jnp.full((5, 1), 5.0), way), 5.0, rtol=1e-6)
    to_come = 5.0 * sum(FADE**k for k in range(1000))
    paid = float(value.to_come(CONFIG, jnp.asarray(5.0)))
    assert paid == pytest.approx(-1.6 * to_come / CONFIG.episode.steps, rel=1e-4)


def test_a_critic_learns_which_worlds_crash():
    """Half of the worlds, told by one feature, crash in the second step, and none counts after."""
    batch, rng = 64, np.random.default_rng(0)
    doomed = rng.random(batch) < 0.5
    seen = np.zeros((6, batch, critic.FEATURES))
    seen[..., 0] = doomed
    alive = 1.0 - ((np.arange(6)[:, None] > 1) & doomed)
    hit = (np.arange(5)[:, None] == 1) & doomed
    still = np.zeros_like(hit)
    way = value.Way(*map(jnp.asarray, (seen, np.full((5, batch), 4.0), alive, hit, still)))
    held, teach = value.start_critic(CONFIG), jax.jit(value.make_teach(CONFIG))
    for _ in range(60):
        held, _ = teach(held, way)
    says = critic.value(held.params, way.seen[0])
    assert float(says[~doomed].mean()) == pytest.approx(4.0, abs=0.4)
    assert float(says[doomed].mean()) < 1.0
    assert float(teach(held, way)[1]["value_explained"]) > 0.9


@pytest.fixture(scope="module")
def judged():
    """Return (worlds, params, a critic that is far from zero)."""
    params = value.start_critic(CONFIG).params
    params["weight2"] *= 100.0
    return boxes_worlds(CONFIG), fresh_params(lively=3.0), params


def test_the_gradient_with_a_critic_is_that_of_the_plain_loop_and_its_last_value(judged):
    worlds, params, judge = judged
    gradient, loss, records = gradient_of(params, worlds, KEY, None, judge)
    still = jnp.zeros((CONFIG.episode.steps, 4, SPEC.hidden_size))

    def plain(params):
        flown, _, last = make_rollout(CONFIG)(params, still, worlds, KEY, network.encode)
        rest = critic.value(judge, critic.features(worlds, last.state, last.target))
        return flown + (last.alive * value.to_come(CONFIG, rest)).mean()

    expected_loss, expected = jax.jit(jax.value_and_grad(plain))(params)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)
    assert largest_difference(gradient, expected) < 1e-3
    without = gradient_of(params, worlds, KEY, None)[0]
    assert largest_difference(without, expected) > 0.05
    total = sum(float(term.mean()) for term in records.terms.values())
    assert total == pytest.approx(float(loss), rel=1e-5)


def test_a_world_that_was_stopped_or_has_crashed_has_nothing_to_come(judged):
    worlds, params, judge = judged
    # The second begins inside a bar of its first gate's frame.
    pos_w = np.array(worlds.pos_w)
    pos_w[1] = worlds.scene.boxes.center_w[1, 0]
    worlds = worlds._replace(stop=np.array([6, 6, 2, 6]), pos_w=pos_w)
    records = gradient_of(params, worlds, KEY, None, judge)[2]
    paid, way = np.asarray(records.terms["value"][0]), records.noted
    assert list(paid != 0) == [True, False, False, True]
    assert way.seen.shape == (7, 4, critic.FEATURES) and way.alive.shape == (7, 4)
    assert list(way.hit[0]) == [False, True, False, False] and way.hit.sum() == 1
    assert list(way.alive.sum(0)) == [7, 1, 2, 7]
    # To reach the rollout's end is not to be stopped: what leaves there passed its last gate.
    assert [list(np.flatnonzero(row)) for row in way.stopped.T] == [[], [], [1], []]
