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
from policies.observation import View, encode_depth, observe
from suite.train import losses
from suite.train.config import LossConfig, TrainConfig
from suite.train.dynamics.interface import DynamicsState, make_dynamics
from suite.train.worlds import Worlds
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.crossing import crossing
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Counts, Gates

SEEN = Counts(boxes=24, cylinders=8, capsules=5, spheres=5)
"""Solids of each kind that a training image shows, nearest first; the judge shows all."""
NEAR = Counts(boxes=8, cylinders=4, capsules=3, spheres=3)
"""Solids of each kind among which the nearest obstacle is looked for."""
BEYOND_M = 10.0
"""After the last gate the target is this far behind it, so that nothing is gained by braking; with
`episode.finish` that is for the one step that passes the gate."""
BODY_RADIUS_M = 0.08
"""Closer than this to a surface counts as a collision in the curves [m]."""


class RolloutCarry(NamedTuple):
    """What a world carries from step to step."""

    body: Any
    """Of the dynamics."""
    target: jax.Array
    """(B,) gates passed, counted from the track's first."""
    hidden: jax.Array
    """(B, hidden) of the policy."""
    action_b: jax.Array
    """(B, 3) the policy's last action, without correction [m/s^2]."""
    embeddings: jax.Array
    """(B, image_delay, hidden) the images on their way, oldest first."""
    states: jax.Array
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
"""note(worlds, before, body, target) -> arrays (B, ...) to be kept of a step; `target` is that of
its beginning."""


def target_gate(gates: Gates, target: jax.Array, ahead: int = 0) -> tuple[Gates, jax.Array]:
    """Return each world's current gate (B, ...) and the point to fly to (B, 3).

    With `ahead` it is the gate so many after that, or the last one where there is none, as the
    judge has it.
    """
    count = gates.center_w.shape[1]
    index = jnp.minimum(target + ahead, count - 1)
    gate = jax.tree.map(lambda array: jax.vmap(lambda rows, i: rows[i])(array, index), gates)
    beyond = jnp.where(target >= count, BEYOND_M, 0.0)[:, None]
    return gate, gate.center_w + beyond * gate.rot_w[:, :, 0]


def view_in(worlds: Worlds, body: DynamicsState, target: jax.Array) -> View:
    """Return what drones at `body` that have passed `target` (B,) gates can observe, but images."""
    gates = worlds.scene.gates
    gate, target_w = target_gate(gates, target)
    _, second_w = target_gate(gates, target, ahead=1)
    return View(body.pos_w, body.rot_w, body.vel_w, target_w, second_w, gate.rot_w[:, :, 0])


def queue(waiting: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (the oldest entry, the queue after it left and `new` joined)."""
    line = jnp.concatenate([waiting, new[:, None]], axis=1)
    return line[:, 0], line[:, 1:]


def make_look(
    config: TrainConfig,
) -> Callable[[Worlds, DynamicsState, jax.Array], jax.Array]:
    """Return look(worlds, body, key) -> (B, height, width), the encoded image with its noise."""
    spec, physics = config.spec, config.physics
    rays = jnp.asarray(pixel_rays_b(spec.camera), jnp.float32)

    def look(worlds: Worlds, body: DynamicsState, key: jax.Array) -> jax.Array:
        # Scaling the rays across the optical axis changes the field of view; every world of an
        # iteration shares it, so that the rays stay one array.
        axis = rays.mean(0)
        wide = axis + (rays - axis) * worlds.fov_scale[0]
        depth = depth_image(worlds.scene, body.pos_w, body.rot_w, wide, spec.camera.range_m, SEEN)
        image = encode_depth(spec.depth, depth, spec.camera.range_m)
        image = image + physics.depth_noise * jax.random.normal(key, image.shape)
        return image.reshape(-1, spec.camera.height, spec.camera.width)

    return look


def make_judge(
    weights: LossConfig,
) -> Callable[..., tuple[dict[str, jax.Array], jax.Array, jax.Array]]:
    """Return judge(worlds, before, body, target) -> (terms, clearance, passed), (B,) each.

    It scores the step from `before` to `body` of worlds that have passed `target` gates: the
    weighted terms, the smallest distance to a solid on the way [m] and whether a gate was passed.
    """

    def judge(
        worlds: Worlds, before: DynamicsState, body: DynamicsState, target: jax.Array
    ) -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        gate, _ = target_gate(worlds.scene.gates, target)
        count = worlds.scene.gates.center_w.shape[1]
        held = jax.lax.stop_gradient((before.pos_w, body.pos_w))
        passed, _ = crossing(gate.center_w, gate.rot_w, gate.opening_g, *held)
        passed = passed & (target < count)
        goal = target + (passed & weights.pass_first)
        aim, aim_w = target_gate(worlds.scene.gates, goal)
        local = to_local(aim.rot_w, body.pos_w - aim.center_w)
        shift = (goal < count) * losses.approach_shift(weights, local)
        goal_w = aim_w - shift[:, None] * aim.rot_w[:, :, 0]
        share = (jnp.arange(weights.path_samples) + 1.0) / weights.path_samples
        path = before.pos_w[:, None] + share[:, None] * (body.pos_w - before.pos_w)[:, None]
        distance, away = nearest_obstacle(worlds.scene, jax.lax.stop_gradient(path), NEAR)
        step = losses.Step(
            pos_w=body.pos_w,
            vel_w=body.vel_w,
            acc_w=body.acc_w,
            acc_before_w=before.acc_w,
            time_step=worlds.constants.time_step,
            gap=losses.gap_to_obstacles(weights, path, distance, away),
            away_w=away,
            goal_w=goal_w,
            place_g=local,
            gate=gate,
        )
        return losses.weighted(weights, step), distance.min(-1), passed

    return judge


def states_at_start(batch: int, config: TrainConfig) -> jax.Array:
    """Return the states on their way at the start, (B, state_delay, state_size): level, at rest."""
    size = config.spec.state_size
    return jnp.zeros((batch, config.physics.state_delay, size)).at[:, :, 5].set(1.0)


def make_rollout(
    config: TrainConfig, note: Note | None = None
) -> Callable[..., tuple[jax.Array, StepRecord]]:
    """Return rollout(params, embedding_shift, worlds, key, encode, delta) -> (loss, records).

    `encode(params, image)` gives the embeddings; `embedding_shift` is (T, B, hidden); `delta` is
    the frozen Delta Action network's parameters or None. The loss is the mean over steps and
    worlds; records are (T, B, ...).
    """
    spec, physics, weights = config.spec, config.physics, config.loss
    look, judge, dynamics = make_look(config), make_judge(weights), make_dynamics(config)

    def act(
        params: network.Params,
        carry: RolloutCarry,
        embedding: jax.Array,
        seen: View,
    ) -> tuple[jax.Array, RolloutCarry]:
        state, states = queue(carry.states, observe(spec, seen, carry.action_b).state)
        embedding, embeddings = queue(carry.embeddings, embedding)
        action, hidden = network.recur(params, carry.hidden, embedding, state)
        carry = carry._replace(hidden=hidden, action_b=action, embeddings=embeddings, states=states)
        return action, carry

    def rollout(
        params: network.Params,
        embedding_shift: jax.Array,
        worlds: Worlds,
        key: jax.Array,
        encode: Callable[[network.Params, jax.Array], jax.Array],
        delta: delta_network.Params | None = None,
    ) -> tuple[jax.Array, StepRecord]:
        steps, batch, width = embedding_shift.shape
        body = dynamics.start(worlds.constants, worlds.pos_w, worlds.vel_w, worlds.heading_w)
        carry = RolloutCarry(
            body=body,
            target=worlds.target,
            hidden=jnp.asarray(worlds.hidden),
            action_b=jnp.zeros((batch, 3)),
            embeddings=jnp.zeros((batch, physics.image_delay, width)),
            states=states_at_start(batch, config),
            delta_hidden=delta_network.start(batch),
            alive=jnp.ones(batch),
        )

        def step(
            carry: RolloutCarry, inputs: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[RolloutCarry, StepRecord]:
            shift_now, key_now, number = inputs
            before = carry.body
            image = look(worlds, jax.lax.stop_gradient(before), key_now)
            seen = view_in(worlds, before, carry.target)
            embedding = encode(params, image) + shift_now
            action, carry = act(params, carry, embedding, seen)
            if delta is not None:
                vel_b = to_local(jax.lax.stop_gradient(before.rot_w), before.vel_w)
                correction, delta_hidden = delta_network.step(
                    delta, carry.delta_hidden, vel_b, before.rot_w[:, 2], action
                )
                action = action + correction
                carry = carry._replace(delta_hidden=delta_hidden)
            body = dynamics.step(before, worlds.constants, action, seen.gate_w, key_now)
            terms, clearance, passed = judge(worlds, before, body, carry.target)
            terms = {name: term * carry.alive for name, term in terms.items()}
            alive = carry.alive * (clearance > -weights.crash_depth_m)
            alive = alive * (number + 1 < worlds.stop)
            target = carry.target + passed
            if config.episode.finish:
                alive = alive * (target < worlds.scene.gates.center_w.shape[1])
            record = StepRecord(
                image=image,
                terms=terms,
                speed=jnp.linalg.norm(body.vel_w, axis=-1),
                clearance=clearance,
                passed=passed,
                pos_w=body.pos_w,
                hidden=carry.hidden,
                alive=carry.alive,
                noted=None if note is None else note(worlds, before, body, carry.target),
            )
            return carry._replace(body=body, target=target, alive=alive), record

        keys = jax.random.split(key, steps)
        _, records = jax.lax.scan(step, carry, (embedding_shift, keys, jnp.arange(steps)))
        loss = functools.reduce(jnp.add, (records.terms[name].mean() for name in losses.LOSSES))
        return loss, jax.lax.stop_gradient(records)

    return rollout
