"""One rollout of the policy in its dynamics, with the loss of every step.

The image carries no gradient to the state (Zhang et al. 2025), so the encoder can leave the
differentiated loop: the embeddings enter as constants plus `embedding_shift`, a zero whose gradient
is their cotangent. Obstacles, field and gates are looked up on values without gradient for the same
reason.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from policies.networks import delta_network, network
from policies.observation import Observation, View, observe
from suite.train import losses
from suite.train.config import TrainConfig
from suite.train.dynamics.interface import DynamicsState, make_dynamics
from suite.train.step import make_step, target_gate
from suite.train.worlds import Worlds
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Counts

SEEN = Counts(boxes=24, cylinders=8, capsules=5, spheres=5)
"""Solids of each kind that a training image shows, nearest first; the judge shows all."""


class RolloutCarry(NamedTuple):
    """What a world carries from step to step."""

    state: Any
    """Of the dynamics."""
    target: jax.Array
    """(B,) gates passed, counted from the track's first."""
    hidden: jax.Array
    """(B, hidden) of the policy."""
    action_b: jax.Array
    """(B, 3) the policy's last action, without correction [m/s^2]."""
    embeddings: jax.Array
    """(B, image_delay, hidden) the images on their way, oldest first."""
    observed: jax.Array
    """(B, state_delay, state_size) the states on their way, oldest first."""
    delta_hidden: jax.Array
    """(B, 32) of the Delta Action network."""
    alive: jax.Array
    """(B,) 1 while the world counts in the loss: until it crashes, stops or finishes, then 0."""


class StepRecord(NamedTuple):
    """What a step leaves behind, (B, ...) each."""

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
    """What `note` returned, where there was one."""


Note = Callable[[Worlds, DynamicsState, DynamicsState, jax.Array], Any]
"""note(worlds, before, after, target) -> arrays (B, ...) to be kept of a step; `target` is that of
its beginning."""


def view_in(worlds: Worlds, state: DynamicsState, target: jax.Array) -> View:
    """Return what drones in `state` that have passed `target` (B,) gates observe, but the image."""
    gates = worlds.scene.gates
    gate, target_w = target_gate(gates, target)
    after, second_w = target_gate(gates, target, ahead=1)
    axes_w = gate.rot_w[:, :, 0], after.rot_w[:, :, 0]
    return View(state.pos_w, state.rot_w, state.vel_w, target_w, second_w, *axes_w)


def queue(waiting: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (the oldest entry, the queue after it left and `new` joined)."""
    line = jnp.concatenate([waiting, new[:, None]], axis=1)
    return line[:, 0], line[:, 1:]


def world_keys(key: jax.Array, worlds: Worlds) -> jax.Array:
    """Return a key (B,) for each world, whichever other worlds are computed with it."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, worlds.number)


def make_sight(config: TrainConfig) -> Callable[..., Observation]:
    """Return sight(worlds, state, target, last_action_b, keys (B,)) -> what the policy is given.

    The image has its noise, and carries no gradient to the state.
    """
    spec, camera, noise = config.spec, config.spec.camera, config.physics.depth_noise
    # One ray a pixel, whatever the camera casts in flight: more cost time and gained nothing.
    rays = jnp.asarray(pixel_rays_b(camera), jnp.float32)

    def sight(
        worlds: Worlds,
        state: DynamicsState,
        target: jax.Array,
        last_action_b: jax.Array,
        keys: jax.Array,
    ) -> Observation:
        # Scaling the rays across the optical axis changes the field of view; every world of an
        # iteration shares it, so that the rays stay one array.
        axis = rays.mean(0)
        wide = axis + (rays - axis) * worlds.fov_scale[0]
        pos_w, rot_w = jax.lax.stop_gradient((state.pos_w, state.rot_w))
        depth_m = depth_image(worlds.scene, pos_w, rot_w, wide, camera.range_m, SEEN)
        image_m = depth_m.reshape(-1, camera.height, camera.width)
        view = view_in(worlds, state, target)._replace(depth_m=image_m)
        seen = observe(spec, view, last_action_b, worlds.wanted)
        grain = jax.vmap(lambda key: jax.random.normal(key, image_m.shape[1:]))(keys)
        return seen._replace(image=seen.image + noise * grain)

    return sight


def observed_at_start(worlds: Worlds, state: DynamicsState, config: TrainConfig) -> jax.Array:
    """Return the states on their way at first, (B, state_delay, state_size): the start's own."""
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
            seen = sight(worlds, before, target, carry.action_b, keys)
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
            unhurt = made.clearance > -weights.crash_depth_m
            if weights.tilt > 0.0:
                unhurt = unhurt & (made.up > 0.0)
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
                alive=carry.alive * unhurt * goes_on,
            )
            return carry, record

        keys = jax.random.split(key, steps)
        inputs = embedding_shift, keys, jnp.arange(steps)
        _, records = jax.lax.scan(step, start(worlds), inputs)
        loss = functools.reduce(jnp.add, (records.terms[name].mean() for name in losses.LOSSES))
        return loss, jax.lax.stop_gradient(records)

    return rollout
