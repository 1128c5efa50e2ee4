"""A small renderer of flat-shaded triangles and lines that needs no GPU and no OpenGL.

Faces are drawn from the farthest to the nearest (the painter's algorithm; Newell et al. 1972). For
small faces the result is correct except for rare overlaps. So large faces are divided first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from eval.view.colours import brightness
from eval.view.solids import flat_normals

NEAR_M = 0.05
"""Depth below which faces are clipped [m]."""
FOG_M = 45.0
"""Distance at which a colour has faded by `FOG_SHARE` [m]."""
FOG_SHARE = 0.65
"""Largest share of the sky's colour in a far face."""
SKY, GROUND, GRID = (232, 238, 245), (214, 217, 212), (200, 204, 200)
"""Colours of the sky, the ground and its grid lines, 0-255."""
GRID_REACH_M = 24
"""Distance from the camera to the last grid line [m]; lines are 1 m apart."""
LONGEST_M = 2.0
"""A face with a longer side is divided [m]."""
MOST_FACES = 6000
"""Largest number of faces after division."""


class Viewpoint(NamedTuple):
    """A pinhole camera anywhere in the world."""

    eye_w: np.ndarray
    """(3,) position [m]."""
    axes_w: np.ndarray
    """(3, 3) camera axes right, down and forward as rows, world frame."""
    focal: float
    """Focal length [pixels]."""
    size: tuple[int, int]
    """Width and height [pixels]."""


class Faces(NamedTuple):
    """Triangles to draw."""

    corners_w: np.ndarray
    """(F, 3, 3) corners [m], counter-clockwise seen from outside."""
    colour: np.ndarray
    """(F, 3) colours before shading, 0-255."""


class Lines(NamedTuple):
    """Line segments to draw."""

    ends_w: np.ndarray
    """(L, 2, 3) end points [m]."""
    colour: np.ndarray
    """(L, 3) colours, 0-255."""
    width_m: float
    """Width of the lines [m]."""


def divide_faces(corners_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide triangles until no side is longer than `LONGEST_M`, or there are `MOST_FACES`.

    Args:
        corners_w: (F, 3, 3) corners of the triangles [m].

    Returns:
        The corners of the parts (F', 3, 3), and the index of each part's triangle (F',).
    """
    triangle = np.arange(len(corners_w))
    while True:
        sides = np.linalg.norm(corners_w - np.roll(corners_w, -1, axis=1), axis=-1)
        long = np.flatnonzero(sides.max(axis=1, initial=0.0) > LONGEST_M)
        if not len(long) or len(corners_w) + len(long) > MOST_FACES:
            return corners_w, triangle
        # Corners in an order in which the longest side, which is halved, goes from a to b.
        order = (sides[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners_w[long], order[..., None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        halves = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        short = np.delete(np.arange(len(corners_w)), long)
        corners_w = np.concatenate([corners_w[short], halves])
        triangle = np.concatenate([triangle[short], triangle[long], triangle[long]])


def look_at(
    eye_w: np.ndarray, target_w: np.ndarray, fov_deg: float, size: tuple[int, int]
) -> Viewpoint:
    """Return a camera without roll that looks from one point to another.

    `eye_w` (3,) is the position, `target_w` (3,) the point in the middle of the picture [m]. The
    horizontal field of view is in degrees; `size` is width and height [pixels].
    """
    forward = (target_w - eye_w) / np.linalg.norm(target_w - eye_w)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    axes = np.stack([right, np.cross(forward, right), forward])
    return Viewpoint(eye_w, axes, size[0] / 2 / np.tan(np.deg2rad(fov_deg) / 2), size)


def to_camera(view: Viewpoint, points_w: np.ndarray) -> np.ndarray:
    """Return points (..., 3) of the world frame in camera axes: right, down, forward [m]."""
    return (points_w - view.eye_w) @ view.axes_w.T


def to_pixels(view: Viewpoint, points_c: np.ndarray) -> np.ndarray:
    """Return the pixels (..., 2) of points (..., 3) in camera axes, in front of the camera."""
    middle = np.array(view.size) / 2
    return middle + view.focal * points_c[..., :2] / points_c[..., 2:]


def paint(view: Viewpoint, faces: Faces, lines: Lines) -> Image.Image:
    """Return the picture of sky, ground, faces and lines."""
    image = Image.new("RGB", view.size, SKY)
    draw = ImageDraw.Draw(image)
    _paint_ground(draw, view)
    normals = flat_normals(faces.corners_w)
    front = np.einsum("fi,fi->f", faces.corners_w[:, 0] - view.eye_w, normals) < 0
    corners = to_camera(view, faces.corners_w[front])
    colour = faces.colour[front] * brightness(normals[front])[:, None]
    ends = to_camera(view, lines.ends_w)
    shapes = [*corners, *ends]
    distance = np.concatenate([_distance(corners), _distance(ends)])
    fog = FOG_SHARE * np.clip(distance / FOG_M, 0, 1)[:, None]
    colour = (1 - fog) * np.concatenate([colour, lines.colour]) + fog * np.array(SKY)
    colour = np.clip(colour, 0, 255)
    nearest = np.concatenate([corners[..., 2].min(axis=1), ends[..., 2].min(axis=1)])
    farthest = np.concatenate([corners[..., 2].max(axis=1), ends[..., 2].max(axis=1)])
    for k in np.argsort(-distance):
        if farthest[k] <= NEAR_M:
            continue
        shape = shapes[k] if nearest[k] > NEAR_M else _clip(shapes[k])
        pixels = to_pixels(view, shape)
        fill = (int(colour[k, 0]), int(colour[k, 1]), int(colour[k, 2]))
        if len(shapes[k]) == 2:
            width = max(2, round(view.focal * lines.width_m / float(distance[k])))
            draw.line(pixels.ravel().tolist(), fill=fill, width=width)
        else:
            draw.polygon(pixels.ravel().tolist(), fill=fill)
    return image


def _distance(shapes_c: np.ndarray) -> np.ndarray:
    """Return the distances of the shapes' centres from the camera [m]."""
    return np.linalg.norm(shapes_c.mean(axis=1), axis=-1)


def _paint_ground(draw: ImageDraw.ImageDraw, view: Viewpoint) -> None:
    """Draw a large square of ground below the camera, with grid lines."""
    reach = 500.0
    square = np.array([[-reach, -reach], [reach, -reach], [reach, reach], [-reach, reach]])
    ground = np.insert(square + view.eye_w[:2], 2, 0.0, axis=1)
    shape = _clip(to_camera(view, ground))
    if len(shape) >= 3:
        draw.polygon(to_pixels(view, shape).ravel().tolist(), fill=GROUND)
    middle = np.round(view.eye_w[:2])
    for offset in range(-GRID_REACH_M, GRID_REACH_M + 1):
        for axis in (0, 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = middle[axis] + offset
            ends[:, 1 - axis] = middle[1 - axis] + np.array([-GRID_REACH_M, GRID_REACH_M])
            line = _clip(to_camera(view, ends))
            if len(line) >= 2:
                draw.line(to_pixels(view, line[:2]).ravel().tolist(), fill=GRID, width=2)


def _clip(shape_c: np.ndarray) -> np.ndarray:
    """Return the part of a polygon (k, 3) in front of the camera (Sutherland, Hodgman 1974)."""
    clipped = []
    for corner, following in zip(shape_c, np.roll(shape_c, -1, axis=0), strict=True):
        if corner[2] > NEAR_M:
            clipped.append(corner)
        if (corner[2] > NEAR_M) != (following[2] > NEAR_M):
            share = (NEAR_M * 1.001 - corner[2]) / (following[2] - corner[2])
            clipped.append(corner + share * (following - corner))
    return np.array(clipped).reshape(-1, 3)
