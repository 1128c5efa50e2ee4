"""The field against a numerical line integral, and what Maxwell says of it."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.gates import rectangle, regular_polygon

UPRIGHT = (np.zeros(3), np.eye(3))
SQUARE = rectangle(1.0, 1.0)


def by_line_integral(center_w, rot_w, opening, point_w, current=2e-5, pieces=2000):
    """Biot and Savart, C * integral of dl x r / |r|^3 along the rim, by the midpoint rule."""
    corner = center_w + np.column_stack([np.zeros(len(opening)), opening]) @ rot_w.T
    share = ((np.arange(pieces) + 0.5) / pieces)[:, None]
    total = np.zeros_like(point_w)
    for begin, end in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        away = point_w[:, None] - (begin + share * (end - begin))
        cubed = np.linalg.norm(away, axis=-1, keepdims=True) ** 3
        total += (np.cross((end - begin) / pieces, away) / cubed).sum(1)
    return current * total


def away_from_rim(opening, point, least=0.1):
    side = np.roll(opening, -1, axis=0) - opening
    corner = np.column_stack([np.zeros(len(opening)), opening])
    side = np.column_stack([np.zeros(len(side)), side])
    share = np.sum((point[:, None] - corner) * side, -1) / np.sum(side**2, -1)
    gap = point[:, None] - corner - np.clip(share, 0, 1)[..., None] * side
    return np.linalg.norm(gap, axis=-1).min(-1) > least


@pytest.mark.parametrize(
    "opening", [SQUARE, rectangle(1.3, 0.7), regular_polygon(3, 0.4), regular_polygon(12, 0.5)]
)
def test_the_field_is_the_line_integral(opening):
    rng = np.random.default_rng(len(opening))
    point_g = rng.uniform(-2, 2, (60, 3))
    point_g = point_g[away_from_rim(opening, point_g)]
    rot_w, center_w = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    point_w = center_w + point_g @ rot_w.T
    field = magnetic_field(center_w, rot_w, opening, point_w)
    expected = by_line_integral(center_w, rot_w, opening, point_w)
    assert np.allclose(field, expected, rtol=1e-4, atol=1e-9)


def test_strengths_on_the_axis_of_a_1_m_gate():
    axis = np.array([[x, 0.0, 0.0] for x in (0, 1, 2, 3, 5)])
    field = magnetic_field(*UPRIGHT, SQUARE, axis)
    strength = np.linalg.norm(field, axis=-1) ** 0.7
    assert np.allclose(strength, [2.8e-3, 6.2e-4, 1.8e-4, 8e-5, 2.8e-5], rtol=0.05)
    # A square loop's centre: 4 * (2 / sqrt 2) / half side.
    assert field[0, 0] == pytest.approx(2e-5 * 4 * np.sqrt(2) / 0.5, rel=1e-6)


def test_padding_corners_add_nothing_and_the_wire_is_safe_in_both_libraries():
    padded = np.concatenate([SQUARE, SQUARE[-1:], SQUARE[-1:]])
    point = np.random.default_rng(1).uniform(-2, 2, (6, 3))
    expected = magnetic_field(*UPRIGHT, SQUARE, point)
    assert np.allclose(magnetic_field(*UPRIGHT, padded, point), expected, rtol=1e-9, atol=0)
    on_wire = np.array([[0, 0.5, 0], [0, 0.5, 0.5], [0, 0.1, -0.5], [0, 0.5, 3.0]])
    points = np.concatenate([point, on_wire])
    assert np.isfinite(magnetic_field(*UPRIGHT, padded, points)).all()
    by_jax = np.asarray(jax.jit(magnetic_field)(*UPRIGHT, padded, points))
    assert np.allclose(by_jax[:6], expected, rtol=2e-3, atol=1e-8) and np.isfinite(by_jax).all()


def test_attraction_fades_with_alignment_and_keeps_the_fields_direction():
    field = magnetic_field(*UPRIGHT, SQUARE, np.array([-0.5, 0.2, 0.1]))
    unit, size = field / np.linalg.norm(field), np.linalg.norm(field)
    along = attractive_field(field, 1e4 * unit)
    against = attractive_field(field, -1e4 * unit)
    at_rest = attractive_field(field, np.zeros(3))
    assert np.linalg.norm(along) < 1e-3 * size**0.7
    assert np.allclose(against, 2 * size**0.7 * unit, rtol=1e-3)
    assert np.allclose(at_rest, size**0.7 * unit)
    aligned = 3 * size / (3 * size + 1e-5)
    assert np.allclose(attractive_field(field, 3 * unit), (1 - aligned) * size**0.7 * unit)
    assert np.all(attractive_field(np.zeros(3), np.ones(3)) == 0)
