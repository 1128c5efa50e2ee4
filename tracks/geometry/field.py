"""The attractive vector field of a gate (Su et al. 2026, Sec. III-C2).

A gate is a closed loop of current along its opening's edge; the magnetic field threads the opening
in flight direction. Any polygon serves; a round gate is a polygon of many edges.
"""

from __future__ import annotations

from tracks.geometry.rotation import to_local, to_world
from tracks.geometry.scene import Array

CURRENT = 2e-5
"""C_I, as the paper has it [m]."""
_TINY = 1e-9


def _norm(vector: Array) -> Array:
    xp = vector.__array_namespace__()
    square = (vector * vector).sum(-1)
    # At zero the root's slope is infinite, and its gradient would be NaN.
    some = square > 0.0
    return xp.where(some, xp.sqrt(xp.where(some, square, 1.0)), 0.0)


def _unit(vector: Array) -> Array:
    xp = vector.__array_namespace__()
    return vector / xp.maximum(_norm(vector), _TINY)[..., None]


def magnetic_field(
    center_w: Array, rot_w: Array, opening_g: Array, point_w: Array, current: float = CURRENT
) -> Array:
    """Return the field B (..., 3) at point_w in the world frame (Eq. mag_segment, mag_total).

    The paper's "shortest vector to the wire segment" is taken as the perpendicular to the line
    through it: only then does the sum satisfy Biot and Savart and have no divergence.

    Args:
        center_w: (..., 3) opening's centre [m].
        rot_w: (..., 3, 3) gate to world.
        opening_g: (..., V, 2) corners (y, z), counter-clockwise seen along -x; repeated corners
            add nothing.
        point_w: (..., 3) [m].
        current: C_I; the field scales with it [m].
    """
    xp = point_w.__array_namespace__()
    point_g = to_local(rot_w, point_w - center_w)
    corners = xp.concatenate([xp.zeros_like(opening_g[..., :1]), opening_g], axis=-1)
    start = corners - point_g[..., None, :]
    end = xp.roll(corners, -1, axis=-2) - point_g[..., None, :]
    unit = _unit(end - start)
    ends = _unit(start) - _unit(end)
    perpendicular = start - (start * unit).sum(-1)[..., None] * unit
    # On the wire itself the field is undefined; a distance of a micrometre keeps it finite.
    square = xp.maximum((perpendicular * perpendicular).sum(-1), 1e-12)
    strength = current * (unit * ends).sum(-1) / square
    field_g = (strength[..., None] * xp.linalg.cross(unit, perpendicular)).sum(-2)
    return to_world(rot_w, field_g)


def attractive_field(
    field_w: Array, vel_w: Array, decay: float = 0.3, epsilon: float = 1e-5
) -> Array:
    """Return u_A (..., 3) from the magnetic field and the velocity (Eq. u_a_cal).

    Args:
        field_w: (..., 3) from `magnetic_field`.
        vel_w: (..., 3) [m/s].
        decay: lambda_A in (0, 1): how far |B| is flattened.
        epsilon: keeps the alignment finite at rest.
    """
    xp = field_w.__array_namespace__()
    size = _norm(field_w)
    aligned = (vel_w * field_w).sum(-1) / (_norm(vel_w) * size + epsilon)
    return ((1 - aligned) / xp.maximum(size, _TINY) ** decay)[..., None] * field_w
