"""Quadrotors as a plain torch-eager loop; see `suite.train.dynamics.quadrotor`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from eval.effects.interface import GRAVITY
from eval.quadrotor.loops import NOMINAL
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.rotors import delay_weight
from suite.experiments.bench.torch_fleet import asked, blend, exp_rot, faded
from suite.experiments.bench.torch_scene import Tensor, to_local, to_world
from suite.train.config import QuadrotorConfig
from suite.train.dynamics.quadrotor import QuadrotorParams, Substeps, longest_delay
from suite.train.dynamics.reduced import Gains

NEGLIGIBLE_N = 1e-6
"""Thrusts below this are none; see `eval.quadrotor.rotors`."""


class Plants(NamedTuple):
    """B quadrotors and their controller as tensors, prepared for steps of one length."""

    time_step: Tensor
    """(B,) the policy's period [s]."""
    gains: Gains
    """The attitude loop's."""
    nominal_mass: float
    """As the controller believes it [kg]."""
    inertia: Tensor
    """(3,) [kg m^2]."""
    unmixer: Tensor
    """(4, 4) from (force, torque) to rotor thrusts."""
    thrust_max: float
    """Of one rotor [N]."""
    thrust_coefficient: float
    """As the controller believes it [N/(rad/s)^2]."""
    yaw_coefficient: Tensor
    """(4,) torque about z by the square of a rotor's speed [N m/(rad/s)^2]."""
    mass: Tensor
    """(B, 1) [kg]."""
    true_coefficient: Tensor
    """(B, 4) [N/(rad/s)^2]."""
    arm: Tensor
    """(B, 4, 3) hubs from the centre of mass [m]."""
    lag: Tensor
    """(B, 1) the rotors' time constant, 0: none [s]."""
    rate_gain: Tensor
    """(B, 3) [1/s]."""
    delay_share: Tensor
    """(B, L) of each remembered command in the one that acts, newest first."""
    drag: Tensor
    """(B, 3) linear [1/s]."""
    wind_w: Tensor
    """(B, 3) [m/s]."""
    trim: Tensor
    """(B, 3) constant torque [N m]."""


class TorchQuadrotor(NamedTuple):
    """State of the quadrotors as tensors; shapes and units are `quadrotor.QuadrotorState`'s."""

    pos_w: Tensor
    vel_w: Tensor
    acc_w: Tensor
    rot_w: Tensor
    rate_b: Tensor
    heading_w: Tensor
    rotor_speed: Tensor
    """(B, 4) [rad/s]."""
    commands: Tensor
    """(B, L, 4) the last commands, newest first: thrust [m/s^2] and rates [rad/s]."""


def prepare(config: QuadrotorConfig, params: QuadrotorParams, dt: float) -> Plants:
    """Return what is flown of `params` in steps of `dt` [s].

    Raises:
        ValueError: for a vehicle with a firmware's rate loop, or an effect that does not vary.
    """
    vehicle, rotors = config.vehicle, config.vehicle.rotors
    if vehicle.controller.kind != NOMINAL:
        raise ValueError(
            f"controller.kind is {vehicle.controller.kind}, allowed for the torch baseline is "
            f"{NOMINAL}"
        )
    effects, batch = params.effects, len(params.time_step)
    for name in vehicle.effects:
        if name not in effects:
            raise ValueError(
                f"effects.{name} is in the vehicle, allowed for the torch baseline are "
                f"{', '.join(effects)}"
            )

    def drawn(effect: str, field: str, other: float, *shape: int) -> Tensor:
        """Return the values (B, *shape) of an effect, or `other` where there is none."""
        if effect not in effects:
            return torch.full((batch, *shape), other)
        return torch.as_tensor(np.asarray(getattr(effects[effect], field))).reshape(batch, *shape)

    per_thrust = rotors.torque_coefficient / rotors.thrust_coefficient
    unmixer = np.linalg.inv(mixer_matrix(rotors.position, rotors.spin, per_thrust))
    delay = np.asarray(effects["command_delay"].delay)
    scale = drawn("thrust_scale", "scale", 1.0, 1)
    position = torch.tensor(rotors.position)
    return Plants(
        time_step=torch.as_tensor(params.time_step),
        gains=Gains(
            *map(torch.tensor, (vehicle.controller.attitude_gain, vehicle.controller.rate_max))
        ),
        nominal_mass=vehicle.mass,
        inertia=torch.tensor(vehicle.inertia),
        unmixer=torch.tensor(unmixer, dtype=torch.float32),
        thrust_max=rotors.thrust_max,
        thrust_coefficient=rotors.thrust_coefficient,
        yaw_coefficient=-torch.tensor(rotors.spin) * rotors.torque_coefficient,
        mass=vehicle.mass + drawn("mass_offset", "offset", 0.0, 1),
        true_coefficient=rotors.thrust_coefficient * scale.expand(batch, 4),
        arm=position - drawn("com_offset", "offset", 0.0, 1, 3),
        lag=drawn("motor_lag", "time_constant", rotors.time_constant, 1),
        rate_gain=torch.tensor(vehicle.controller.rate_gain) * drawn("rate_gain", "scale", 1.0, 3),
        delay_share=torch.as_tensor(delay_weight(delay, dt, longest_delay(config))).float(),
        drag=drawn("linear_drag", "coefficient", 0.0, 3),
        wind_w=drawn("constant_wind", "velocity", 0.0, 3),
        trim=drawn("torque_trim", "torque", 0.0, 3),
    )


def start(plants: Plants, pos_w: Tensor, vel_w: Tensor, rot_w: Tensor) -> TorchQuadrotor:
    """Return bodies that hovered until now, at vel_w [m/s], with their attitude."""
    batch, length = plants.delay_share.shape
    still = torch.zeros_like(pos_w)
    hover = torch.tensor([GRAVITY, 0.0, 0.0, 0.0]).expand(batch, 4)
    return TorchQuadrotor(
        pos_w,
        vel_w,
        still,
        rot_w,
        still,
        rot_w[..., 0],
        wanted_speed(plants, hover, still),
        hover[:, None].expand(batch, length, 4),
    )


def wanted_speed(plants: Plants, command: Tensor, rate_b: Tensor) -> Tensor:
    """Return the rotor speeds (B, 4) that a command (B, 4) asks for; see `eval.quadrotor.mixer`."""
    most = plants.thrust_max
    spin_b = plants.inertia * rate_b
    torque_b = plants.inertia * plants.rate_gain * (command[:, 1:] - rate_b)
    torque_b = torque_b + torch.linalg.cross(rate_b, spin_b)
    force = plants.nominal_mass * command[:, :1]
    per_force = plants.unmixer[:, 0]
    level = torque_b[:, :2] @ plants.unmixer[:, 1:3].T
    yaw = torque_b[:, 2:] * plants.unmixer[:, 3]
    exact = force * per_force + level + yaw
    outside = ((exact < 0) | (exact > most)).any(-1, keepdim=True)
    spread = level.amax(-1, keepdim=True) - level.amin(-1, keepdim=True)
    level = level * (most / spread.clamp(min=most))
    lowest = (-level / per_force).amax(-1, keepdim=True)
    highest = ((most - level) / per_force).amin(-1, keepdim=True)
    without_yaw = torch.minimum(torch.maximum(force, lowest), highest) * per_force + level
    without_yaw = without_yaw.clamp(0.0, most)
    room = torch.where(yaw > 0, most - without_yaw, without_yaw)
    beyond = yaw.abs() > room.clamp(min=1e-9)
    share = torch.where(beyond, room / torch.where(beyond, yaw.abs(), 1.0), 1.0)
    limited = (without_yaw + share.amin(-1, keepdim=True) * yaw).clamp(0.0, most)
    thrust = torch.where(outside, limited, exact)
    pushes = thrust > NEGLIGIBLE_N
    root = (torch.where(pushes, thrust, 1.0) / plants.thrust_coefficient).sqrt()
    return torch.where(pushes, root, 0.0)


def fly(body: TorchQuadrotor, plants: Plants, command: Tensor, dt: float) -> TorchQuadrotor:
    """Advance one physics step of `dt` [s]; see `eval.quadrotor.stepper.step`."""
    commands = torch.cat([command[:, None], body.commands[:, :-1]], 1)
    acting = (plants.delay_share[..., None] * commands).sum(1)
    wanted = wanted_speed(plants, acting, body.rate_b)
    lags = plants.lag > 0
    left = torch.where(lags, (-dt / torch.where(lags, plants.lag, 1.0)).exp(), 0.0)
    behind, steps = body.rotor_speed - wanted, plants.lag / dt
    square = wanted**2 + 2 * wanted * behind * steps * (1 - left)
    square = square + behind**2 * 0.5 * steps * (1 - left**2)

    thrust = plants.true_coefficient * square
    air_b = to_local(body.rot_w, body.vel_w - plants.wind_w)
    force_b = -plants.mass * plants.drag * air_b
    force_b = torch.cat([force_b[:, :2], force_b[:, 2:] + thrust.sum(-1, keepdim=True)], -1)
    about = [
        plants.arm[..., 1] * thrust,
        -plants.arm[..., 0] * thrust,
        plants.yaw_coefficient * square,
    ]
    torque_b = torch.stack(about, 1).sum(-1) + plants.trim
    torque_b = torque_b - torch.linalg.cross(body.rate_b, plants.inertia * body.rate_b)
    acc_w = to_world(body.rot_w, force_b) / plants.mass - torch.tensor([0.0, 0.0, GRAVITY])
    vel_w = body.vel_w + dt * acc_w
    rate_b = body.rate_b + dt * torque_b / plants.inertia
    return body._replace(
        pos_w=body.pos_w + dt * vel_w,
        vel_w=vel_w,
        rot_w=body.rot_w @ exp_rot(dt * rate_b),
        rate_b=rate_b,
        rotor_speed=wanted + behind * left,
        commands=commands,
    )


def step(
    body: TorchQuadrotor,
    plants: Plants,
    action: Tensor,
    target_w: Tensor,
    cut: Substeps,
    decay: float,
) -> TorchQuadrotor:
    """Advance one policy period; see `suite.train.dynamics.quadrotor.fly_period`."""
    period = cut.attitude * cut.physics * cut.dt
    fade = torch.tensor(-decay * period).exp()
    turn_s = torch.tensor(cut.physics * cut.dt)
    before_w = faded(body.vel_w, fade)
    body = body._replace(
        pos_w=faded(body.pos_w, fade),
        vel_w=before_w,
        rot_w=faded(body.rot_w, fade),
        rate_b=faded(body.rate_b, fade),
    )
    for _ in range(cut.attitude):
        with torch.no_grad():
            heading_w = blend(body.heading_w, target_w - body.pos_w, turn_s)
        body = body._replace(heading_w=heading_w)
        command = asked(plants.gains, body.rot_w, action, heading_w)
        for _ in range(cut.physics):
            body = fly(body, plants, command, cut.dt)
    return body._replace(acc_w=(body.vel_w - before_w) / period)
