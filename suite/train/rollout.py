"""Roll out the policy through differentiable dynamics, and compute the loss of every step.

A rollout is a flight of B worlds (a world is one simulated scene and drone) over T policy periods.
The policy's image encoder turns an image into a vector, its embedding. Images have no gradient with
respect to the state (Zhang et al. 2025). So the encoder is outside the differentiated loop: an
embedding enters as a constant plus `embedding_shift`, which is zero. The gradient with respect to
the shift is that with respect to the embedding (see `gradient.py`). Obstacles, gates and their
attractive field are evaluated without gradient as well.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from itertools import pairwise
from math import ceil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from eval import sensors
from eval.sensors import SENSORS, scale_model, view_models
from eval.sensors.interface import keyed_draws, product, rotation_since
from policies.networks import delta_network, network
from policies.observation import Observation, View, observe
from policies.spec import PolicySpec
from suite.train import losses
from suite.train.config import SensorsConfig, TrainConfig
from suite.train.dynamics.interface import DynamicsState, make_dynamics
from suite.train.step import make_step, target_gate
from suite.train.worlds import Sensed, Worlds
from tracks.common.masks import select
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import exp_rot, to_local
from tracks.geometry.scene import Counts

SEEN = Counts(boxes=24, cylinders=8, capsules=5, spheres=5)
"""Number of solids of each kind in an image of the training, the nearest ones. Images of the judge,
which scores policies in MuJoCo, have all solids."""


class Episode(NamedTuple):
    """The flights of the B worlds between steps; those of PPO have the same."""

    state: Any
    """State of the dynamics."""
    target: jax.Array
    """(B,) number of passed gates, counted from the track's first one; the next gate's index."""
    action_b: jax.Array
    """(B, 3) the policy's last action, without the correction of a Delta Action network [m/s^2]."""
    waiting: jax.Array
    """(B, image_delay, ...) images or their embeddings that wait for their delay, oldest first. At
    the start they are zero: an image of zeros is embedded as zeros."""
    observed: jax.Array
    """(B, state_delay, state_size) state vectors that wait for their delay, oldest first. At the
    start all are the state vector of the start."""
    sensed: Any
    """Memory of the sensor models; () without models."""


class RolloutCarry(NamedTuple):
    """The episodes of the B worlds, and what a training needs besides."""

    episode: Episode
    hidden: jax.Array
    """(B, hidden) recurrent state of the policy."""
    delta_hidden: jax.Array
    """(B, 32) recurrent state of the Delta Action network."""
    alive: jax.Array
    """(B,) 1 while the world counts in the loss: until it crashes, stops or finishes, then 0."""


class StepRecord(NamedTuple):
    """Records of a step, (B, ...) each."""

    image: jax.Array
    """(B, height, width) the image that was encoded, with its noise."""
    terms: dict[str, jax.Array]
    """Weighted losses by name; zero for worlds that no longer count in the loss."""
    speed: jax.Array
    """Speed at the step's end [m/s]."""
    clearance: jax.Array
    """Smallest signed distance on the step's path [m]."""
    passed: jax.Array
    """Bool: a gate was crossed in this step."""
    hidden: jax.Array
    """(B, hidden) the policy's recurrent state after the step."""
    alive: jax.Array
    """1 where the step counted in the loss, else 0."""
    noted: Any = None
    """What the optional function for additional records (`Note`) returned; None without one."""


Note = Callable[[Worlds, DynamicsState, DynamicsState, jax.Array], Any]
"""note(worlds, before, after, target) -> additional arrays (B, ...) to record of a step. `before`
and `after` are the states, `target` is the number of gates passed before the step."""


def view_in(worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
    """Return the observation, without image, of drones that have passed `target` (B,) gates."""
    gates = worlds.scene.gates
    gate, target_w = target_gate(gates, target)
    second_gate, second_w = target_gate(gates, target, ahead=1)
    axes_w = gate.rot_w[:, :, 0], second_gate.rot_w[:, :, 0]
    return View(
        state.pos_w, state.rot_w, state.vel_w, target_w, second_w, *axes_w, gate_number=target
    )


def queue(waiting: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Add `new` to a queue (B, N, ...) of delayed arrays.

    Return its oldest entry, and the queue without that entry and with `new` at its end. If N is 0,
    there is no delay, and `new` itself is returned.
    """
    entries = jnp.concatenate([waiting, new[:, None]], axis=1)
    return entries[:, 0], entries[:, 1:]


def world_keys(key: jax.Array, worlds: Worlds) -> jax.Array:
    """Return a random key for each world, (B,), from `key` and the world's number in the batch."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, worlds.number)


class SensorModels:
    """The sensor models of a training, with each world's magnitudes and draws.

    The functions are those of the judge. The trainer has states only at decisions. If a delay ends
    between two decisions, the state is interpolated, and the image is one of the two neighbouring
    ones, at random. In this file a view has all from which the policy's observation is computed:
    pose, velocity, gates and depth image (`policies.observation.View`).
    """

    def __init__(self, config: SensorsConfig, spec: PolicySpec) -> None:
        self._models, self._camera, self._dt_s = config.seen.models, spec.camera, 1.0 / spec.rate_hz
        self._view_models = view_models(self._models)
        # Number of stored views: the largest possible age in policy periods.
        self._periods = 0
        if "delay" in self._models:
            delay = scale_model("delay", self._models["delay"], config.magnitude[1])
            longest_s = (1 + delay.jitter) * max(delay.state, delay.image)
            self._periods = ceil(longest_s / self._dt_s)

    def start(self, worlds: Worlds, truth: View) -> Any:
        """Return the memory of the models at the start: past views, and states of the models."""
        models, sensed = self._current_models(worlds)
        states = sensors.start(models, truth, sensed.trial, self._dt_s, self._camera)
        return (truth,) * self._periods, states

    def measure(
        self, worlds: Worlds, truth: View, keys: jax.Array, memory: Any
    ) -> tuple[View, Any]:
        """Return the view with errors and the new memory; `keys` (B,) are random keys."""
        (past_views, states), (models, sensed) = memory, self._current_models(worlds)
        # Random numbers of each model.
        draws, views = {}, (truth, *past_views)
        for number, name in enumerate(models):
            model_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, number + 1)
            needs = SENSORS[name].observation
            draws[name] = jax.vmap(lambda key, n=needs: keyed_draws(n, key, self._camera))(
                model_keys
            )
        # The delayed view, with a random variation of the delay (jitter); then the other errors.
        delayed = truth
        if past_views:
            delay = scale_model("delay", self._models["delay"], sensed.magnitude["delay"])
            delay_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
            uniform = jax.vmap(lambda key: jax.random.uniform(key, (3,)))(delay_keys)
            jitter = 1.0 + delay.jitter * (2.0 * uniform[:, :2] - 1.0)
            ages = jnp.stack([delay.state, delay.image], -1) * jitter / self._dt_s
            # Random rounding: the probability to round up is the fraction.
            delayed = delayed_view(views, ages[:, 0], jnp.floor(ages[:, 1] + uniform[:, 2]))
        view, states = sensors.sense(models, states, delayed, draws, self._dt_s, self._camera)
        image = jax.lax.stop_gradient(view.depth_m)
        memory = views[: self._periods], jax.lax.stop_gradient(states)
        return view._replace(depth_m=image), memory

    def _current_models(self, worlds: Worlds) -> tuple[dict[str, Any], Sensed]:
        """Return the models at the magnitudes of the worlds, and the worlds' draws."""
        assert worlds.sensed is not None
        models = sensors.scale_models(self._view_models, worlds.sensed.magnitude)
        return models, worlds.sensed


def delayed_view(views: tuple[View, ...], age: jax.Array, image_age: jax.Array) -> View:
    """Return the view at an earlier time, which may be between two decisions.

    Pose and velocity are interpolated. The gates are those of the nearer decision.

    Args:
        views: views at this decision, at the one before, and so on.
        age: (B,) age of the state [policy periods].
        image_age: (B,) age of the image, whole numbers [policy periods].
    """
    view = views[0]
    for number, (later, earlier) in enumerate(pairwise(views)):
        fraction = age - number
        weight, turn_b = fraction[:, None], rotation_since(earlier.rot_w, later.rot_w)
        between = select(fraction > 0.5, earlier, later)._replace(
            pos_w=later.pos_w + weight * (earlier.pos_w - later.pos_w),
            vel_w=later.vel_w + weight * (earlier.vel_w - later.vel_w),
            rot_w=product(later.rot_w, exp_rot(weight * turn_b)),
            depth_m=view.depth_m,
        )
        view = select(fraction > 0.0, between, view)
        view = view._replace(depth_m=select(image_age > number, earlier.depth_m, view.depth_m))
    return view


class Observer:
    """The observation of policies in training, with image noise and sensor errors.

    Its methods are pure functions over B worlds. Images have no gradient.
    """

    def __init__(self, config: TrainConfig) -> None:
        self._spec, self._physics = config.spec, config.physics
        # One ray a pixel, also for a supersampling camera: more rays cost time and had no benefit.
        self._rays = jnp.asarray(pixel_rays_b(config.spec.camera), jnp.float32)
        self._models = SensorModels(config.sensors, config.spec) if config.sensors else None

    def _true_view(self, worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
        # Scaling the rays across the optical axis changes the field of view. All worlds of an
        # iteration share the scale, so that the rays are one array.
        camera, axis = self._spec.camera, self._rays.mean(0)
        scaled_rays = axis + (self._rays - axis) * worlds.fov_scale[0]
        pos_w, rot_w = jax.lax.stop_gradient((state.pos_w, state.rot_w))
        depth_m = depth_image(worlds.scene, pos_w, rot_w, scaled_rays, camera.range_m, SEEN)
        image_m = depth_m.reshape(-1, camera.height, camera.width)
        return view_in(worlds, state, target)._replace(depth_m=image_m)

    def start(self, worlds: Worlds, state: DynamicsState, shape: tuple[int, ...]) -> Episode:
        """Return the episodes at their start; `shape` is that of an entry of `Episode.waiting`."""
        target, no_action, sensed = jnp.asarray(worlds.target), jnp.zeros_like(state.pos_w), ()
        view = view_in(worlds, state, target)
        observed = observe(self._spec, view, no_action, worlds.speed_command).state
        if self._models:
            sensed = self._models.start(worlds, self._true_view(worlds, state, target))
        return Episode(
            state=state,
            target=target,
            action_b=no_action,
            waiting=jnp.zeros((len(target), self._physics.image_delay, *shape)),
            observed=jnp.repeat(observed[:, None], self._physics.state_delay, axis=1),
            sensed=sensed,
        )

    def observe(
        self, worlds: Worlds, episode: Episode, keys: jax.Array
    ) -> tuple[Observation, Episode]:
        """Return the delayed state vector with the newest image, and the new episodes.

        `keys` (B,) are random keys of the noise.
        """
        view, sensed = self._true_view(worlds, episode.state, episode.target), episode.sensed
        if self._models:
            view, sensed = self._models.measure(worlds, view, keys, sensed)
        newest = observe(self._spec, view, episode.action_b, worlds.speed_command)
        grain = jax.vmap(lambda key: jax.random.normal(key, view.depth_m.shape[1:]))(keys)
        state, observed = queue(episode.observed, newest.state)
        image = newest.image + self._physics.depth_noise * grain
        return Observation(state, image), episode._replace(observed=observed, sensed=sensed)


def make_rollout(
    config: TrainConfig, note: Note | None = None
) -> Callable[..., tuple[jax.Array, StepRecord]]:
    """Return rollout(params, embedding_shift, worlds, key, encode, delta) -> (loss, records).

    `encode(params, image)` gives the embeddings; `embedding_shift` (T, B, hidden) is zero. `delta`
    are the parameters of a Delta Action network, which corrects the actions so that simulated
    flights match measured ones, or None. The loss is the mean over steps and worlds. The records
    have arrays (T, B, ...), without gradient; `note` adds some.
    """
    weights, width = config.loss, config.spec.hidden_size
    observer, dynamics = Observer(config), make_dynamics(config)

    def start(worlds: Worlds) -> RolloutCarry:
        batch = len(worlds.target)
        state = dynamics.start(worlds.constants, worlds.pos_w, worlds.vel_w, worlds.heading_w)
        return RolloutCarry(
            episode=observer.start(worlds, state, (width,)),
            hidden=jnp.asarray(worlds.hidden),
            delta_hidden=delta_network.start(batch),
            alive=jnp.ones(batch),
        )

    def rollout(
        params: network.Params,
        embedding_shift: jax.Array,
        worlds: Worlds,
        key: jax.Array,
        encode: Callable[[network.Params, jax.Array], jax.Array],
        delta: delta_network.Params | None = None,
    ) -> tuple[jax.Array, StepRecord]:
        steps = len(embedding_shift)

        def step(
            carry: RolloutCarry, inputs: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[RolloutCarry, StepRecord]:
            shift_now, key_now, number = inputs
            before, target = carry.episode.state, carry.episode.target
            keys = world_keys(key_now, worlds)
            # What the policy observes, with delays, and its action.
            observation, episode = observer.observe(worlds, carry.episode, keys)
            embedding = encode(params, observation.image) + shift_now
            embedding, waiting = queue(episode.waiting, embedding)
            action, hidden = network.recur(params, carry.hidden, embedding, observation.state)
            # The corrected action, the motion and its loss.
            corrected, delta_hidden = action, carry.delta_hidden
            if delta is not None:
                vel_b = to_local(before.rot_w, before.vel_w)
                correction, delta_hidden = delta_network.step(
                    delta, delta_hidden, vel_b, before.rot_w[:, 2], action
                )
                corrected = action + correction
            _, target_w = target_gate(worlds.scene.gates, target)
            after = dynamics.step(before, worlds.constants, corrected, target_w, keys)
            motion = make_step(weights, worlds, before, after, target)
            terms = losses.weighted(weights, motion)
            # Whether the world counts in the loss of the next step.
            target_after = target + motion.passed
            goes_on = number + 1 < worlds.stop
            if config.episode.finish:
                goes_on = goes_on & (target_after < worlds.scene.gates.center_w.shape[1])
            intact = motion.clearance > -weights.crash_depth_m
            if weights.tilt > 0.0:
                intact = intact & (motion.up > 0.0)  # a tilt below 90 degrees
            record = StepRecord(
                image=observation.image,
                terms={name: term * carry.alive for name, term in terms.items()},
                speed=jnp.linalg.norm(after.vel_w, axis=-1),
                clearance=motion.clearance,
                passed=motion.passed,
                hidden=hidden,
                alive=carry.alive,
                noted=None if note is None else note(worlds, before, after, target),
            )
            episode = episode._replace(
                state=after, target=target_after, action_b=action, waiting=waiting
            )
            alive = carry.alive * intact * goes_on
            return RolloutCarry(episode, hidden, delta_hidden, alive), record

        keys = jax.random.split(key, steps)
        inputs = embedding_shift, keys, jnp.arange(steps)
        _, records = jax.lax.scan(step, start(worlds), inputs)
        loss = functools.reduce(jnp.add, (records.terms[name].mean() for name in losses.LOSSES))
        return loss, jax.lax.stop_gradient(records)

    return rollout
