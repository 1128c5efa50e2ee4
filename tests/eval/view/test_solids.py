"""The solids of a track, and their outlines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial import ConvexHull

from eval.view.solids import flat_normals, joined, outline, track_solids
from tests.support.flights import small_track


def test_solids_are_the_gates_bars_first_and_their_normals_point_out():
    track = small_track()
    solids = track_solids(track)
    assert [solid.gate for solid in solids] == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4 + [None] * 4
    for solid in solids:
        corners = solid.vertices[solid.faces]
        outward = corners.mean(axis=1) - solid.vertices.mean(axis=0)
        assert (np.einsum("fi,fi->f", flat_normals(corners), outward) > 0).all()
    vertices, faces = joined(solids[:4])
    np.testing.assert_array_equal(vertices[faces][:12], solids[0].vertices[solids[0].faces])
    assert len(faces) == 48 and faces.max() == len(vertices) - 1


@given(npst.arrays(np.float64, (30, 2), elements=st.floats(-10, 10, width=16)))
def test_outlines_are_the_convex_hulls(points):
    corners = outline(points)
    if len(np.unique(points, axis=0)) < 3 or np.linalg.matrix_rank(points - points[0]) < 2:
        assert len(corners) <= 2
        return
    hull = ConvexHull(points)
    assert {tuple(c) for c in corners} == {tuple(points[k]) for k in hull.vertices}
    x, y = corners.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert area == pytest.approx(hull.volume)
