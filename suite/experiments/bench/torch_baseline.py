"""The baseline of the benchmark `train`: the training method as a plain torch-eager loop.

Network, point mass, losses, vector field, delays and noise are those of `suite.train` with the
recipe `paper`. The encoder of the images runs inside the loop over steps, and the backward pass
goes through this loop. Settings that the recipe does not use are not implemented. In the shapes, B
is the number of worlds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from eval.effects.interface import GRAVITY
from policies.formats.torch_twin import torch_twin
from suite.experiments.bench import torch_scene
from suite.experiments.bench.torch_scene import to_local, to_world
from suite.train.config import TrainConfig
from suite.train.dynamics.point_mass import HEADING_RATE, PointMassParams, PointMassState
from suite.train.losses import BARRIER_HEIGHT, BARRIER_SLOPE, FIELD_DECAY, MAX_PULL, UNIT_FIELD
from suite.train.step import BEYOND_M, PATH_SAMPLES
from suite.train.update import WEIGHT_DECAY
from suite.train.worlds import Worlds
from tracks.geometry.camera import pixel_rays_b
from tracks.geometry.scene import Gates


def to_torch(tree: Any) -> Any:
    """Return a tree of named tuples with its arrays as tensors; None stays None."""
    if isinstance(tree, tuple):
        return type(tree)(*(to_torch(leaf) for leaf in tree))
    return None if tree is None else torch.as_tensor(tree)


def _norm(vector: Tensor) -> Tensor:
    """Return the lengths of vectors; a small addend keeps the gradient of a zero vector finite."""
    return ((vector * vector).sum(-1) + 1e-12).sqrt()


def faded(x: Tensor, factor: Tensor) -> Tensor:
    """Return `x` unchanged, but with its gradient multiplied by `factor`."""
    return x * factor + (x * (1 - factor)).detach()


def attitude(thrust_w: Tensor, heading_w: Tensor) -> Tensor:
    """Return the attitude of the body, a rotation from body to world axes (B, 3, 3).

    See `suite.train.dynamics.point_mass.attitude`.
    """
    force = thrust_w + torch.tensor([0.0, 0.0, GRAVITY])
    size = force.norm(dim=-1, keepdim=True)
    up = torch.where(size > 1e-3, force / size.clamp(min=1e-3), torch.tensor([0.0, 0.0, 1.0]))
    left = torch.linalg.cross(up, heading_w)
    left = left / left.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.stack([torch.linalg.cross(left, up), left, up], -1)


def step(
    body: PointMassState,
    constants: PointMassParams,
    action: Tensor,
    target_w: Tensor,
    config: TrainConfig,
) -> PointMassState:
    """Advance by one policy period; see `suite.train.dynamics.point_mass.step`."""
    dt = constants.time_step[:, None]
    # Delay and lag of the thrust: interpolate between the last commands, then filter.
    history = torch.cat([to_world(body.rot_w, action)[:, None], body.commands_w], 1)
    weights = (1.0 - (constants.delay[:, None] - torch.arange(3.0)).abs()).clamp(min=0)
    keep = (-constants.lag[:, None] * dt).exp()
    thrust = (weights[..., None] * history).sum(1) * (1 - keep) + body.thrust_w * keep
    # Acceleration with drag; position and velocity, whose gradients decay.
    airspeed_b = to_local(body.rot_w, body.vel_w - constants.wind_w)
    acc = thrust - to_world(body.rot_w, constants.drag * airspeed_b)
    fade = (-config.loss.gradient_decay * dt).exp()
    pos, vel = faded(body.pos_w, fade), faded(body.vel_w, fade)
    pos = pos + vel * dt + 0.5 * body.acc_w * dt * dt
    vel = vel + 0.5 * (body.acc_w + acc) * dt
    # The heading turns slowly towards the target; no gradient goes through the attitude.
    with torch.no_grad():
        towards = (target_w - pos) * torch.tensor([1.0, 1.0, 0.0])
        towards = towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-3)
        blend = (-HEADING_RATE * dt).exp()
        heading = body.heading_w * blend + towards * (1 - blend)
        size = heading.norm(dim=-1, keepdim=True)
        heading = torch.where(size > 1e-3, heading / size.clamp(min=1e-3), body.heading_w)
        rot = attitude(thrust, heading)
    return PointMassState(pos, vel, thrust, acc, rot, heading, history[:, :2])


class Baseline:
    """A policy in torch, its optimiser and the loss of a batch of worlds."""

    def __init__(self, config: TrainConfig, params: Mapping[str, Any]) -> None:
        """Make the network, with the parameters `params` of `policies.networks.network`."""
        self.config = config
        self.network = torch_twin(params, config.spec).requires_grad_(True)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), config.optimizer.rate, weight_decay=WEIGHT_DECAY
        )
        self.rays = torch.as_tensor(pixel_rays_b(config.spec.camera), dtype=torch.float32)

    def update(self, worlds: Worlds) -> float:
        """Make one gradient step on `worlds` (tensors) and return the loss."""
        self.optimizer.zero_grad()
        loss = self.loss(worlds)
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def loss(self, worlds: Worlds) -> Tensor:
        """Return the mean loss over steps and worlds of a rollout."""
        config, physics = self.config, self.config.physics
        count = worlds.pos_w.shape[0]
        zero, constants = torch.zeros(count, 3), worlds.constants
        assert isinstance(constants, PointMassParams)
        body = self.start(worlds)
        camera = config.spec.camera
        images = [torch.zeros(count, camera.height, camera.width)] * physics.image_delay
        states: list[Tensor] = []
        hidden = worlds.hidden
        action, target = zero, worlds.target.long()
        total = torch.zeros(())
        for _ in range(config.episode.steps):
            gate, target_w = self.target_gate(worlds.scene.gates, target)
            images.append(self.render(worlds, body))
            vel_b, gate_b = (to_local(body.rot_w, v) for v in (body.vel_w, target_w - body.pos_w))
            state = torch.cat([vel_b, body.rot_w[:, 2], gate_b, action], -1)
            states = [*(states or [state] * physics.state_delay), state]
            # Both lists are queues: the policy sees a delayed state and a delayed image.
            action, hidden = self.network(states.pop(0), images.pop(0), hidden)
            before, body = body, step(body, constants, action, target_w, config)
            passed = torch_scene.crossed(gate, before.pos_w, body.pos_w)
            total = total + self.step_loss(worlds, before, body, gate, target_w).mean()
            target = target + (passed & (target < worlds.scene.gates.center_w.shape[1]))
        return total / config.episode.steps

    def start(self, worlds: Worlds) -> PointMassState:
        """Return the bodies at the start of a rollout."""
        zero = torch.zeros_like(worlds.pos_w)
        return PointMassState(
            worlds.pos_w, worlds.vel_w, zero, zero, attitude(zero, worlds.heading_w),
            worlds.heading_w, torch.zeros(len(zero), 2, 3),
        )  # fmt: skip

    def target_gate(self, gates: Gates, target: Tensor) -> tuple[Gates, Tensor]:
        """Return the current gate of each world, and the point to fly to (B, 3).

        After the last gate it is a point beyond that gate.
        """
        count = gates.center_w.shape[1]
        rows = torch.arange(len(target))
        gate = Gates(*(array[rows, target.clamp(max=count - 1)] for array in gates))
        beyond = torch.where(target >= count, BEYOND_M, 0.0)[:, None]
        return gate, gate.center_w + beyond * gate.rot_w[:, :, 0]

    @torch.no_grad()
    def render(self, worlds: Worlds, body: PointMassState) -> Tensor:
        """Return the encoded images (B, height, width) with their noise."""
        camera, encoding = self.config.spec.camera, self.config.spec.depth
        axis = self.rays.mean(0)
        rays = axis + (self.rays - axis) * worlds.fov_scale[0]
        depth = torch_scene.depth_image(worlds.scene, body.pos_w, body.rot_w, rays, camera.range_m)
        image = encoding.scale / depth.clamp(encoding.near, camera.range_m) - encoding.offset
        image = image + self.config.physics.depth_noise * torch.randn_like(image)
        return image.reshape(-1, camera.height, camera.width)

    def step_loss(
        self,
        worlds: Worlds,
        before: PointMassState,
        body: PointMassState,
        gate: Gates,
        target_w: Tensor,
    ) -> Tensor:
        """Return the loss of a step (B,), from the states before and after it."""
        config = self.config.loss
        # Collisions: distances at points on the path of the step. The gradient of a distance is the
        # direction away from the obstacle.
        share = (torch.arange(PATH_SAMPLES) + 1.0) / PATH_SAMPLES
        path = before.pos_w[:, None] + share[:, None] * (body.pos_w - before.pos_w)[:, None]
        distance, away = torch_scene.nearest_obstacle(worlds.scene, path.detach())
        margin_m = distance + ((path - path.detach()) * away).sum(-1) - config.safety_radius_m
        barrier = torch.nn.functional.softplus(BARRIER_SLOPE * margin_m, threshold=1e3)
        closing = (-(away * body.vel_w.detach()[:, None]).sum(-1)).clamp(min=0)
        collide = closing * (1.0 - margin_m).clamp(min=0) ** 2
        loss = config.clearance * BARRIER_HEIGHT * barrier.mean(-1)
        loss = loss + config.collide * collide.mean(-1)

        # Smoothness.
        jerk = (body.acc_w - before.acc_w) / worlds.constants.time_step[:, None]
        loss = loss + config.acceleration * (body.acc_w**2).sum(-1)
        loss = loss + config.jerk * (jerk**2).sum(-1)

        # Progress: speed towards the target.
        to_gate = target_w - body.pos_w
        loss = loss - config.progress * (body.vel_w * to_gate).sum(-1) / _norm(to_gate)

        # Vector field: its gradient with respect to the position is the pull.
        pull = self.pull(gate, body.pos_w.detach(), body.vel_w.detach())
        guidance = (pull * (body.pos_w - body.pos_w.detach())).sum(-1)
        return loss - config.field_gain * guidance

    def pull(self, gate: Gates, pos_w: Tensor, vel_w: Tensor) -> Tensor:
        """Return the pull u_A of the vector field (B, 3).

        Its size is 1 in the centre of a gate of 1 m, for a flight across the field.
        """
        field = torch_scene.magnetic_field(gate, pos_w)
        size = field.norm(dim=-1)
        aligned = (vel_w * field).sum(-1) / (vel_w.norm(dim=-1) * size + 1e-5)
        pull = ((1 - aligned) / size.clamp(min=1e-9) ** FIELD_DECAY)[:, None] * field
        pull = pull / (2e-5 * UNIT_FIELD) ** (1 - FIELD_DECAY)
        return pull * (MAX_PULL / _norm(pull)).clamp(max=1.0)[:, None]
