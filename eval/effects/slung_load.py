"""The effect of a load that swings on a line under the centre of mass.

The load is a point without drag and contacts; the line has no mass and only pulls. The line is a
stiff spring with a damper, whose tension is that at the end of the step (backward Euler, which is
stable for every step length). The load's motion is computed relative to the vehicle, from the
vehicle's acceleration, so float32 is precise enough even far from the world's origin.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis
from tracks.geometry.rotation import to_local

STIFFNESS = 100.0
"""Angular frequency w of the oscillation along the line [rad/s]. The weight of a light load
stretches the line by g / w^2, which is a millimetre."""
DAMPING = 0.5
"""Damping ratio z of the oscillation along the line."""


class SlungLoad(NamedTuple):
    """Values of `slung_load`."""

    mass: Array
    """(...,) m_L: mass of the load [kg]."""
    length: Array
    """(...,) L: length of the line at rest [m]."""


class LoadState(NamedTuple):
    """State of the load between steps."""

    line_w: Array
    """(..., 3) position of the load relative to the centre of mass [m]."""
    vel_w: Array
    """(..., 3) velocity of the load relative to the centre of mass [m/s]."""


def start_of(values: SlungLoad, flow: Flow) -> LoadState:
    """Return the state of a load that hangs at rest below the vehicle, along gravity."""
    xp = flow.rate_b.__array_namespace__()
    gravity_w = flow.constants.gravity_w + xp.zeros_like(flow.rate_b)
    gravity_size = xp.sqrt(xp.sum(gravity_w**2, axis=-1, keepdims=True))
    # In equilibrium the tension is m_L g, that is, a relative acceleration of g / mass share.
    stretch = gravity_size / _mass_share(values, flow) * _implicit_factor(flow) / STIFFNESS**2
    return LoadState(
        (per_axis(values.length) + stretch) * gravity_w / gravity_size, xp.zeros_like(flow.rate_b)
    )


def force_of(values: SlungLoad, flow: Flow) -> Array:
    """Return the line's force on the vehicle, body axes (..., 3) [N]."""
    along_w, relative_acc = _tension(values, flow)
    tension = per_axis(values.mass) * _mass_share(values, flow) * relative_acc
    return to_local(flow.rot_w, tension * along_w)


def carried(values: SlungLoad, flow: Flow, acc_w: Array) -> LoadState:
    """Return the load's state after the step, by semi-implicit Euler as for the body."""
    along_w, relative_acc = _tension(values, flow)
    load_acc_w = flow.constants.gravity_w - _mass_share(values, flow) * relative_acc * along_w
    vel_w = flow.memory.vel_w + flow.dt * (load_acc_w - acc_w)
    return LoadState(flow.memory.line_w + flow.dt * vel_w, vel_w)


def _tension(values: SlungLoad, flow: Flow) -> tuple[Array, Array]:
    """Return the unit vector to the load (..., 3), and an acceleration (..., 1) [m/s^2].

    The acceleration is T (1 / m_L + 1 / M): by the line's tension T, load (mass m_L) and vehicle
    (mass M) accelerate towards each other.
    """
    line_w, vel_w = flow.memory
    xp = line_w.__array_namespace__()
    squared = xp.sum(line_w**2, axis=-1, keepdims=True)
    # For a load at the centre of mass, the direction and the root's slope are undefined.
    has_direction = squared > 0.0
    length = xp.sqrt(xp.where(has_direction, squared, 1.0))
    along_w = line_w / length
    speed = xp.sum(along_w * vel_w, axis=-1, keepdims=True)
    stretch = xp.where(has_direction, length, 0.0) - per_axis(values.length) + flow.dt * speed
    spring = STIFFNESS**2 * stretch + 2.0 * DAMPING * STIFFNESS * speed
    pulls = (stretch > 0.0) & (spring > 0.0)
    return along_w, xp.where(pulls, spring, 0.0) / _implicit_factor(flow)


def _mass_share(values: SlungLoad, flow: Flow) -> Array:
    """Return the vehicle's share M / (M + m_L) of the total mass, (..., 1)."""
    mass = flow.constants.mass
    return per_axis(mass / (mass + values.mass))


def _implicit_factor(flow: Flow) -> Array:
    """Return the ratio of the explicit tension to the implicit tension, for a step of length h.

    The implicit tension is that at the end of the step (backward Euler). With x'' = -a and
    a = w^2 x + 2 z w x', the ratio is 1 + 2 z w h + w^2 h^2.
    """
    return 1.0 + 2.0 * DAMPING * STIFFNESS * flow.dt + (STIFFNESS * flow.dt) ** 2


SLUNG_LOAD = Effect(
    name="slung_load",
    summary="A load swings on a line under the centre of mass",
    equation="F_w += T q, m_L dv_L/dt = m_L g - T q; q to the load, T >= 0 holds the line's length",
    source="point mass on a line that only pulls; Sreenath, Michael and Kumar 2013",
    values=SlungLoad,
    parameters=(
        Parameter(
            "mass",
            "kg",
            neutral=0.0,
            low=0.0,
            high=lambda vehicle: vehicle.mass,
            typical=(0.02, 0.1),
        ),
        Parameter("length", "m", neutral=0.5, low=0.05, high=20.0, typical=(0.3, 1.0), whole=True),
    ),
    force=force_of,
    start=start_of,
    carry=carried,
)
