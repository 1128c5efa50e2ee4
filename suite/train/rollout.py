"""One rollout of the policy in its dynamics, with the loss of every step.

The image has no gradient with respect to the state (Zhang et al. 2025), so the encoder is outside
the differentiated loop: the embeddings enter as constants plus `embedding_shift`, a zero whose
gradient is the embeddings' cotangent. Obstacles, field and gates are evaluated without gradient as
well.
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
from eval.sensors.draws import keyed_draws
from eval.sensors.interface import product, rotation_since
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
"""Solids of each kind in a training image, the nearest ones; the judge's images have all."""


class RolloutCarry(NamedTuple):
    """State of a world between steps."""

    state: Any
    """Of the dynamics."""
    target: jax.Array
    """(B,) gates passed, counted from the track's first."""
    hidden: jax.Array
    """(B, hidden) of the policy."""
    action_b: jax.Array
    """(B, 3) the policy's last action, without correction [m/s^2]."""
    embeddings: jax.Array
    """(B, image_delay, hidden) the delayed images, oldest first."""
    observed: jax.Array
    """(B, state_delay, state_size) the delayed states, oldest first."""
    delta_hidden: jax.Array
    """(B, 32) of the Delta Action network."""
    alive: jax.Array
    """(B,) 1 while the world counts in the loss: until it crashes, stops or finishes, then 0."""
    sensed: Any = ()
    """Memory of the sensor models."""


class StepRecord(NamedTuple):
    """Records of a step, (B, ...) each."""

    image: jax.Array
    """(B, height, width) encoded, with its noise."""
    terms: dict[str, jax.Array]
    """Weighted losses by name, zero for worlds that have left the loss."""
    speed: jax.Array
    """[m/s]."""
    clearance: jax.Array
    """Smallest signed distance on the step's path [m]."""
    passed: jax.Array
    """Bool: a gate was crossed in this step."""
    pos_w: jax.Array
    """(B, 3) at the step's end [m]."""
    hidden: jax.Array
    """(B, hidden) recurrent state after the step."""
    alive: jax.Array
    """1 where the step counted in the loss, else 0."""
    noted: Any = None
    """Result of `note`, if there is one."""


Note = Callable[[Worlds, DynamicsState, DynamicsState, jax.Array], Any]
"""note(worlds, before, after, target) -> arrays (B, ...) that are recorded of a step; `target` is
that at its beginning."""


def view_in(worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
    """Return the observation, without image, of drones that have passed `target` (B,) gates."""
    gates = worlds.scene.gates
    gate, target_w = target_gate(gates, target)
    after, second_w = target_gate(gates, target, ahead=1)
    axes_w = gate.rot_w[:, :, 0], after.rot_w[:, :, 0]
    return View(
        state.pos_w, state.rot_w, state.vel_w, target_w, second_w, *axes_w, gate_number=target
    )


def queue(waiting: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (the oldest entry, the queue without it and with `new` at its end)."""
    line = jnp.concatenate([waiting, new[:, None]], axis=1)
    return line[:, 0], line[:, 1:]


def world_keys(key: jax.Array, worlds: Worlds) -> jax.Array:
    """Return a key (B,) for each world, independent of the other worlds of the batch."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, worlds.number)


class Senses(NamedTuple):
    """The sensor models of a training, as pure functions over B worlds."""

    start: Callable[[Worlds, View], Any]
    """(worlds, view at the start) -> memory of the models."""
    see: Callable[[Worlds, View, jax.Array, Any], tuple[View, Any]]
    """(worlds, truth, keys (B,), memory) -> (view with errors, memory)."""


def make_senses(config: TrainConfig) -> Senses:
    """Return the sensor models of `config.sensors`, with each world's magnitudes and draws.

    The functions are the judge's. The trainer has states only at decisions: a state in between is
    interpolated, and an image in between is one of the two neighbours, at random.
    """
    assert config.sensors is not None
    held, spec, dt_s = config.sensors.seen.models, config.spec, 1.0 / config.spec.rate_hz
    parts, longest = view_models(held), config.sensors.magnitude[1]
    ages = (scale_model(name, held[name], longest) for name in held if name == "delay")
    # Number of stored views: the largest possible age in policy periods.
    periods = max((ceil((1 + d.jitter) * max(d.state, d.image) / dt_s) for d in ages), default=0)

    def current_models(worlds: Worlds) -> dict[str, Any]:
        assert worlds.sensed is not None
        return sensors.scale_models(parts, worlds.sensed.magnitude)

    def start(worlds: Worlds, truth: View) -> Any:
        assert worlds.sensed is not None
        about = worlds.sensed.trial, dt_s, spec.camera
        return (truth,) * periods, sensors.start(current_models(worlds), truth, *about)

    def see(worlds: Worlds, truth: View, keys: jax.Array, memory: Any) -> tuple[View, Any]:
        past, kept = memory
        draws, views = {}, (truth, *past)
        for number, name in enumerate(parts):
            own = jax.vmap(jax.random.fold_in, (0, None))(keys, number + 1)
            needs = SENSORS[name].observation
            draws[name] = jax.vmap(lambda key, n=needs: keyed_draws(n, key, spec.camera))(own)
        old = truth
        if past:
            assert worlds.sensed is not None
            delay = scale_model("delay", held["delay"], worlds.sensed.magnitude["delay"])
            own = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
            chance = jax.vmap(lambda key: jax.random.uniform(key, (3,)))(own)
            shake = 1.0 + delay.jitter * (2.0 * chance[:, :2] - 1.0)
            ages = jnp.stack([delay.state, delay.image], -1) * shake / dt_s
            old = older(views, ages[:, 0], jnp.floor(ages[:, 1] + chance[:, 2]))
        seen, kept = sensors.sense(current_models(worlds), kept, old, draws, dt_s, spec.camera)
        image = jax.lax.stop_gradient(seen.depth_m)
        return seen._replace(depth_m=image), (views[:periods], jax.lax.stop_gradient(kept))

    return Senses(start, see)


def older(views: tuple[View, ...], age: jax.Array, image_age: jax.Array) -> View:
    """Return the view of an age between decisions; the next gate is that of the nearer decision.

    Args:
        views: at this decision, the one before, and so on.
        age: (B,) of the state [policy periods].
        image_age: (B,) of the image, whole numbers [policy periods].
    """
    seen = views[0]
    for number, (late, before) in enumerate(pairwise(views)):
        share = age - number
        part, turn_b = share[:, None], rotation_since(before.rot_w, late.rot_w)
        old = select(share > 0.5, before, late)._replace(
            pos_w=late.pos_w + part * (before.pos_w - late.pos_w),
            vel_w=late.vel_w + part * (before.vel_w - late.vel_w),
            rot_w=product(late.rot_w, exp_rot(part * turn_b)),
            depth_m=seen.depth_m,
        )
        seen = select(share > 0.0, old, seen)
        seen = seen._replace(depth_m=select(image_age > number, before.depth_m, seen.depth_m))
    return seen


class Sight(NamedTuple):
    """The observation of policies, as pure functions over B worlds; images have no gradient."""

    start: Callable[[Worlds, DynamicsState], Any]
    """(worlds, state at the start) -> memory of the sensor models; () without models."""
    see: Callable[..., tuple[Observation, Any]]
    """(worlds, state, target, last_action_b, keys (B,), memory) -> (observation, memory); without
    sensor models `memory` may be left out."""


def make_sight(config: TrainConfig) -> Sight:
    """Return the observation in training, with image noise and sensor errors."""
    spec, camera, noise = config.spec, config.spec.camera, config.physics.depth_noise
    # One ray a pixel, also for a supersampling camera: more rays took time without a gain.
    rays = jnp.asarray(pixel_rays_b(camera), jnp.float32)
    senses = None if config.sensors is None else make_senses(config)

    def true_view(worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
        # Scaling the rays across the optical axis changes the field of view. All worlds of an
        # iteration share the scale, so that the rays are one array.
        axis = rays.mean(0)
        wide = axis + (rays - axis) * worlds.fov_scale[0]
        pos_w, rot_w = jax.lax.stop_gradient((state.pos_w, state.rot_w))
        depth_m = depth_image(worlds.scene, pos_w, rot_w, wide, camera.range_m, SEEN)
        image_m = depth_m.reshape(-1, camera.height, camera.width)
        return view_in(worlds, state, target)._replace(depth_m=image_m)

    def start(worlds: Worlds, state: DynamicsState) -> Any:
        if senses is None:
            return ()
        return senses.start(worlds, true_view(worlds, state, jnp.asarray(worlds.target)))

    def see(
        worlds: Worlds,
        state: DynamicsState,
        target: jax.Array,
        last_action_b: jax.Array,
        keys: jax.Array,
        memory: Any = (),
    ) -> tuple[Observation, Any]:
        view = true_view(worlds, state, target)
        if senses is not None:
            view, memory = senses.see(worlds, view, keys, memory)
        seen = observe(spec, view, last_action_b, worlds.wanted)
        grain = jax.vmap(lambda key: jax.random.normal(key, view.depth_m.shape[1:]))(keys)
        return seen._replace(image=seen.image + noise * grain), memory

    return Sight(start, see)


def observed_at_start(worlds: Worlds, state: DynamicsState, config: TrainConfig) -> jax.Array:
    """Return the delayed states at the start, (B, state_delay, state_size): copies of the first."""
    view, still = view_in(worlds, state, jnp.asarray(worlds.target)), jnp.zeros_like(state.pos_w)
    seen = observe(config.spec, view, still, worlds.wanted).state
    return jnp.repeat(seen[:, None], config.physics.state_delay, axis=1)


def make_rollout(
    config: TrainConfig, note: Note | None = None
) -> Callable[..., tuple[jax.Array, StepRecord]]:
    """Return rollout(params, embedding_shift, worlds, key, encode, delta) -> (loss, records).

    `encode(params, image)` gives the embeddings; `embedding_shift` is (T, B, hidden); `delta` is
    the frozen Delta Action network's parameters or None. The loss is the mean over steps and
    worlds; records are (T, B, ...), without gradient.
    """
    weights, physics, width = config.loss, config.physics, config.spec.hidden_size
    sight, dynamics = make_sight(config), make_dynamics(config)

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
            sensed=sight.start(worlds, state),
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
            seen, sensed = sight.see(worlds, before, target, carry.action_b, keys, carry.sensed)
            embedding = encode(params, seen.image) + shift_now
            embedding, embeddings = queue(carry.embeddings, embedding)
            state, observed = queue(carry.observed, seen.state)
            action, hidden = network.recur(params, carry.hidden, embedding, state)
            flown, delta_hidden = action, carry.delta_hidden
            if delta is not None:
                vel_b = to_local(before.rot_w, before.vel_w)
                correction, delta_hidden = delta_network.step(
                    delta, delta_hidden, vel_b, before.rot_w[:, 2], action
                )
                flown = action + correction
            _, target_w = target_gate(worlds.scene.gates, target)
            after = dynamics.step(before, worlds.constants, flown, target_w, keys)
            made = make_step(weights, worlds, before, after, target)
            terms = losses.weighted(weights, made)
            target_after = target + made.passed
            goes_on = number + 1 < worlds.stop
            if config.episode.finish:
                goes_on = goes_on & (target_after < worlds.scene.gates.center_w.shape[1])
            intact = made.clearance > -weights.crash_depth_m
            if weights.tilt > 0.0:
                intact = intact & (made.up > 0.0)
            record = StepRecord(
                image=seen.image,
                terms={name: term * carry.alive for name, term in terms.items()},
                speed=jnp.linalg.norm(after.vel_w, axis=-1),
                clearance=made.clearance,
                passed=made.passed,
                pos_w=after.pos_w,
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
