"""Frames leave the opening open and close everything around it."""

import numpy as np
import pytest

from tracks.geometry.gates import (
    frame_boxes,
    rectangle,
    regular_polygon,
    square_gates,
    yaw_rotation,
)
from tracks.geometry.scene import PARKED_Z, Gates


def inside_boxes(boxes, point_w):
    local = np.einsum("nij,pni->pnj", boxes.rot_w, point_w[:, None] - boxes.center_w)
    return np.any(np.all(np.abs(local) <= boxes.half_size, axis=-1), axis=-1)


def one_gate(opening, width=0.2, depth=0.06, yaw=0.7):
    return Gates(
        np.array([[1.0, 2.0, 1.5]]),
        yaw_rotation(np.array([yaw])),
        opening[None],
        np.array([width]),
        np.array([depth]),
    )


@pytest.mark.parametrize(
    "opening",
    [
        rectangle(1.2, 0.8),
        regular_polygon(6, 0.5),
        regular_polygon(16, 0.6),
        regular_polygon(3, 0.4),
    ],
    ids=["rectangle", "hexagon", "round", "triangle"],
)
def test_the_frame_surrounds_the_opening_and_nothing_else(opening):
    gates = one_gate(opening)
    boxes = frame_boxes(gates)
    assert len(boxes.center_w) == len(opening)
    rng = np.random.default_rng(0)
    point = rng.uniform(-1.6, 1.6, (20000, 2))
    side = np.roll(opening, -1, axis=0) - opening
    outward = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1)[:, None]
    beyond = np.max(np.sum((point[:, None] - opening) * outward, -1), axis=-1)
    # The rim, exactly: distance to the polygon's boundary within the width.
    share = np.clip(np.sum((point[:, None] - opening) * side, -1) / np.sum(side * side, -1), 0, 1)
    gap = np.linalg.norm(point[:, None] - opening - share[..., None] * side, axis=-1).min(-1)
    point_w = gates.center_w[0] + np.column_stack([0 * gap, point]) @ gates.rot_w[0].T
    solid = inside_boxes(boxes, point_w)
    assert not solid[beyond < -1e-9].any()
    assert solid[(beyond > 1e-9) & (gap < 0.2 - 1e-9)].all()
    assert not solid[gap > 0.2 * np.sqrt(2) + 1e-9].any()
    off = point_w + 0.0301 * gates.rot_w[0, :, 0]
    assert not inside_boxes(boxes, off).any()


def test_repeated_corners_park_their_bars():
    square = rectangle(1.0, 1.0)
    padded = one_gate(np.concatenate([square, square[-1:], square[-1:]]))
    plain, boxes = frame_boxes(one_gate(square)), frame_boxes(padded)
    kept = boxes.center_w[:, 2] > PARKED_Z / 2
    assert kept.sum() == 4
    for field, expected in zip(boxes, plain, strict=True):
        assert np.allclose(field[kept], expected)


def test_openings_are_counter_clockwise_and_round_ones_keep_their_clear_radius():
    for opening in (rectangle(1.0, 0.5), regular_polygon(12, 0.6)):
        after = np.roll(opening, -1, axis=0)
        assert np.all(opening[:, 0] * after[:, 1] - opening[:, 1] * after[:, 0] > 0)
    middle = (regular_polygon(12, 0.6) + np.roll(regular_polygon(12, 0.6), -1, axis=0)) / 2
    assert np.allclose(np.linalg.norm(middle, axis=-1), 0.6)


def test_square_gates_fly_along_their_yaw():
    yaw = np.array([0.0, np.pi / 2])
    one = np.ones(2)
    gates = square_gates(np.zeros((2, 3)), yaw, one, 0.2 * one, 0.05 * one)
    assert np.allclose(gates.rot_w[:, :, 0], [[1, 0, 0], [0, 1, 0]])
    assert np.allclose(gates.rot_w[:, :, 2], [[0, 0, 1], [0, 0, 1]])
