"""Draw pictures of a drone on a track, from any viewpoint or from behind the drone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from PIL import Image

from eval.view import colours
from eval.view.scene3d import Faces, Lines, divide_faces, look_at, paint
from eval.view.solids import DRONE_HALF_SIZE, ROTOR_RADIUS_M, track_solids
from tracks.track import Track

FOV_DEG = 78.0
"""Horizontal field of view of pictures and videos [deg]."""
OVERSAMPLING = 2
"""Factor by which pictures are drawn larger before they are reduced, for smooth edges."""
ARM_M = 0.12
"""Distance of the drawn rotors from the drone's centre [m]."""
BEHIND_M, ABOVE_M, AHEAD_M = 1.5, 0.55, 1.2
"""Distances of the camera behind and above the drone, and of its target ahead [m]."""
MIN_EYE_HEIGHT_M = 0.15
"""Least height of the camera above the ground [m]."""
NO_LINES = Lines(np.zeros((0, 2, 3)), np.zeros((0, 3)), 0.0)
"""No additional lines in a picture."""


class Scenery(NamedTuple):
    """The triangles of a track."""

    corners_w: np.ndarray
    """(F, 3, 3) corners [m]."""
    gate: np.ndarray
    """(F,) number of the gate to whose frame a triangle belongs, or -1."""


class Drone(NamedTuple):
    """A drone in a picture."""

    pos_w: np.ndarray
    """(3,) position [m]."""
    rot_w: np.ndarray
    """(3, 3) attitude, body to world."""
    gates: int
    """Number of passed gates."""


def scenery_of(track: Track) -> Scenery:
    """Return the triangles of a track, for `draw_drone`."""
    solids = track_solids(track)
    corners_w = np.concatenate([solid.vertices[solid.faces] for solid in solids])
    gate_of_solid = [-1 if solid.gate is None else solid.gate for solid in solids]
    gate = np.repeat(gate_of_solid, [len(solid.faces) for solid in solids])
    corners_w, triangle = divide_faces(corners_w)
    return Scenery(corners_w, gate[triangle])


def draw_drone(
    scenery: Scenery,
    drone: Drone,
    eye_to_w: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
    lines: Lines = NO_LINES,
) -> Image.Image:
    """Return a picture of a drone on a track, without the triangles between camera and drone.

    The drone's number of passed gates determines the gates' colours. `eye_to_w` are the camera's
    position and its target, (3,) each [m]; `size` is width and height [pixels].
    """
    eye, target = eye_to_w
    body = _drone_faces(drone.pos_w, drone.rot_w)
    visible = _not_between(scenery.corners_w, eye, drone.pos_w)
    faces = Faces(
        np.concatenate([scenery.corners_w[visible], body.corners_w]),
        np.concatenate([_track_colour(scenery.gate[visible], drone.gates), body.colour]),
    )
    oversampled = size[0] * OVERSAMPLING, size[1] * OVERSAMPLING
    return paint(look_at(eye, target, FOV_DEG, oversampled), faces, lines).reduce(OVERSAMPLING)


def camera_behind(pos_w: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eye and target (..., 3) [m] of a camera that looks along `direction` (..., 2)."""
    size = np.linalg.norm(direction, axis=-1, keepdims=True)
    ahead = np.insert(direction / np.maximum(size, 1e-6), 2, 0.0, axis=-1)
    eye_w = pos_w - BEHIND_M * ahead + [0.0, 0.0, ABOVE_M]
    eye_w[..., 2] = np.maximum(eye_w[..., 2], MIN_EYE_HEIGHT_M)
    return eye_w, pos_w + AHEAD_M * ahead


def chase_image(
    scenery: Scenery, drone: Drone, vel_w: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 from behind a drone.

    The camera looks along the velocity `vel_w` (3,) [m/s]. `size` is width and height [pixels].
    """
    # The heading is added, so that the direction is defined for a drone at rest too.
    camera = camera_behind(drone.pos_w, vel_w[:2] + 0.5 * drone.rot_w[:2, 0])
    return np.asarray(draw_drone(scenery, drone, camera, size))


def inset(picture: np.ndarray, depth_m: np.ndarray, range_m: float, share: int) -> np.ndarray:
    """Return a picture (H, W, 3) with a depth image (h, w) [m] in its lower right corner.

    The picture is uint8. The depth image is enlarged without interpolation, to one `share`-th of
    the width; `range_m` is the end of its colour scale [m].
    """
    width = picture.shape[1] // share
    height = min(picture.shape[0], max(1, width * depth_m.shape[0] // depth_m.shape[1]))
    size = width, height
    depth_picture = Image.fromarray(colours.depth_colours(depth_m, range_m))
    out = picture.copy()
    out[-height:, -width:] = np.asarray(depth_picture.resize(size, Image.Resampling.NEAREST))
    return out


def _not_between(corners_w: np.ndarray, eye_w: np.ndarray, pos_w: np.ndarray) -> np.ndarray:
    """Return which faces (F, 3, 3) reach beyond the drone, as seen from the camera, (F,) bool.

    The other faces lie between camera and drone, or behind the camera.
    """
    to_drone = pos_w - eye_w
    return ((corners_w - eye_w) @ to_drone).max(axis=1) > to_drone @ to_drone


def _track_colour(gate: np.ndarray, next_gate: int) -> np.ndarray:
    """Return the colours (F, 3) of the track's faces, which belong to gate `gate` (F,) or -1."""
    colour = np.tile(np.array(colours.SOLID, dtype=float), (len(gate), 1))
    colour[gate >= 0] = 0.55 * np.array(colours.AHEAD) + 0.45 * 255
    colour[gate == next_gate] = colours.AHEAD
    colour[(gate >= 0) & (gate < next_gate)] = colours.PASSED
    return colour


def _drone_faces(pos_w: np.ndarray, rot_w: np.ndarray) -> Faces:
    """Return the faces of a body and four rotors, the front ones orange."""
    x, y, z = DRONE_HALF_SIZE
    box = np.array([[i * x, j * y, k * z] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    body = [box[[q[0], q[a], q[a + 1]]] for q in quads for a in (1, 2)]
    angle = np.linspace(0, 2 * np.pi, 13)
    ring = ROTOR_RADIUS_M * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    parts, colour = list(body), [colours.DRONE] * len(body)
    for i, j in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        middle = np.array([i * ARM_M / np.sqrt(2), j * ARM_M / np.sqrt(2), 0.03])
        for a, b in zip(ring[:-1], ring[1:], strict=True):
            parts += [np.array([middle, middle + a, middle + b])]
            parts += [np.array([middle, middle + b, middle + a])]  # the lower side
            colour += [colours.AHEAD if i > 0 else colours.SOLID_EDGE] * 2
    return Faces(pos_w + np.array(parts) @ rot_w.T, np.array(colour, dtype=float))
