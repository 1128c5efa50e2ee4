"""The attractive vector field of a gate, which guides a policy in training (Su et al. 2026).

The edge of a gate's opening is taken as a closed loop of electric current (Sec. III-C2). Its
magnetic field passes through the opening in flight direction. The opening may be any polygon; a
round gate is a polygon of many edges.
"""

from __future__ import annotations

from tracks.geometry.rotation import to_local, to_world
from tracks.geometry.scene import Array

CURRENT = 2e-5
"""Constant C_I of Su et al. 2026, by which the field is scaled [m]."""
_TINY = 1e-9
"""Least divisor, so that no division is by zero."""
_WIRE_SQUARED_M2 = 1e-12
"""Least squared distance from the loop: at the loop itself the field is infinite [m^2]."""


def _norm(vector: Array) -> Array:
    """Return the norms of vectors, with a gradient of zero at zero."""
    xp = vector.__array_namespace__()
    square = (vector * vector).sum(-1)
    # At zero the root's slope is infinite, and its gradient would be NaN.
    nonzero = square > 0.0
    return xp.where(nonzero, xp.sqrt(xp.where(nonzero, square, 1.0)), 0.0)


def _unit(vector: Array) -> Array:
    xp = vector.__array_namespace__()
    return vector / xp.maximum(_norm(vector), _TINY)[..., None]


def magnetic_field(
    center_w: Array, rot_w: Array, opening_g: Array, point_w: Array, current: float = CURRENT
) -> Array:
    """Return the field B (..., 3) at point_w in world axes: the sum over the opening's sides.

    The "shortest vector to the wire segment" of Su et al. 2026 is taken as the perpendicular to the
    line through the segment. Only then the sum satisfies the Biot-Savart law and has no divergence.

    Args:
        center_w: (..., 3) opening's centre [m].
        rot_w: (..., 3, 3) gate to world.
        opening_g: (..., V, 2) corners (y, z), counter-clockwise seen along -x [m]; repeated corners
            add nothing.
        point_w: (..., 3) the point [m].
        current: factor C_I on the field [m].
    """
    xp = point_w.__array_namespace__()
    point_g = to_local(rot_w, point_w - center_w)
    corners = xp.concatenate([xp.zeros_like(opening_g[..., :1]), opening_g], axis=-1)
    start = corners - point_g[..., None, :]
    end = xp.roll(corners, -1, axis=-2) - point_g[..., None, :]
    unit = _unit(end - start)
    ends = _unit(start) - _unit(end)
    perpendicular = start - (start * unit).sum(-1)[..., None] * unit
    square = xp.maximum((perpendicular * perpendicular).sum(-1), _WIRE_SQUARED_M2)
    strength = current * (unit * ends).sum(-1) / square
    field_g = (strength[..., None] * xp.linalg.cross(unit, perpendicular)).sum(-2)
    return to_world(rot_w, field_g)


def attractive_field(
    field_w: Array, vel_w: Array, decay: float = 0.3, epsilon: float = 1e-5
) -> Array:
    """Return the attractive field u_A (..., 3) in world axes (Su et al. 2026, Sec. III-C2).

    It has the direction of the magnetic field B. Its magnitude is 0 where the velocity is along B,
    and largest where the velocity is opposite to B.

    Args:
        field_w: (..., 3) the field B, from `magnetic_field`.
        vel_w: (..., 3) velocity [m/s].
        decay: lambda_A in (0, 1): |B| is raised to the power 1 - decay.
        epsilon: number that is added to the denominator of the alignment, which is 0 at rest.
    """
    xp = field_w.__array_namespace__()
    size = _norm(field_w)
    aligned = (vel_w * field_w).sum(-1) / (_norm(vel_w) * size + epsilon)
    return ((1 - aligned) / xp.maximum(size, _TINY) ** decay)[..., None] * field_w
