"""Turbulence: zero-mean wind, coloured to first order, on top of the mean wind."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Gust, Parameter, per_axis

VERTICAL = 0.5
"""Vertical intensity over the horizontal one [1]."""


class Gusts(NamedTuple):
    """Values of `gusts`."""

    intensity: Array
    """(...,) standard deviation of the horizontal wind components [m/s]."""
    length: Array
    """(...,) over which the wind changes [m]."""


def start_of(values: Gusts, noise: Array) -> Array:
    """Return a stationary draw of the wind (..., 3) [m/s] from normal draws `noise` (..., 3)."""
    xp = noise.__array_namespace__()
    return per_axis(values.intensity) * xp.asarray([1.0, 1.0, VERTICAL]) * noise


def wind_of(values: Gusts, gust: Gust) -> Array:
    """Return the wind of this step (..., 3) [m/s], exact for a constant airspeed.

    Without noise there are no gusts: the wind that was there is forgotten.
    """
    xp = gust.velocity_w.__array_namespace__()
    if gust.noise is None:
        return xp.zeros_like(gust.velocity_w)
    airspeed = xp.sqrt(xp.maximum(xp.sum(gust.air_vel_w**2, axis=-1), 1.0))
    kept = per_axis(xp.exp(-gust.dt * airspeed / values.length))
    fresh = xp.sqrt(1.0 - kept**2)
    return kept * gust.velocity_w + fresh * start_of(values, gust.noise)


EFFECT = Effect(
    name="gusts",
    summary="Random wind, coloured; half as strong vertically",
    equation="wind: dw/dt = -w/tau + white noise, tau = length / max(airspeed, 1)",
    source="after the Dryden model, MIL-F-8785C",
    values=Gusts,
    parameters=(
        Parameter(
            name="intensity",
            unit="m/s",
            neutral=0.0,
            low=0.0,
            high=10.0,
            typical=(0.5, 2.0),
        ),
        Parameter(
            name="length",
            unit="m",
            neutral=5.0,
            low=0.1,
            high=1000.0,
            typical=(2.0, 10.0),
        ),
    ),
    wind=wind_of,
    gust=start_of,
)
