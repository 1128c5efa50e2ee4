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
from suite.train import losses
from suite.train.config import TrainConfig
from suite.train.dynamics.interface import DynamicsState, make_dynamics
from suite.train.step import make_step, target_gate
from suite.train.worlds import Worlds
from tracks.common.masks import select
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import exp_rot, to_local
from tracks.geometry.scene import Counts

SEEN = Counts(boxes=24, cylinders=8, capsules=5, spheres=5)
"""Number of solids of each kind in an image of the training, the nearest ones. Images of the judge,
which scores policies in MuJoCo, have all solids."""


class RolloutCarry(NamedTuple):
    """State of the B worlds between steps."""

    state: Any
    """State of the dynamics."""
    target: jax.Array
    """(B,) number of passed gates, counted from the track's first one; the next gate's index."""
    hidden: jax.Array
    """(B, hidden) recurrent state of the policy."""
    action_b: jax.Array
    """(B, 3) the policy's last action, without the correction of a Delta Action network [m/s^2]."""
    embeddings: jax.Array
    """(B, image_delay, hidden) embeddings of images that wait for their delay, oldest first."""
    observed: jax.Array
    """(B, state_delay, state_size) state vectors that wait for their delay, oldest first."""
    delta_hidden: jax.Array
    """(B, 32) recurrent state of the Delta Action network."""
    alive: jax.Array
    """(B,) 1 while the world counts in the loss: until it crashes, stops or finishes, then 0."""
    sensed: Any
    """Memory of the sensor models."""


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


class SensorModels(NamedTuple):
    """The sensor models of a training, as pure functions over B worlds.

    In this file a view has all from which the policy's observation is computed: pose, velocity,
    gates and depth image (`policies.observation.View`).
    """

    start: Callable[[Worlds, View], Any]
    """(worlds, view at the start) -> memory of the models: past views, and states of the models."""
    measure: Callable[[Worlds, View, jax.Array, Any], tuple[View, Any]]
    """(worlds, true view, keys (B,), memory) -> (view with errors, new memory)."""


def make_sensor_models(config: TrainConfig) -> SensorModels:
    """Return the sensor models of `config.sensors`, with each world's magnitudes and draws.

    The functions are those of the judge. The trainer has states only at decisions. If a delay ends
    between two decisions, the state is interpolated, and the image is one of the two neighbouring
    ones, at random.
    """
    assert config.sensors is not None
    models, spec, dt_s = config.sensors.seen.models, config.spec, 1.0 / config.spec.rate_hz
    seen_models, largest = view_models(models), config.sensors.magnitude[1]
    delays = (scale_model(name, models[name], largest) for name in models if name == "delay")
    # Number of stored views: the largest possible age in policy periods.
    periods = max((ceil((1 + d.jitter) * max(d.state, d.image) / dt_s) for d in delays), default=0)

    def current_models(worlds: Worlds) -> dict[str, Any]:
        assert worlds.sensed is not None
        return sensors.scale_models(seen_models, worlds.sensed.magnitude)

    def start(worlds: Worlds, truth: View) -> Any:
        assert worlds.sensed is not None
        arguments = worlds.sensed.trial, dt_s, spec.camera
        return (truth,) * periods, sensors.start(current_models(worlds), truth, *arguments)

    def measure(worlds: Worlds, truth: View, keys: jax.Array, memory: Any) -> tuple[View, Any]:
        past_views, states = memory
        # Random numbers of each model.
        draws, views = {}, (truth, *past_views)
        for number, name in enumerate(seen_models):
            model_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, number + 1)
            needs = SENSORS[name].observation
            draws[name] = jax.vmap(lambda key, n=needs: keyed_draws(n, key, spec.camera))(
                model_keys
            )
        # The delayed view, with a random variation of the delay (jitter); then the other errors.
        delayed = truth
        if past_views:
            assert worlds.sensed is not None
            delay = scale_model("delay", models["delay"], worlds.sensed.magnitude["delay"])
            delay_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
            uniform = jax.vmap(lambda key: jax.random.uniform(key, (3,)))(delay_keys)
            jitter = 1.0 + delay.jitter * (2.0 * uniform[:, :2] - 1.0)
            ages = jnp.stack([delay.state, delay.image], -1) * jitter / dt_s
            # Random rounding: the probability to round up is the fraction.
            delayed = delayed_view(views, ages[:, 0], jnp.floor(ages[:, 1] + uniform[:, 2]))
        view, states = sensors.sense(
            current_models(worlds), states, delayed, draws, dt_s, spec.camera
        )
        image = jax.lax.stop_gradient(view.depth_m)
        return view._replace(depth_m=image), (views[:periods], jax.lax.stop_gradient(states))

    return SensorModels(start, measure)


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


class Observer(NamedTuple):
    """The observation of policies, as pure functions over B worlds; images have no gradient."""

    start: Callable[[Worlds, DynamicsState], Any]
    """(worlds, state at the start) -> memory of the sensor models; () without models."""
    observe: Callable[..., tuple[Observation, Any]]
    """(worlds, state, target, last_action_b, keys (B,), memory) -> (observation, new memory).
    `target` is the number of passed gates."""


def make_observer(config: TrainConfig) -> Observer:
    """Return the observation in training, with image noise and sensor errors."""
    spec, camera, noise = config.spec, config.spec.camera, config.physics.depth_noise
    # One ray a pixel, also for a supersampling camera: more rays cost time and had no benefit.
    rays = jnp.asarray(pixel_rays_b(camera), jnp.float32)
    models = None if config.sensors is None else make_sensor_models(config)

    def true_view(worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
        # Scaling the rays across the optical axis changes the field of view. All worlds of an
        # iteration share the scale, so that the rays are one array.
        axis = rays.mean(0)
        scaled_rays = axis + (rays - axis) * worlds.fov_scale[0]
        pos_w, rot_w = jax.lax.stop_gradient((state.pos_w, state.rot_w))
        depth_m = depth_image(worlds.scene, pos_w, rot_w, scaled_rays, camera.range_m, SEEN)
        image_m = depth_m.reshape(-1, camera.height, camera.width)
        return view_in(worlds, state, target)._replace(depth_m=image_m)

    def start(worlds: Worlds, state: DynamicsState) -> Any:
        if models is None:
            return ()
        return models.start(worlds, true_view(worlds, state, jnp.asarray(worlds.target)))

    def observe_worlds(
        worlds: Worlds,
        state: DynamicsState,
        target: jax.Array,
        last_action_b: jax.Array,
        keys: jax.Array,
        memory: Any,
    ) -> tuple[Observation, Any]:
        view = true_view(worlds, state, target)
        if models is not None:
            view, memory = models.measure(worlds, view, keys, memory)
        observation = observe(spec, view, last_action_b, worlds.speed_command)
        grain = jax.vmap(lambda key: jax.random.normal(key, view.depth_m.shape[1:]))(keys)
        return observation._replace(image=observation.image + noise * grain), memory

    return Observer(start, observe_worlds)


def observed_at_start(worlds: Worlds, state: DynamicsState, config: TrainConfig) -> jax.Array:
    """Return the queue of delayed state vectors at the start, (B, state_delay, state_size).

    All of its entries are the state vector of the start.
    """
    view = view_in(worlds, state, jnp.asarray(worlds.target))
    no_action = jnp.zeros_like(state.pos_w)
    observed = observe(config.spec, view, no_action, worlds.speed_command).state
    return jnp.repeat(observed[:, None], config.physics.state_delay, axis=1)


def make_rollout(
    config: TrainConfig, note: Note | None = None
) -> Callable[..., tuple[jax.Array, StepRecord]]:
    """Return rollout(params, embedding_shift, worlds, key, encode, delta) -> (loss, records).

    `encode(params, image)` gives the embeddings; `embedding_shift` (T, B, hidden) is zero. `delta`
    are the parameters of a Delta Action network, which corrects the actions so that simulated
    flights match measured ones, or None. The loss is the mean over steps and worlds. The records
    have arrays (T, B, ...), without gradient; `note` adds some.
    """
    weights, physics, width = config.loss, config.physics, config.spec.hidden_size
    observer, dynamics = make_observer(config), make_dynamics(config)

    def start(worlds: Worlds) -> RolloutCarry:
        batch = len(worlds.target)
        state = dynamics.start(worlds.constants, worlds.pos_w, worlds.vel_w, worlds.heading_w)
        return RolloutCarry(
            state=state,
            target=jnp.asarray(worlds.target),
            hidden=jnp.asarray(worlds.hidden),
            action_b=jnp.zeros((batch, 3)),
            embeddings=jnp.zeros((batch, physics.image_delay, width)),
            observed=observed_at_start(worlds, state, config),
            delta_hidden=delta_network.start(batch),
            alive=jnp.ones(batch),
            sensed=observer.start(worlds, state),
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
            before, target = carry.state, carry.target
            keys = world_keys(key_now, worlds)
            # What the policy observes, with delays, and its action.
            observation, sensed = observer.observe(
                worlds, before, target, carry.action_b, keys, carry.sensed
            )
            embedding = encode(params, observation.image) + shift_now
            embedding, embeddings = queue(carry.embeddings, embedding)
            state, observed = queue(carry.observed, observation.state)
            action, hidden = network.recur(params, carry.hidden, embedding, state)
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
            carry = RolloutCarry(
                state=after,
                target=target_after,
                hidden=hidden,
                action_b=action,
                embeddings=embeddings,
                observed=observed,
                delta_hidden=delta_hidden,
                alive=carry.alive * intact * goes_on,
                sensed=sensed,
            )
            return carry, record

        keys = jax.random.split(key, steps)
        inputs = embedding_shift, keys, jnp.arange(steps)
        _, records = jax.lax.scan(step, start(worlds), inputs)
        loss = functools.reduce(jnp.add, (records.terms[name].mean() for name in losses.LOSSES))
        return loss, jax.lax.stop_gradient(records)

    return rollout
