"""Make gates: openings as convex polygons, and their frames with one box for each side.

G gates have V corners each. A gate's frame of reference has x in flight direction; the opening lies
in its y-z plane.
"""

from __future__ import annotations

import numpy as np

from tracks.geometry.rotation import yaw_rotation
from tracks.geometry.scene import PARKED_Z, Boxes, Gates


def rectangle(width: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """Return the corners (y, z) of a centred rectangle, counter-clockwise, (..., 4, 2) [m]."""
    half = np.stack([np.asarray(width, float), np.asarray(height, float)], axis=-1) / 2
    return half[..., None, :] * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def regular_polygon(corners: int, radius: float) -> np.ndarray:
    """Return a regular polygon around the origin, counter-clockwise, (corners, 2) [m].

    The first side is level and at the bottom. The inscribed circle has the `radius`, the clear
    width of a round gate [m]. There are at least 3 corners.
    """
    angle = 2 * np.pi * (np.arange(corners) - 0.5) / corners - np.pi / 2
    circumradius = radius / np.cos(np.pi / corners)
    return circumradius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def square_gates(
    center_w: np.ndarray,
    yaw: np.ndarray,
    side: np.ndarray,
    frame_width: np.ndarray,
    frame_depth: np.ndarray,
) -> Gates:
    """Return upright gates with square openings.

    Args:
        center_w: (G, 3) opening centres [m].
        yaw: (G,) flight directions about world z [rad].
        side: (G,) side lengths of the openings [m].
        frame_width: (G,) widths of the bars around the openings [m].
        frame_depth: (G,) extents of the frames along the flight direction [m].
    """
    return Gates(center_w, yaw_rotation(yaw), rectangle(side, side), frame_width, frame_depth)


def frame_boxes(gates: Gates) -> Boxes:
    """Return the frames' bars, one box for each side of an opening, gate by gate, (G * V) boxes.

    A bar lies outside its side of the opening and is lengthened so that neighbours close the
    corner between them. Where corners repeat (openings padded to V corners), the bar is parked far
    below the ground.
    """
    corner = np.asarray(gates.opening_g, float)
    side = np.roll(corner, -1, axis=-2) - corner
    length = np.linalg.norm(side, axis=-1)
    has_length = length > 1e-9
    along = (
        np.where(has_length[..., None], side, [1.0, 0.0])
        / np.where(has_length, length, 1.0)[..., None]
    )
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    width = np.asarray(gates.frame_width, float)[:, None]
    end, start = _corner_extensions(along, has_length, width)
    # A bar's centre (y, z): half of its length along the side, half of its width outwards.
    middle = (
        corner + along * ((length + end - start) / 2)[..., None] + outward * width[..., None] / 2
    )

    rot_gate = np.asarray(gates.rot_w, float)[:, None]
    zero = np.zeros(length.shape)
    center_g = np.stack([zero, middle[..., 0], middle[..., 1]], axis=-1)
    axis_y = np.stack([zero, along[..., 0], along[..., 1]], axis=-1)
    axis_z = np.stack([zero, -along[..., 1], along[..., 0]], axis=-1)
    axis_x = np.broadcast_to([1.0, 0.0, 0.0], axis_y.shape)
    rot_w = rot_gate @ np.stack([axis_x, axis_y, axis_z], axis=-1)
    center_w = np.asarray(gates.center_w)[:, None] + (rot_gate @ center_g[..., None])[..., 0]
    half_depth = np.broadcast_to(np.asarray(gates.frame_depth, float)[:, None], length.shape) / 2
    half_width = np.broadcast_to(width, length.shape) / 2
    half_size = np.stack([half_depth, (length + end + start) / 2, half_width], axis=-1)

    center_w = np.where(has_length[..., None], center_w, [0.0, 0.0, PARKED_Z])
    half_size = np.where(has_length[..., None], half_size, 1e-3)
    count = has_length.size
    return Boxes(
        center_w.reshape(count, 3), rot_w.reshape(count, 3, 3), half_size.reshape(count, 3)
    )


def with_frames(gates: Gates, boxes: Boxes) -> tuple[Boxes, list[str]]:
    """Return the bars of the gates' frames followed by `boxes`, and the names of the bars."""
    parts = zip(frame_boxes(gates), boxes, strict=True)
    count, bars = gates.opening_g.shape[:2]
    names = [f"gate {i} frame" for i in range(count) for _ in range(bars)]
    return Boxes(*(np.concatenate(pair) for pair in parts)), names


def _corner_extensions(
    along: np.ndarray, has_length: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the extensions of each bar at its end and at its start, (G, V) each [m].

    `width * tan(turn / 2)` brings the outer edges of neighbours together. The factor is at most 1
    (reached at a right angle), so that sharp corners have no spikes.

    Args:
        along: (G, V, 2) unit vectors along the sides.
        has_length: (G, V) bool, whether a side has a length; at a repeated corner it has none.
        width: (G, 1) widths of the bars [m].
    """

    def tan_half_turn(side: np.ndarray, next_side: np.ndarray) -> np.ndarray:
        cosine = np.sum(side * next_side, axis=-1)
        return np.minimum(np.sqrt((1 - cosine) / np.maximum(1 + cosine, 1e-9)), 1.0)

    if has_length.all():
        end = width * tan_half_turn(along, np.roll(along, -1, axis=1))
        return end, np.roll(end, 1, axis=1)
    end, start = np.zeros(has_length.shape), np.zeros(has_length.shape)
    for gate in range(len(has_length)):
        sides = np.flatnonzero(has_length[gate])
        next_sides = np.roll(sides, -1)
        end[gate, sides] = width[gate, 0] * tan_half_turn(
            along[gate, sides], along[gate, next_sides]
        )
        start[gate, next_sides] = end[gate, sides]
    return end, start
