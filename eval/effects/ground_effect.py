"""Rotors push harder close above the ground."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis

LARGEST = 1.0 / 3.0
"""Largest g (r / 4 z)^2: caps the factor on the thrust at 1.5."""
LOWEST = 1e-3
"""Heights below this count as this [m]: a rotor does not fly below the ground."""


class GroundEffect(NamedTuple):
    """Values of `ground_effect`."""

    strength: Array
    """(...,) g; 1 is Cheeseman and Bennett's rotor [1]."""
    rotor_radius: Array
    """(...,) r [m]."""


def thrust_of(values: GroundEffect, flow: Flow, thrust: Array) -> Array:
    """Return the thrusts (..., 4) [N] times 1 / (1 - g (r / 4 z_i)^2), the factor at most 1.5.

    z_i is the height of each rotor's hub above z = 0.
    """
    xp = thrust.__array_namespace__()
    lift_w = (flow.rot_w[..., None, 2, :] * flow.constants.rotor_position_b).sum(axis=-1)
    height = xp.maximum(flow.pos_w[..., 2, None] + lift_w, LOWEST)
    share = per_axis(values.strength) * (per_axis(values.rotor_radius) / (4.0 * height)) ** 2
    return thrust / (1.0 - xp.minimum(share, LARGEST))


EFFECT = Effect(
    name="ground_effect",
    summary="More thrust close above the ground",
    equation="rotor thrust x 1 / (1 - g (r / 4 z_i)^2), at most 1.5",
    source="Cheeseman and Bennett 1955, ARC R&M 3021",
    values=GroundEffect,
    parameters=(
        Parameter(
            name="strength",
            unit="1",
            neutral=0.0,
            low=0.0,
            high=20.0,
            typical=(1.0, 8.0),
        ),
        Parameter(
            name="rotor_radius",
            unit="m",
            neutral=0.0635,
            low=0.005,
            high=1.0,
            typical=(0.03, 0.1),
            required=False,
            fitted=False,
        ),
    ),
    thrust=thrust_of,
)
