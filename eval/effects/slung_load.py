"""A load that swings on a line under the centre of mass.

The load is a point without drag and without contacts; the line has no mass, pulls and never pushes.
It is a stiff spring with a damper, whose tension is the one at the end of the step (backward Euler,
so that no step is too long for it). Its motion is computed relative to the vehicle, from the
vehicle's acceleration, so that single precision is enough also far from the world's origin.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis
from tracks.geometry.rotation import to_local

STIFFNESS = 100.0
"""Angular frequency w at which vehicle and load would bounce along the line [rad/s]: under its
weight a light load stretches the line by g / w^2, a millimetre."""
DAMPING = 0.5
"""Damping ratio z of that bouncing [1]."""


class SlungLoad(NamedTuple):
    """Values of `slung_load`."""

    mass: Array
    """(...,) m_L: mass of the load [kg]."""
    length: Array
    """(...,) length of the line at rest, L [m]."""


class LoadState(NamedTuple):
    """State of the load between steps."""

    line_w: Array
    """(..., 3) from the centre of mass to the load, r [m]."""
    vel_w: Array
    """(..., 3) of the load relative to the centre of mass, u [m/s]."""


def start_of(values: SlungLoad, flow: Flow) -> LoadState:
    """Return a load that hangs at rest straight below the vehicle, along gravity."""
    xp = flow.rate_b.__array_namespace__()
    gravity_w = flow.constants.gravity_w + xp.zeros_like(flow.rate_b)
    size = xp.sqrt(xp.sum(gravity_w**2, axis=-1, keepdims=True))
    # The line stretches until T = m_L g; T (1 / m_L + 1 / M) is the relative acceleration by it.
    stretch = size / _share(values, flow) * _lag(flow) / STIFFNESS**2
    return LoadState(
        (per_axis(values.length) + stretch) * gravity_w / size, xp.zeros_like(flow.rate_b)
    )


def force_of(values: SlungLoad, flow: Flow) -> Array:
    """Return the line's pull on the vehicle, body axes (..., 3) [N]."""
    along_w, parting = _pull(values, flow)
    return to_local(flow.rot_w, per_axis(values.mass) * _share(values, flow) * parting * along_w)


def carried(values: SlungLoad, flow: Flow, acc_w: Array) -> LoadState:
    """Return the load after the step, by semi-implicit Euler as the body's own."""
    along_w, parting = _pull(values, flow)
    load_acc_w = flow.constants.gravity_w - _share(values, flow) * parting * along_w
    vel_w = flow.memory.vel_w + flow.dt * (load_acc_w - acc_w)
    return LoadState(flow.memory.line_w + flow.dt * vel_w, vel_w)


def _pull(values: SlungLoad, flow: Flow) -> tuple[Array, Array]:
    """Return the unit vector to the load (..., 3), and how the line parts them (..., 1) [m/s^2].

    The latter is the relative acceleration along the line that its tension takes away.
    """
    line_w, vel_w = flow.memory
    xp = line_w.__array_namespace__()
    squared = xp.sum(line_w**2, axis=-1, keepdims=True)
    # A load in the centre of mass has no direction, and the root there no slope.
    apart = squared > 0.0
    length = xp.sqrt(xp.where(apart, squared, 1.0))
    along_w = line_w / length
    speed = xp.sum(along_w * vel_w, axis=-1, keepdims=True)
    stretch = xp.where(apart, length, 0.0) - per_axis(values.length) + flow.dt * speed
    wanted = STIFFNESS**2 * stretch + 2.0 * DAMPING * STIFFNESS * speed
    return along_w, xp.where((stretch > 0.0) & (wanted > 0.0), wanted, 0.0) / _lag(flow)


def _share(values: SlungLoad, flow: Flow) -> Array:
    """Return the vehicle's share M / (M + m_L) of both masses, (..., 1)."""
    mass = flow.constants.mass
    return per_axis(mass / (mass + values.mass))


def _lag(flow: Flow) -> Array:
    """Return the ratio of an explicit tension to the implicit one at the end of a step of h.

    With x'' = -a and a = w^2 x + 2 z w x' at the end of the step (backward Euler) it is
    1 + 2 z w h + w^2 h^2.
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
        Parameter("length", "m", neutral=0.5, low=0.05, high=20.0, typical=(0.3, 1.0)),
    ),
    force=force_of,
    start=start_of,
    carry=carried,
)
