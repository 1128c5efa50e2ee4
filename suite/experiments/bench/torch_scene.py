"""Scene geometry in plain batched torch, for the baseline of the benchmark `train`.

It computes depth images, distances to obstacles, the magnetic field and gate crossings. Every
function evaluates all solids at once, without gradients and without optimisation. In the shapes, B
is the number of worlds, R of rays and S of points. Most arrays are (worlds, solids, rays or
points). A ray is origin + t direction; `speed` is the change of a coordinate per ray length t.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tracks.geometry.scene import Gates, Scene

FAR, TINY = 1e9, 1e-12
"""Depth of a ray that hits nothing [m], and the lower limit of divisors."""


def to_world(rot_w: Tensor, vector: Tensor) -> Tensor:
    """Return local vectors (..., 3) in world axes."""
    return (rot_w @ vector[..., None])[..., 0]


def to_local(rot_w: Tensor, vector_w: Tensor) -> Tensor:
    """Return world vectors (..., 3) in local axes."""
    return (rot_w.transpose(-1, -2) @ vector_w[..., None])[..., 0]


def _slab(origin: Tensor, speed: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ray lengths t at which |origin + speed t| falls below `half` and exceeds it again.

    A slab is the space between two parallel planes, such as two opposite faces of a box.
    """
    inverse = 1.0 / torch.where(speed.abs() < TINY, torch.full_like(speed, TINY), speed)
    middle, spread = -origin * inverse, half * inverse.abs()
    return middle - spread, middle + spread


def _quadratic(square: Tensor, cross: Tensor, excess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two roots t of square t^2 + 2 cross t + excess = 0; FAR and -FAR without roots."""
    discriminant = cross * cross - square * excess
    root, inverse = discriminant.clamp(min=0).sqrt(), 1.0 / square.clamp(min=TINY)
    missed = discriminant < 0
    enter = ((-cross - root) * inverse).masked_fill(missed, FAR)
    return enter, ((-cross + root) * inverse).masked_fill(missed, -FAR)


def _entry(enter: Tensor, leave: Tensor) -> Tensor:
    """Return the ray length at which a ray enters the first solid; FAR if it hits none."""
    hit = (enter <= leave) & (leave > 0)
    return enter.clamp(min=0).masked_fill(~hit, FAR).amin(1)


def _sphere(origin: Tensor, radius: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ray lengths at which spheres are entered and left."""
    excess = (origin * origin).sum(-1) - radius * radius
    return _quadratic((rays * rays).sum(-1), origin @ rays.T, excess[..., None])


def _cylinder(rods: Any, origin: Tensor, axis: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ray lengths at which cylinders of finite length are entered and left."""
    along, speed = (origin * axis).sum(-1)[..., None], axis @ rays.T
    square = (rays * rays).sum(-1) - speed * speed
    excess = (origin * origin).sum(-1) - along[..., 0] ** 2 - rods.radius**2
    enter, leave = _quadratic(square, origin @ rays.T - along * speed, excess[..., None])
    near, far = _slab(along, speed, rods.half_length[..., None])
    return torch.maximum(enter, near), torch.minimum(leave, far)


@torch.no_grad()
def depth_image(scene: Scene, pos_w: Tensor, rot_w: Tensor, rays: Tensor, reach: float) -> Tensor:
    """Return the depth along the camera's axis for each ray, (B, R), at most `reach` [m].

    See `tracks.geometry.depth.depth_image`, which also leaves out solids that no ray can hit.
    """
    # The ground, the plane z = 0.
    upward_speed = rot_w[:, 2] @ rays.T
    hits = [
        torch.where(upward_speed < -TINY, -pos_w[:, 2:] / upward_speed.clamp(max=-TINY), FAR).clamp(
            min=0
        )
    ]

    boxes = scene.boxes
    origin = to_local(boxes.rot_w, pos_w[:, None] - boxes.center_w)[..., None]
    speed = boxes.rot_w.transpose(-1, -2) @ rot_w[:, None] @ rays.T
    near, far = _slab(origin, speed, boxes.half_size[..., None])
    hits.append(_entry(near.amax(2), far.amin(2)))
    for rods, has_flat_ends in ((scene.cylinders, True), (scene.capsules, False)):
        origin, axis = (pos_w[:, None] - rods.center_w) @ rot_w, rods.axis_w @ rot_w
        hits.append(_entry(*_cylinder(rods, origin, axis, rays)))
        if not has_flat_ends:
            for sign in (-1.0, 1.0):
                end = origin + sign * axis * rods.half_length[..., None]
                hits.append(_entry(*_sphere(end, rods.radius, rays)))
    origin = (pos_w[:, None] - scene.spheres.center_w) @ rot_w
    hits.append(_entry(*_sphere(origin, scene.spheres.radius, rays)))
    return torch.stack(hits).amin(0).clamp(max=reach)


def _unit(vector: Tensor) -> Tensor:
    """Return vectors scaled to length 1; a zero vector stays zero."""
    return vector / vector.norm(dim=-1, keepdim=True).clamp(min=1e-9)


@torch.no_grad()
def nearest_obstacle(scene: Scene, point_w: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance from each point to the nearest solid, and the direction away from it.

    Returns:
        (B, S) signed distance, negative within a solid [m], and (B, S, 3) direction.
    """
    points = point_w[:, :, None]

    # Boxes.
    boxes = scene.boxes
    rot = boxes.rot_w[:, None]
    local = to_local(rot, points - boxes.center_w[:, None])
    beyond = local.abs() - boxes.half_size[:, None]
    outside, deepest = beyond.clamp(min=0), beyond.amax(-1)
    inside = (deepest < 0)[..., None]
    push = torch.where(inside, (beyond >= deepest[..., None]).float(), outside)
    away = [to_world(rot, _unit(push * torch.where(local < 0, -1.0, 1.0)))]
    distance = [torch.where(deepest < 0, deepest, outside.norm(dim=-1))]

    # Cylinders: nearest is the side, an end or the edge between them.
    rods = scene.cylinders
    axis = rods.axis_w[:, None]
    from_center = points - rods.center_w[:, None]
    along = (from_center * axis).sum(-1)
    radial = from_center - along[..., None] * axis
    side = radial.norm(dim=-1) - rods.radius[:, None]
    end = along.abs() - rods.half_length[:, None]
    endward = axis * torch.where(along < 0, -1.0, 1.0)[..., None]
    corner = side.clamp(min=0)[..., None] * _unit(radial) + end.clamp(min=0)[..., None] * endward
    within = torch.where((side > end)[..., None], _unit(radial), endward)
    inside = (side < 0) & (end < 0)
    away.append(torch.where(inside[..., None], within, _unit(corner)))
    distance.append(torch.where(inside, torch.maximum(side, end), corner.norm(dim=-1)))

    # Capsules: the distance from a line segment.
    rods = scene.capsules
    axis, half = rods.axis_w[:, None], rods.half_length[:, None]
    from_center = points - rods.center_w[:, None]
    along = torch.minimum(torch.maximum((from_center * axis).sum(-1), -half), half)
    from_axis = from_center - along[..., None] * axis
    away.append(_unit(from_axis))
    distance.append(from_axis.norm(dim=-1) - rods.radius[:, None])

    # Spheres.
    from_center = points - scene.spheres.center_w[:, None]
    away.append(_unit(from_center))
    distance.append(from_center.norm(dim=-1) - scene.spheres.radius[:, None])

    # The ground; then the nearest of all.
    away.append(torch.tensor([0.0, 0.0, 1.0]).expand_as(points))
    distance.append(points[..., 2])
    nearest, index = torch.cat(distance, -1).min(-1)
    index = index[..., None, None].expand(*index.shape, 1, 3)
    return nearest, torch.cat(away, -2).gather(-2, index)[..., 0, :]


@torch.no_grad()
def magnetic_field(gate: Gates, point_w: Tensor, current: float = 2e-5) -> Tensor:
    """Return the magnetic field of a current around the opening of each world's gate, (B, 3).

    See `tracks.geometry.field.magnetic_field`.
    """
    point = to_local(gate.rot_w, point_w - gate.center_w)[:, None]
    corners = torch.cat([torch.zeros_like(gate.opening_g[..., :1]), gate.opening_g], -1)
    start, end = corners - point, corners.roll(-1, -2) - point
    unit = _unit(end - start)
    ends = _unit(start) - _unit(end)
    perpendicular = start - (start * unit).sum(-1, keepdim=True) * unit
    square = (perpendicular**2).sum(-1).clamp(min=1e-12)
    strength = current * (unit * ends).sum(-1) / square
    field = (strength[..., None] * torch.linalg.cross(unit, perpendicular)).sum(-2)
    return to_world(gate.rot_w, field)


@torch.no_grad()
def crossed(gate: Gates, before_w: Tensor, after_w: Tensor) -> Tensor:
    """Return whether the step from `before_w` to `after_w` passes the gate of its world, (B,) bool.

    See `tracks.geometry.crossing.crossing`.
    """
    start_g = to_local(gate.rot_w, before_w - gate.center_w)
    end_g = to_local(gate.rot_w, after_w - gate.center_w)
    crosses = (start_g[:, 0] < 0) & (end_g[:, 0] >= 0)
    travel = torch.where(crosses, end_g[:, 0] - start_g[:, 0], 1.0)
    point = start_g[:, 1:] + (-start_g[:, 0] / travel)[:, None] * (end_g - start_g)[:, 1:]
    edge = gate.opening_g.roll(-1, -2) - gate.opening_g
    away = point[:, None] - gate.opening_g
    turn = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]
    return crosses & (turn >= 0).all(-1)
