"""A scene is painted as a pinhole camera sees it."""

import numpy as np
import pytest

from eval.view.scene3d import Faces, Lines, look_at, paint, to_camera, to_pixels

NO_LINES = Lines(np.zeros((0, 2, 3)), np.zeros((0, 3)), 0.01)


def test_painted_solids_stand_where_a_pinhole_puts_them_and_the_near_hides_the_far():
    view = look_at(np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.0]), 90.0, (200, 100))
    ahead = to_pixels(view, to_camera(view, np.array([[2.0, 0, 1], [2, 1, 1], [2, 0, 1.5]])))
    # Left (y > 0) is left of the middle and up is above it; at 90 deg, 2 m to 2 m is the edge.
    np.testing.assert_allclose(ahead, [[100, 50], [50, 50], [100, 25]], atol=1e-9)
    # A sheet of 2 m by 2 m that faces the eye, which is at smaller x.
    y0z0, y1z0, y1z1, y0z1 = ([0.0, y, z] for y, z in ((-1, 0), (1, 0), (1, 2), (-1, 2)))
    sheet = np.array([[y0z0, y1z1, y1z0], [y0z0, y0z1, y1z1]])
    far, near = sheet + [4.0, 0, 0], 0.5 * sheet + [2.0, 0, 0.5]
    red, blue = np.tile([[255.0, 0, 0]], (2, 1)), np.tile([[0.0, 0, 255]], (2, 1))
    both = Faces(np.concatenate([near, far]), np.concatenate([blue, red]))
    pixels = np.asarray(paint(view, both, NO_LINES)).astype(int)
    red_there = pixels[..., 0] > 1.5 * pixels[..., 2]
    blue_there = pixels[..., 2] > 1.5 * pixels[..., 0]
    assert blue_there[50, 100] and blue_there.sum() == pytest.approx(
        50 * 50, rel=0.07
    )  # edges are drawn, too
    assert red_there.sum() < 60  # the far sheet is exactly as large to the eye, and hidden
    behind = Faces(far[:, ::-1], red)
    assert not (np.asarray(paint(view, behind, NO_LINES)).astype(int)[..., 0] > 250).any()
    around = Faces(sheet * 0.1 + [-0.05, 0, 0.9], red)  # behind the eye
    paint(view, around, NO_LINES)
