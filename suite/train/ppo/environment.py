"""The race as a reinforcement-learning environment of pure functions, in the trainer's dynamics.

`make_race` steps B worlds at once (a world is one simulated scene and drone), for the trainer's
PPO. `JaxRace` is one world with the interface of gymnax (Lange 2022), for other learners. Both run
the same code.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from policies.contract import Contract, contract_of
from policies.observation import Observation
from policies.spec import ActionSpec, PolicySpec
from suite.train.config import TrainConfig
from suite.train.dynamics.interface import make_dynamics
from suite.train.ppo.reward import COLLISION, RewardTerms, make_reward
from suite.train.rollout import Episode, Observer, queue, world_keys
from suite.train.step import BODY_RADIUS_M, target_gate
from suite.train.worlds import Worlds, sample_worlds
from tracks.common.masks import select
from tracks.input.ranges import (
    SEED_MOST,
    Range,
    TimeLimit,
    check_number,
    check_ranges,
    check_type,
)

ACTION_LIMIT = 20.0
"""Acceleration that an action of 1 means in `JaxRace`, as in `eval.envs` [m/s^2]."""


class PeriodResult(NamedTuple):
    """Results of a policy period, (B,) each."""

    reward: RewardTerms
    """Terms of the reward."""
    collided: jax.Array
    """Bool: the drone touched a solid."""
    passed: jax.Array
    """Bool: a gate was passed."""


class Race(NamedTuple):
    """The environment: pure functions over B worlds; `keys` (B,) are random keys of their noise."""

    start: Callable[[Worlds], Episode]
    """(worlds) -> the episodes at their start."""
    observe: Callable[[Worlds, Episode, jax.Array], tuple[Observation, Episode]]
    """(worlds, episodes, keys) -> (observation, new episodes); called once before each step."""
    fly: Callable[[Worlds, Episode, jax.Array, jax.Array], tuple[Episode, PeriodResult]]
    """(worlds, episodes, action_b (B, 3) [m/s^2], keys) -> (episodes a policy period
    later, results)."""


def make_race(config: TrainConfig) -> Race:
    """Return the race that `config` describes: its observation, dynamics, noise and delays."""
    camera = config.spec.camera
    observer, reward, dynamics = Observer(config), make_reward(config), make_dynamics(config)

    def start(worlds: Worlds) -> Episode:
        state = dynamics.start(worlds.constants, worlds.pos_w, worlds.vel_w, worlds.heading_w)
        return observer.start(worlds, state, (camera.height, camera.width))

    def observe(worlds: Worlds, episode: Episode, keys: jax.Array) -> tuple[Observation, Episode]:
        newest, episode = observer.observe(worlds, episode, keys)
        image, waiting = queue(episode.waiting, newest.image)
        return newest._replace(image=image), episode._replace(waiting=waiting)

    def fly(
        worlds: Worlds, episode: Episode, action_b: jax.Array, keys: jax.Array
    ) -> tuple[Episode, PeriodResult]:
        before, target = episode.state, episode.target
        _, target_w = target_gate(worlds.scene.gates, target)
        after = dynamics.step(before, worlds.constants, action_b, target_w, keys)
        terms, clearance, passed = reward(worlds, before, after, target)
        episode = episode._replace(state=after, target=target + passed, action_b=action_b)
        return episode, PeriodResult(terms, clearance < BODY_RADIUS_M, passed)

    return Race(*map(_unrounded, (start, observe, fly)))


def _unrounded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with full float32 products, as in the trainer (see `suite.train.shards`).

    Commands set this for their process, but another learner's program does not.
    """

    def call(*args: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            return function(*args)

    return call


class RaceState(NamedTuple):
    """State of a `JaxRace`."""

    world: jax.Array
    """Index of the world in the pool."""
    episode: Episode
    """State of the episode, as a batch of one."""
    steps: jax.Array
    """Number of policy periods since the start."""


@dataclass(frozen=True)
class JaxRace:
    """One race with the interface of gymnax: pure functions, which the learner compiles and maps.

        env = JaxRace(TrainConfig(quadrotor=QuadrotorConfig(load_vehicle("racer5"))))
        worlds = env.worlds(256)
        observation, state = jax.vmap(env.reset, (0, None))(keys, worlds)
        observation, state, reward, done, info = jax.vmap(env.step, (0, 0, 0, None))(
            keys, state, action, worlds
        )

    Tracks are drawn beforehand, as a pool of worlds (gymnax's `params`); `reset` selects one of
    them at random. Observations have the delays and the noise of `config`. The components of an
    action are -1 to 1, see `contract`. The motion is differentiable in the action. An episode ends
    at a collision, at a tilt beyond 90 degrees, after the last gate or at the time limit.
    """

    config: TrainConfig
    """Settings of the observation, dynamics, randomisation and tracks; of those of the loss only
    the safety radius r_q is used."""
    time_limit_s: TimeLimit = 20.0
    """Longest episode [s]."""
    reward_scale: Annotated[float, Range(0.0, 1e6, above=True)] = 0.01
    """Factor on the rewards of `suite.train.ppo.reward`."""

    def __post_init__(self) -> None:
        check_type("config", self.config, (TrainConfig,), "a TrainConfig, the settings")
        check_ranges(self)

    @property
    def spec(self) -> PolicySpec:
        """The policy's spec: the observation of `config`, and actions of -1 to 1."""
        action = ActionSpec("acceleration", (ACTION_LIMIT,), (0.0,), clip=1.0)
        return replace(self.config.spec, action=action)

    @property
    def contract(self) -> Contract:
        """The policy's contract: names, units, frames and rate of its inputs and outputs.

        A policy that is trained here carries it in its file.
        """
        return contract_of(self.spec)

    @functools.cached_property
    def _race(self) -> Race:
        if jnp.zeros(()).dtype != jnp.float32:
            raise ValueError("JaxRace computes in float32: turn JAX's jax_enable_x64 off")
        # The first call may be in a function that a learner compiles. Without this line the arrays
        # made here would exist in that compilation only.
        with jax.ensure_compile_time_eval():
            return make_race(self.config)

    def worlds(self, count: int, seed: int = 0) -> Worlds:
        """Return a pool of `count` worlds: tracks, starts and vehicles, drawn by numpy.

        Raises:
            ValueError: for a count or a seed outside its range.
        """
        check_number("count", count, Range(1, 10**6, whole=True))
        check_number("seed", seed, Range(0, SEED_MOST, whole=True))
        episode = replace(self.config.episode, batch=count)
        drawn = sample_worlds(replace(self.config, episode=episode, seed=seed), 0)
        return jax.tree.map(jnp.asarray, drawn)

    def reset(self, key: jax.Array, worlds: Worlds) -> tuple[Observation, RaceState]:
        """Start an episode in a world of the pool; return its first observation and its state."""
        pick, noise = jax.random.split(key)
        index = jax.random.randint(pick, (), 0, worlds.pos_w.shape[0])
        world = _batch_of_one(worlds, index)
        state = RaceState(index, self._race.start(world), jnp.zeros((), int))
        return self._observe(noise, world, state)

    def step(
        self, key: jax.Array, state: RaceState, action: jax.Array, worlds: Worlds
    ) -> tuple[Observation, RaceState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Fly an action (3,) for a policy period; return (observation, state, reward, done, info).

        At an episode's end the next one starts, and the observation is its first one. `info` has
        the `gates` passed, counted from the track's first, and `collided`, `tipped`, `finished`
        and `truncated` (the time limit). An action that is not finite (`bad_action`) ends the
        episode, counts as `collided` and costs as much.

        Raises:
            ValueError: for an action of another shape.
        """
        if jnp.shape(action) != (3,):
            raise ValueError(
                f"the action has the shape {jnp.shape(action)}, allowed is (3,); for many "
                "environments map this function by jax.vmap"
            )
        # Fly one period.
        wind, pick, noise = jax.random.split(key, 3)
        world = _batch_of_one(worlds, state.world)
        bad = ~jnp.isfinite(action).all()
        output = jnp.where(bad, 0.0, jnp.clip(action, -1.0, 1.0))
        keys = world_keys(wind, world)
        episode, result = self._race.fly(world, state.episode, ACTION_LIMIT * output[None], keys)
        # Whether the episode is over, and its reward. A tilt beyond 90 degrees and a bad action
        # cost as much as a collision.
        steps = state.steps + 1
        gates = episode.target[0]
        tipped = episode.state.rot_w[0, 2, 2] < 0.0
        finished = gates >= worlds.scene.gates.center_w.shape[1]
        hit = result.collided[0]
        collided = hit | bad
        over = collided | tipped | finished
        truncated = ~over & (steps >= round(self.time_limit_s * self.config.spec.rate_hz))
        reward = self.reward_scale * (
            result.reward.total()[0] + COLLISION * ((tipped | bad) & ~hit)
        )
        info = {
            "gates": gates, "collided": collided, "tipped": tipped, "finished": finished,
            "truncated": truncated, "bad_action": bad,
        }  # fmt: skip
        # At its end, start the next episode in a random world of the pool.
        done = over | truncated
        index = jax.random.randint(pick, (), 0, worlds.pos_w.shape[0])
        index = jnp.where(done, index, state.world)
        world = _batch_of_one(worlds, index)
        episode = select(done[None], self._race.start(world), episode)
        after = RaceState(index, episode, jnp.where(done, 0, steps))
        observation, after = self._observe(noise, world, after)
        return observation, after, reward, done, info

    def _observe(
        self, key: jax.Array, world: Worlds, state: RaceState
    ) -> tuple[Observation, RaceState]:
        batch, episode = self._race.observe(world, state.episode, world_keys(key, world))
        return Observation(batch.state[0], batch.image[0]), state._replace(episode=episode)


def _batch_of_one(worlds: Worlds, index: jax.Array) -> Worlds:
    """Return a world of the pool as a batch of one."""
    return jax.tree.map(lambda leaf: leaf[index][None], worlds)
