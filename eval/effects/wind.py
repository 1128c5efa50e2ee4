"""Effects of wind: a constant wind and gusts. They act through effects that use the airspeed."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Gust, Parameter, per_axis


class ConstantWind(NamedTuple):
    """Values of `constant_wind`."""

    velocity: Array
    """(..., 3) velocity of the air in the world [m/s]."""


CONSTANT_WIND = Effect(
    name="constant_wind",
    summary="Steady wind; acts through the effects that use the airspeed",
    equation="v_b = R^T (v_w - velocity)",
    source="definition",
    values=ConstantWind,
    parameters=(
        Parameter(
            "velocity",
            "m/s",
            neutral=0.0,
            low=-30.0,
            high=30.0,
            typical=(1.0, 5.0),
            size=3,
            direction=(-0.6, 0.8, 0.0),
        ),
    ),
    wind=lambda values, gust: values.velocity,
)


VERTICAL = 0.5
"""Ratio of the vertical intensity of gusts to the horizontal intensity."""


class Gusts(NamedTuple):
    """Values of `gusts`."""

    intensity: Array
    """(...,) standard deviation of the horizontal wind components [m/s]."""
    length: Array
    """(...,) distance through the air over which the wind changes [m]."""


def gusts_start(values: Gusts, noise: Array) -> Array:
    """Return a random wind (..., 3) [m/s] with the stationary distribution.

    `noise` (..., 3) are standard normal random numbers.
    """
    xp = noise.__array_namespace__()
    return per_axis(values.intensity) * xp.asarray([1.0, 1.0, VERTICAL]) * noise


def gusts_wind(values: Gusts, gust: Gust) -> Array:
    """Return the wind of this step (..., 3) [m/s], exact for a constant airspeed.

    Without noise there are no gusts, whatever the previous wind.
    """
    xp = gust.velocity_w.__array_namespace__()
    if gust.noise is None:
        return xp.zeros_like(gust.velocity_w)
    airspeed = xp.sqrt(xp.maximum(xp.sum(gust.air_vel_w**2, axis=-1), 1.0))
    # A first-order autoregressive process with a constant variance.
    correlation = per_axis(xp.exp(-gust.dt * airspeed / values.length))
    innovation = xp.sqrt(1.0 - correlation**2)
    return correlation * gust.velocity_w + innovation * gusts_start(values, gust.noise)


GUSTS = Effect(
    name="gusts",
    summary="Random wind, coloured; half as strong vertically",
    equation="wind: dw/dt = -w/tau + white noise, tau = length / max(airspeed, 1)",
    source="after the Dryden model, MIL-F-8785C",
    values=Gusts,
    parameters=(
        Parameter("intensity", "m/s", neutral=0.0, low=0.0, high=10.0, typical=(0.5, 2.0)),
        Parameter(
            "length", "m", neutral=5.0, low=0.1, high=1000.0, typical=(2.0, 10.0), whole=True
        ),
    ),
    wind=gusts_wind,
    gust=gusts_start,
)
