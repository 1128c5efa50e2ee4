"""A fleet of reduced quadrotors as a plain torch-eager loop; see `suite.train.dynamics.reduced`."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from eval.effects.interface import GRAVITY
from eval.quadrotor.attitude import HEADING_RATE, LEAST_FORCE
from suite.experiments.bench.torch_scene import Tensor, to_local, to_world
from suite.train.dynamics.reduced import Gains, ReducedParams


class TorchReduced(NamedTuple):
    """State of the quadrotors as tensors; shapes and units are `reduced.ReducedState`'s."""

    pos_w: Tensor
    vel_w: Tensor
    acc_w: Tensor
    rot_w: Tensor
    heading_w: Tensor
    loop: Tensor
    thrust_root: Tensor
    commands: Tensor


def faded(x: Tensor, factor: Tensor) -> Tensor:
    """Return `x` with its gradient times `factor`."""
    return x * factor + (x * (1 - factor)).detach()


def exp_rot(vector: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    zero = torch.zeros_like(vector[..., 0])
    x, y, z = vector.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)
    return torch.linalg.matrix_exp(skew)


def start(params: ReducedParams, pos_w: Tensor, vel_w: Tensor, rot_w: Tensor) -> TorchReduced:
    """Return bodies that hovered until now, at vel_w [m/s], with their attitude."""
    batch, length = params.delay_share.shape
    hover = torch.tensor([GRAVITY, 0.0, 0.0, 0.0])
    return TorchReduced(
        pos_w,
        vel_w,
        torch.zeros_like(pos_w),
        rot_w,
        rot_w[..., 0],
        torch.zeros(batch, 3, 3),
        torch.full((batch, 1), math.sqrt(GRAVITY)),
        hover.expand(batch, length, 4),
    )


def blend(heading_w: Tensor, to_gate_w: Tensor, dt: Tensor) -> Tensor:
    """Return the heading (B, 3) after `dt` (B,) [s]; see `eval.quadrotor.attitude`."""
    hx, hy = heading_w[:, 0], heading_w[:, 1]
    gx, gy = to_gate_w[:, 0], to_gate_w[:, 1]
    turn = (1 - torch.exp(-HEADING_RATE * dt)) * torch.atan2(hx * gy - hy * gx, hx * gx + hy * gy)
    x, y = turn.cos() * hx - turn.sin() * hy, turn.sin() * hx + turn.cos() * hy
    length = (x * x + y * y).sqrt()
    return torch.stack([x / length, y / length, torch.zeros_like(x)], -1)


def asked(gains: Gains, rot_w: Tensor, action: Tensor, heading_w: Tensor) -> Tensor:
    """Return thrust and rates (B, 4) of the attitude loop; see `attitude_command`."""
    force_b = action + GRAVITY * rot_w[:, 2]
    heading_b = to_local(rot_w, heading_w)
    up_b = force_b / force_b.norm(dim=-1, keepdim=True).clamp(min=LEAST_FORCE)
    a, b, c = up_b.unbind(-1)
    across = a * a + b * b
    tilted = across > 1e-12
    sine = torch.where(tilted, across, torch.ones_like(c)).sqrt()
    angle = torch.atan2(torch.where(tilted, sine, torch.zeros_like(c)), c)
    share = 1.0 / (1.0 + c)
    front = torch.stack([1.0 - a * a * share, -a * b * share, -a], -1)
    ahead = (heading_b * front).sum(-1)
    aside = (heading_b * torch.linalg.cross(up_b, front)).sum(-1)
    yaw = torch.atan2(aside, ahead)
    error = torch.stack([-b * angle / sine, a * angle / sine, yaw], -1)
    limit = gains.rate_max
    rate = torch.minimum(torch.maximum(gains.attitude_gain * error, -limit), limit)
    return torch.cat([force_b[:, 2:].clamp(min=0), rate], -1)


def fly(
    body: TorchReduced, params: ReducedParams, action: Tensor, target_w: Tensor, dt: Tensor
) -> TorchReduced:
    """Advance one step of `dt` (B, 1) [s]; see `suite.train.dynamics.reduced.fly`."""
    vehicle = params.vehicle
    with torch.no_grad():
        heading_w = blend(body.heading_w, target_w - body.pos_w, dt[:, 0])
    gains = Gains(vehicle.attitude_gain, vehicle.rate_max)
    now = asked(gains, body.rot_w, action, heading_w)
    commands = torch.cat([now[:, None], body.commands[:, :-1]], 1)
    acting = (params.delay_share[..., None] * commands).sum(1)
    rate, trim = body.loop[..., 0], body.loop[..., 2]
    limit = vehicle.turn_max
    wanted = vehicle.rate_gain * (acting[:, 1:] - rate) + trim
    share = (wanted[:, :2] / limit[:, :2]).abs().sum(-1)
    turn = wanted[:, :2] / share.clamp(min=1.0)[:, None]
    yaw = torch.minimum(torch.maximum(wanted[:, 2:], -limit[:, 2:]), limit[:, 2:])
    wanted = torch.cat([turn, yaw], -1)
    rate_cmd = rate + (wanted - trim) / vehicle.rate_gain
    level = 0.5 * share.clamp(max=1.0) * vehicle.thrust_max
    thrust = torch.minimum(torch.maximum(acting[:, 0], level), vehicle.thrust_max - level)
    root = thrust[:, None].clamp(min=1e-12).sqrt()
    lag = vehicle.rotor_lag[:, None]
    left, behind = (-dt / lag).exp(), body.thrust_root - root
    square = root**2 + 2 * root * behind * lag / dt * (1 - left)
    square = square + behind**2 * 0.5 * lag / dt * (1 - left**2)
    push = vehicle.force_scale[:, None] * square
    bias = vehicle.trim + vehicle.turn_by_thrust * push
    inputs = torch.cat([body.loop, torch.stack([rate_cmd, bias], -1)], -1)
    turned = (params.turn @ inputs[..., None])[..., 0]
    air_b = to_local(body.rot_w, body.vel_w - vehicle.wind_w)
    speed = ((air_b * air_b).sum(-1, keepdim=True) + 1e-6).sqrt()
    drag_b = (vehicle.drag + vehicle.quadratic * speed) * air_b
    half_w = body.rot_w @ exp_rot(0.5 * turned[..., 0])
    acc_w = half_w[..., 2] * push - to_world(body.rot_w, drag_b) - torch.tensor([0.0, 0.0, GRAVITY])
    return TorchReduced(
        body.pos_w + dt * body.vel_w + 0.5 * dt * dt * acc_w,
        body.vel_w + dt * acc_w,
        acc_w,
        body.rot_w @ exp_rot(turned[..., 0]),
        heading_w,
        turned[..., 1:],
        root + behind * left,
        commands,
    )


def step(
    body: TorchReduced,
    params: ReducedParams,
    action: Tensor,
    target_w: Tensor,
    steps: int,
    decay: float,
) -> TorchReduced:
    """Advance one policy period; see `suite.train.dynamics.reduced.step`."""
    period = params.time_step[:, None]
    fade = (-decay * period).exp()
    before_w = faded(body.vel_w, fade)
    body = body._replace(
        pos_w=faded(body.pos_w, fade),
        vel_w=before_w,
        rot_w=faded(body.rot_w, fade[..., None]),
        loop=faded(body.loop, fade[..., None]),
    )
    for _ in range(steps):
        body = fly(body, params, action, target_w, period / steps)
    return body._replace(acc_w=(body.vel_w - before_w) / period)


def as_seen(body: TorchReduced, age_s: Tensor) -> TorchReduced:
    """Return about what the bodies were `age_s` (B,) [s] ago."""
    age = age_s[:, None]
    return body._replace(
        pos_w=body.pos_w - age * body.vel_w,
        vel_w=body.vel_w - age * body.acc_w,
        rot_w=body.rot_w @ exp_rot(-age * body.loop[..., 0]),
    )
