"""A fleet: quadrotors of a class, drawn anew for every world from a stated distribution.

The class is the racing quadrotor of a few hundred grams to a kilogram, whatever its make: the
ranges below are what such vehicles have, and no vehicle file is read. `reduced.py` flies them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from tracks.geometry.scene import Array
from tracks.input.ranges import Range, Share

Span = tuple[float, float]
"""Lower and upper end of a uniform distribution."""


@dataclass(frozen=True)
class FleetConfig:
    """The distribution of quadrotors; spans are drawn from uniformly, each on its own.

    "Nominal" is what a vehicle's controller believes. Images' noise and field of view are those of
    `PointMassConfig`.
    """

    attitude_hz: Annotated[float, Range(1.0, 10_000.0)] = 60.0
    """About how often the attitude loop runs and the body is stepped: a whole number of times a
    policy period [Hz]."""
    thrust_to_weight: Annotated[Span, Range(1.0, 100.0, ordered=True, above=True)] = (2.5, 5.0)
    """Nominal largest collective thrust over the nominal weight [1]."""
    fault_share: Share = 0.5
    """Share of vehicles that are not what their controller believes: mass, thrust, inertia, centre
    of mass and trim are off in these alone."""
    mass_scale: Annotated[Span, Range(0.1, 10.0, ordered=True)] = (0.92, 1.2)
    """True mass over the nominal one: a battery or a camera that nobody told the controller of
    [1]."""
    thrust_scale: Annotated[Span, Range(0.1, 10.0, ordered=True)] = (0.85, 1.08)
    """True thrust over the nominal one: worn propellers, an emptying battery [1]."""
    inertia_scale: Annotated[Span, Range(0.1, 10.0, ordered=True)] = (0.8, 1.25)
    """True moment of inertia over the nominal one, on each axis [1]."""
    gyration_m: Annotated[Span, Range(1e-3, 10.0, ordered=True)] = (0.045, 0.07)
    """Radius of gyration about x and y [m]."""
    rotor_lag_s: Annotated[Span, Range(1e-3, 0.5, ordered=True)] = (0.01, 0.06)
    """Time constant of the rotors' speed [s]."""
    delay_s: Annotated[Span, Range(0.0, 0.2, ordered=True)] = (0.0, 0.06)
    """By how much commands of the attitude loop act late [s]."""
    rate_gain: Annotated[Span, Range(0.1, 1000.0, ordered=True)] = (12.0, 28.0)
    """Gain of the rate loop about x and y, the same for both; about z it is 0.4 times as large
    [1/s]."""
    integral_share: Share = 0.3
    """Share of vehicles whose rate loop has an integrator, as flight controllers' have; those of
    the others are proportional and leave an error under a constant torque."""
    integral: Annotated[Span, Range(0.0, 100.0, ordered=True)] = (1.0, 4.0)
    """Gain of the integrator over that of the rate loop [1/s]."""
    attitude_gain: Annotated[Span, Range(0.1, 100.0, ordered=True)] = (7.0, 9.5)
    """Body rate per tilt error; per heading error half as much [1/s]."""
    rate_max: Annotated[Span, Range(0.1, 100.0, ordered=True)] = (5.0, 8.0)
    """Largest body rate that is asked for [rad/s]."""
    turn_max: Annotated[Span, Range(1.0, 1e4, ordered=True)] = (150.0, 600.0)
    """Largest angular acceleration about x and y that the mixer asks for [rad/s^2]."""
    yaw_turn_max: Annotated[Span, Range(1.0, 1e4, ordered=True)] = (15.0, 60.0)
    """The same about z [rad/s^2]."""
    com_offset_m: Annotated[float, Range(0.0, 0.1)] = 0.004
    """Standard deviation of the centre of mass along x and along y, cut off at twice that [m]."""
    trim: Annotated[float, Range(0.0, 1000.0)] = 5.0
    """Standard deviation of a constant torque over the inertia on each axis, cut off at twice that;
    about z a fifth of it [rad/s^2]."""
    drag: Annotated[Span, Range(0.0, 100.0, ordered=True)] = (0.05, 0.6)
    """Linear drag along the body's x and y [1/s]."""
    drag_up: Annotated[Span, Range(0.0, 100.0, ordered=True)] = (0.05, 1.4)
    """Linear drag along the body's z [1/s]."""
    quadratic: Annotated[Span, Range(0.0, 10.0, ordered=True)] = (0.0, 0.03)
    """Quadratic drag along the body's x and y [1/m]."""
    quadratic_up: Annotated[Span, Range(0.0, 10.0, ordered=True)] = (0.0, 0.09)
    """Quadratic drag along the body's z [1/m]."""
    wind_std: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind [m/s]."""
    time_step_std: Annotated[float, Range(0.0, 0.25)] = 0.03
    """Standard deviation of the policy's period over worlds, as a share of it [1]."""
    state_latency_s: Annotated[Span, Range(0.0, 0.2, ordered=True)] = (0.0, 0.02)
    """Age of the state that the policy sees [s]."""
    image_latency_s: Annotated[Span, Range(0.0, 0.2, ordered=True)] = (0.0, 0.03)
    """Age of the image that the policy sees [s]."""
    vel_noise: Annotated[float, Range(0.0, 10.0)] = 0.05
    """Standard deviation of the white noise on each number of the velocity that the policy sees
    [m/s]."""
    axis_noise: Annotated[float, Range(0.0, 1.0)] = 0.01
    """The same on each number of a direction [1]."""
    gate_noise_m: Annotated[float, Range(0.0, 10.0)] = 0.02
    """The same on each coordinate of a gate [m]."""


class Vehicles(NamedTuple):
    """Quadrotors of a class as physical quantities, (B,) or (B, 3) each."""

    time_step: Array
    """(B,) the policy's period [s]."""
    thrust_max: Array
    """(B,) largest collective thrust that is asked for, per nominal mass [m/s^2]."""
    force_scale: Array
    """(B,) true acceleration per nominal thrust per mass [1]."""
    rotor_lag: Array
    """(B,) [s]."""
    delay: Array
    """(B,) of commands [s]."""
    rate_gain: Array
    """(B, 3) true angular acceleration per rate error [1/s]."""
    integral_gain: Array
    """(B, 3) the same per integrated rate error [1/s^2]; 0: none."""
    attitude_gain: Array
    """(B, 3) [1/s]."""
    rate_max: Array
    """(B, 3) [rad/s]."""
    turn_max: Array
    """(B, 3) [rad/s^2]."""
    turn_by_thrust: Array
    """(B, 3) angular acceleration per thrust per mass, of a centre of mass off the thrust
    [1/m]."""
    trim: Array
    """(B, 3) constant angular acceleration [rad/s^2]."""
    drag: Array
    """(B, 3) linear, body axes [1/s]."""
    quadratic: Array
    """(B, 3) quadratic, body axes [1/m]."""
    wind_w: Array
    """(B, 3) [m/s]."""
    state_latency: Array
    """(B,) [s]."""
    image_latency: Array
    """(B,) [s]."""


YAW_GAIN, YAW_ATTITUDE = 0.4, 0.5
"""Gains of rate and attitude about z over those about x and y."""
TRIM_AXES = (1.0, 1.0, 0.2)
"""A constant torque about x, y and z as shares of that about x."""


def cut_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return normal draws that are cut off at twice their deviation of 1."""
    return np.clip(rng.standard_normal(shape), -2.0, 2.0)


def draw_vehicles(
    config: FleetConfig, period_s: float, batch: int, rng: np.random.Generator
) -> Vehicles:
    """Return `batch` quadrotors for a policy that decides every `period_s` [s]."""

    def drawn(span: Span, *shape: int) -> np.ndarray:
        return rng.uniform(*span, (batch, *shape))

    def normal(std: float, *shape: int) -> np.ndarray:
        return std * cut_normal(rng, batch, *shape)

    def axes(level: np.ndarray, up: np.ndarray) -> np.ndarray:
        return np.stack([level, level, up], -1)

    faulty = rng.uniform(size=batch) < config.fault_share

    def off(value: np.ndarray, neutral: float) -> np.ndarray:
        return np.where(faulty.reshape(-1, *[1] * (value.ndim - 1)), value, neutral)

    inertia = off(drawn(config.inertia_scale, 3), 1.0)
    rate_gain, attitude_gain = drawn(config.rate_gain), drawn(config.attitude_gain)
    integrates = rng.uniform(size=batch) < config.integral_share
    integral = drawn(config.integral) * integrates
    thrust, mass = off(drawn(config.thrust_scale), 1.0), off(drawn(config.mass_scale), 1.0)
    # Rotors that push less turn the body less about x and y; what yaws is their drag.
    agile = axes(thrust, np.ones(batch)) / inertia
    rate_gain = agile * axes(rate_gain, YAW_GAIN * rate_gain)
    # A force F at the distance d from the centre of mass turns by m d x F / J = d x F / (m k^2).
    radius = drawn(config.gyration_m)
    com = off(normal(config.com_offset_m, 2), 0.0)
    lever = np.stack([-com[:, 1], com[:, 0], np.zeros(batch)], -1) / (radius**2)[:, None]
    trim = off(normal(config.trim, 3), 0.0) * TRIM_AXES
    return Vehicles(
        time_step=period_s * (1 + normal(config.time_step_std)),
        thrust_max=GRAVITY * drawn(config.thrust_to_weight),
        force_scale=thrust / mass,
        rotor_lag=drawn(config.rotor_lag_s),
        delay=drawn(config.delay_s),
        rate_gain=rate_gain,
        integral_gain=rate_gain * integral[:, None],
        attitude_gain=axes(attitude_gain, YAW_ATTITUDE * attitude_gain),
        rate_max=np.repeat(drawn(config.rate_max)[:, None], 3, 1),
        turn_max=agile * axes(drawn(config.turn_max), drawn(config.yaw_turn_max)),
        turn_by_thrust=lever,
        trim=trim,
        drag=np.concatenate([drawn(config.drag, 2), drawn(config.drag_up, 1)], -1),
        quadratic=np.concatenate([drawn(config.quadratic, 2), drawn(config.quadratic_up, 1)], -1),
        wind_w=rng.standard_normal((batch, 3)) * np.asarray(config.wind_std),
        state_latency=drawn(config.state_latency_s),
        image_latency=drawn(config.image_latency_s),
    )
