"""PPO: objective and advantages, rollouts, runs that resume exactly, the race as gymnax has it."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.envs.races import RaceConfig, Races
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import network
from suite.common import curve
from suite.common.console import Console
from suite.train.config import QuadrotorConfig
from suite.train.ppo import update as run
from suite.train.ppo.config import PpoConfig, ppo_like
from suite.train.ppo.environment import JaxRace
from suite.train.ppo.objective import Actor, Sequences, action_means, advantages, clipped_loss
from suite.train.ppo.reward import COLLISION
from suite.train.ppo.rollout import Record, log_probability, make_rollout
from suite.train.rollout import world_keys
from tests.support.training import (
    SPEC,
    assert_same_run,
    boxes_only,
    boxes_worlds,
    doubled,
    fresh_params,
    small_config,
)

pytestmark = pytest.mark.extended
"""PPO is a method that ours is compared with."""

STEPS, BATCH = 5, 3
PLAIN = PpoConfig(spec=SPEC, entropy=0.0)


def test_advantages_are_those_of_a_plain_loop(float64):
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
    records = Record(**dict.fromkeys(Record._fields))._replace(
        state=jnp.asarray(rng.normal(size=(STEPS, BATCH, SPEC.state_size))), done=jnp.asarray(ends)
    )
    sequences = Sequences(
        records,
        advantage=jnp.asarray(rng.normal(size=(STEPS, BATCH))),
        start=jnp.asarray(rng.normal(size=(1, BATCH, SPEC.hidden_size))),
    )
    mean = means(actor.params, embeddings, sequences)
    action = mean + jnp.exp(actor.log_deviation) * rng.normal(size=mean.shape)
    log_prob = density(mean, actor.log_deviation, action)
    flown = records._replace(action_b=action, log_prob=log_prob)
    return embeddings, sequences._replace(records=flown)


means, density, recur = map(jax.jit, (action_means, log_probability, network.recur))
loss_and_slope = jax.jit(
    jax.value_and_grad(clipped_loss, argnums=1, has_aux=True), static_argnums=0
)


def actor_of(seed=0):
    return doubled(Actor(fresh_params(seed=seed), jnp.log(jnp.asarray([0.5, 1.0, 2.0]))))


def test_where_nothing_has_changed_its_gradient_is_the_policy_gradient(float64):
    """Central differences of -mean(log density x advantage) along random directions."""
    actor = actor_of()
    embeddings, sequences = rollout_of(actor, done=True)

    @jax.jit
    def surrogate(actor):
        mean = action_means(actor.params, embeddings, sequences)
        logs = log_probability(mean, actor.log_deviation, sequences.records.action_b)
        return -(logs * sequences.advantage).mean()

    (_, numbers), gradient = loss_and_slope(PLAIN, actor, embeddings, sequences)
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
def test_a_change_beyond_the_clip_is_not_rewarded(ratio, advantage, gain, learns, float64):
    actor = actor_of()
    embeddings, sequences = rollout_of(actor)
    records = sequences.records
    sequences = sequences._replace(
        records=records._replace(log_prob=records.log_prob - np.log(ratio)),
        advantage=np.full((STEPS, BATCH), advantage),
    )
    config = replace(PLAIN, clip=0.2)
    (loss, numbers), gradient = loss_and_slope(config, actor, embeddings, sequences)
    assert float(loss) == pytest.approx(-gain) and float(numbers["clipped"]) == 1
    assert bool(np.any(gradient.params["action.weight"])) == learns


def test_an_episode_that_ended_leaves_no_memory(float64):
    """The world starts anew with its start's recurrent state, and its past has no gradient."""
    actor = actor_of()
    embeddings, sequences = rollout_of(actor, done=True)
    mean = means(actor.params, embeddings, sequences)
    hidden, again = sequences.start[0], []
    for step in (3, 4):
        action, hidden = recur(
            actor.params, hidden, embeddings[step], sequences.records.state[step]
        )
        again.append(action)
    np.testing.assert_allclose(mean[3:, 1], jnp.stack(again)[:, 1], rtol=1e-12)
    assert not np.allclose(mean[3:, 0], jnp.stack(again)[:, 0])


def test_entropy_widens_the_exploration(float64):
    actor = actor_of()
    embeddings, sequences = rollout_of(actor)
    sequences = sequences._replace(advantage=jnp.zeros((STEPS, BATCH)))
    _, gradient = loss_and_slope(replace(PLAIN, entropy=0.3), actor, embeddings, sequences)
    np.testing.assert_allclose(gradient.log_deviation, -0.3 * np.ones(3), rtol=1e-12)


DELAYS = {"image_delay": 2, "state_delay": 1, "depth_noise": 0.02}
CONFIG = replace(
    ppo_like(small_config(4, 6, physics=DELAYS, image_stride=2), iterations=3),
    epochs=2, minibatches=2, critic_epochs=2, critic_size=8,
)  # fmt: skip


make_update = cache(run.make_update)


@pytest.fixture(autouse=True)
def _small_scenes(monkeypatch):
    monkeypatch.setattr(run, "sample_worlds", boxes_worlds)
    monkeypatch.setattr(run, "make_update", make_update)


@pytest.mark.slow
def test_a_stopped_run_resumes_exactly_and_leaves_a_policy(tmp_path, monkeypatch):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert run.train_ppo(CONFIG, whole, Console()).iterations == 3
    assert [row["iteration"] for row in curve.read(whole)] == [0, 1, 2]
    policy = load_policy_checkpoint(whole / "policy")
    assert policy.spec == SPEC
    fresh = run.start_state(CONFIG).params
    assert all(np.any(policy.params[name] != np.array(value)) for name, value in fresh.items())

    def worlds(config, iteration):
        if iteration == 1:
            raise KeyboardInterrupt
        return boxes_worlds(config, iteration)

    monkeypatch.setattr(run, "sample_worlds", worlds)
    with pytest.raises(KeyboardInterrupt):
        run.train_ppo(CONFIG, stopped, Console())
    assert [row["iteration"] for row in curve.read(stopped)] == [0]
    monkeypatch.setattr(run, "sample_worlds", boxes_worlds)
    run.train_ppo(CONFIG, stopped, Console())
    assert_same_run(stopped, whole)
    with pytest.raises(ValueError, match="holds another run.*discount"):
        run.train_ppo(replace(CONFIG, discount=0.5), whole, Console())


def test_invalid_settings_are_refused_before_anything_is_written(tmp_path):
    stride = replace(CONFIG, episode=replace(CONFIG.episode, image_stride=4))
    for config, words in (
        (replace(CONFIG, minibatches=3), r"minibatches is 3, allowed are divisors .*\(4\)"),
        (replace(CONFIG, minibatches=0), "minibatches is 0, allowed is 1 to 10000"),
        (replace(CONFIG, discount=1.5), "discount is 1.5, allowed is 0 to 1"),
        (stride, r"image_stride is 4, allowed are divisors .*\(6\)"),
    ):
        with pytest.raises(ValueError, match=words):
            run.train_ppo(config, tmp_path / "run", Console())
        assert not list(tmp_path.iterdir())


def test_the_density_is_a_normal_one():
    mean, action = jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([1.5, 2.0, 1.0])
    deviation = np.array([0.5, 1.0, 2.0])
    density = np.exp(-0.5 * np.array([1.0, 0.0, -1.0]) ** 2) / (deviation * np.sqrt(2 * np.pi))
    found = log_probability(mean, jnp.log(deviation), action)
    assert float(found) == pytest.approx(np.log(density.prod()))


roll = jax.jit(make_rollout(CONFIG.shared))


def crashing(worlds):
    """Return the worlds with the first one just above the ground and sinking."""
    pos, vel = np.array(worlds.pos_w), np.array(worlds.vel_w)
    pos[0], vel[0] = [100.0, 0.0, 0.5], [0.0, 0.0, -4.0]
    return worlds._replace(pos_w=pos, vel_w=vel)


def flown(worlds):
    actor = Actor(fresh_params(), jnp.full(3, -1.0))
    records, _ = roll(actor.params, actor.log_deviation, worlds, jax.random.key(2))
    return actor, records


def means_of(actor, records, hidden):
    """Return the policy's actions (T, B, 3) without exploration on what a rollout observed."""
    embeddings = jax.jit(network.encode)(actor.params, records.image.reshape(-1, 20, 20))
    sequences = Sequences(records, records.log_prob, jnp.asarray(hidden)[None])
    return means(actor.params, embeddings.reshape(6, 4, -1), sequences)


def test_exploration_is_not_the_image_noise_of_a_world():
    """A policy that sees the noise of its own action could learn to correct it."""
    worlds = boxes_worlds(CONFIG.shared)
    actor, records = flown(worlds)
    noise = (records.action_b - means_of(actor, records, worlds.hidden)) * np.exp(1.0)
    for key, explored in zip(jax.random.split(jax.random.key(2), 6), noise, strict=True):
        grains = jax.vmap(lambda k: jax.random.normal(k, (20, 20)))(world_keys(key, worlds))
        pixels = np.asarray(grains).reshape(4, -1)[:, : explored.size]
        assert (np.abs(pixels - explored.ravel()).max(1) > 0.1).all()


def test_the_learner_meets_the_actions_density_that_the_rollout_recorded():
    """Through delays, collisions and recurrent states of the start: a ratio of one everywhere."""
    worlds = crashing(boxes_worlds(CONFIG.shared))
    hidden = np.random.default_rng(0).normal(size=worlds.hidden.shape).astype(np.float32)
    actor, records = flown(worlds._replace(hidden=hidden))
    assert bool(records.done[:, 0].any()) and not bool(records.done[-1, 0])
    mean = means_of(actor, records, hidden)
    found = log_probability(mean, actor.log_deviation, records.action_b)
    np.testing.assert_allclose(found, records.log_prob, atol=1e-3)


def test_a_world_that_crashed_starts_again_as_it_started():
    _, records = flown(crashing(boxes_worlds(CONFIG.shared)))
    again, seen = int(np.argmax(records.done[:, 0])) + 1, records.critic_inputs
    np.testing.assert_allclose(seen[again, 0], seen[0, 0], atol=1e-6)
    np.testing.assert_array_equal(records.state[again, 0], records.state[0, 0])
    assert not np.allclose(seen[again, 1], seen[0, 1])


QUAD = QuadrotorConfig(load_vehicle("racer5"), attitude_hz=30.0, physics_hz=30.0)
ENV = JaxRace(replace(small_config(), quadrotor=QUAD), time_limit_s=0.1)
KEYS = jax.random.split(jax.random.key(1), 3)
reset = jax.jit(jax.vmap(ENV.reset, (0, None)))
step = jax.jit(jax.vmap(ENV.step, (0, 0, 0, None)))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ENV.worlds(0), "count is 0, allowed is 1 to"),
        (lambda: ENV.worlds(2, seed=-1), "seed is -1, allowed is 0 to"),
        (lambda: replace(ENV, time_limit_s=-1), "time_limit_s is -1, allowed is above 0"),
        (
            lambda: replace(ENV, reward_scale=float("nan")),
            "reward_scale is nan, allowed is above 0",
        ),
        (lambda: JaxRace("race"), "config is 'race', allowed is a TrainConfig"),  # type: ignore[arg-type]
        (lambda: QuadrotorConfig("racer5"), "vehicle is 'racer5', allowed is a Vehicle"),  # type: ignore[arg-type]
    ],
)
def test_a_race_that_cannot_be_made_is_refused_with_what_is_allowed(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.fixture(scope="module")
def worlds():
    drawn = ENV.worlds(4, seed=3)
    return drawn._replace(scene=boxes_only(drawn.scene))


def test_mapped_it_flies_what_the_batch_of_the_trainers_ppo_flies(worlds):
    seen, state = reset(KEYS, worlds)
    assert seen.state.shape == (3, 12) and seen.image.shape == (3, 20, 20)
    action = np.array([[0.1, 0.2, -0.1], [0.5, 0.0, 0.3], [-3.0, 0.0, 0.0]], np.float32)
    _, after, reward, done, info = step(KEYS, state, action, worlds)
    assert not done.any() and not info["truncated"].any()
    race = ENV._race

    @jax.jit
    def fly(worlds, wanted):
        own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[state.world], worlds)
        return race.fly(own, race.start(own), wanted, world_keys(KEYS[0], own))

    flown = fly(worlds, 20.0 * np.clip(action, -1, 1))
    before_w, after_w = state.episode.state.vel_w, after.episode.state.vel_w
    np.testing.assert_allclose(after_w[:, 0], flown[0].state.vel_w, rtol=1e-4, atol=1e-4)
    assert np.abs(after_w - before_w).max() > 0.1
    np.testing.assert_allclose(reward, 0.01 * flown[1].reward.total(), rtol=1e-3, atol=1e-4)


def test_an_episode_that_ends_starts_another_and_says_why(worlds):
    """One world sinks into the ground, one is upside down, one meets the time limit (3 steps)."""
    _, state = reset(KEYS, worlds)
    body = jax.tree.map(np.array, state.episode.state)
    body.pos_w[0, 0], body.vel_w[0, 0] = [100.0, 0.0, 0.2], [0.0, 0.0, -8.0]
    body.pos_w[1:, 0], body.vel_w[1:, 0] = [200.0, 0.0, 50.0], [0.0, 0.0, 0.0]
    body.rot_w[1, 0] = np.diag([1.0, -1.0, -1.0])
    state = state._replace(episode=state.episode._replace(state=body))
    hold, ended = jnp.zeros((3, 3)), []
    for _ in range(3):
        _, state, reward, done, info = step(KEYS, state, hold, worlds)
        ended.append({name: np.asarray(info[name]) for name in ("collided", "tipped", "truncated")})
        assert np.array_equal(done, info["collided"] | info["tipped"] | info["truncated"])
        assert (np.asarray(state.steps) == 0)[np.asarray(done)].all()
        if len(ended) == 1:
            assert (reward[:2] < -0.25).all() and np.abs(state.episode.state.pos_w[0]).max() < 90
    assert ended[0]["collided"][0] and ended[0]["tipped"][1] and not ended[0]["truncated"].any()
    assert ended[2]["truncated"][2]


def test_an_accelerator_rounds_no_product_of_its_rotations(worlds):
    state = jax.eval_shape(reset, KEYS, worlds)[1]
    program = step.lower(KEYS, state, jnp.zeros((3, 3)), worlds).as_text()
    assert "precision = [HIGHEST" in program and "precision = [DEFAULT" not in program


def test_an_action_of_another_shape_is_refused_and_one_that_is_not_finite_ends(worlds):
    _, state = reset(KEYS, worlds)
    action = jnp.zeros((3, 3)).at[1, 2].set(jnp.nan)
    observation, _, reward, done, info = step(KEYS, state, action, worlds)
    assert done.tolist() == info["bad_action"].tolist() == [False, True, False]
    assert np.isfinite(observation.state).all()
    assert float(reward[1]) == pytest.approx(
        float(reward[0]) + ENV.reward_scale * COLLISION, abs=0.05
    )
    one = jax.tree.map(lambda leaf: leaf[0], state)
    for shape in ((1,), (), (4,)):
        with pytest.raises(ValueError, match=r"allowed is \(3,\)"):
            ENV.step(KEYS[0], one, jnp.zeros(shape), worlds)


def test_its_contract_is_that_of_the_judges_environments():
    assert ENV.contract == Races(RaceConfig(spec=ENV.config.spec), 1).contract


def test_it_is_refused_with_the_numbers_of_64_bits_that_a_program_may_choose(worlds):
    with jax.enable_x64(True), pytest.raises(ValueError, match="turn JAX's jax_enable_x64 off"):
        replace(ENV).reset(KEYS[0], worlds)
