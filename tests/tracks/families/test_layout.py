"""What the families share: gate sizes, heights, room for a body."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import ndimage

from tracks.families import FAMILIES, JUDGED, LEVELS, make_track
from tracks.track import Track

SEEDS = range(12)


def tracks_of(
    family: str, levels: Sequence[int] = LEVELS, seeds: Sequence[int] = SEEDS
) -> list[Track]:
    return [make_track(family, level, seed) for level in levels for seed in seeds]


@pytest.mark.parametrize("family", JUDGED)
def test_gate_sizes_heights_and_frames(family):
    widest = 0.22 if family == "ellipse" else 0.25
    for track in tracks_of(family):
        d, gates = track.difficulty, track.scene.gates
        side = np.ptp(gates.opening_g, axis=1)
        assert np.allclose(side[:, 0], side[:, 1])
        assert np.all(np.abs(side - (1.2 - 0.4 * d)) <= 0.05 + 1e-12)
        assert np.all((gates.frame_width >= 0.15) & (gates.frame_width <= widest))
        assert np.allclose(gates.frame_depth, 0.03 + 0.03 * d)
        assert np.all((gates.center_w[:, 2] >= 0.8) & (gates.center_w[:, 2] <= 2.0))
        assert np.allclose(gates.rot_w[:, 2, 2], 1)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_gate_can_be_reached_by_a_body_of_20_cm(family):
    assert unreachable_gates(make_track(family, 9, 4)) == []


def unreachable_gates(track: Track, step: float = 0.2, body: float = 0.2) -> list[int]:
    """Return the gates to which no connected free cells lead from the one before."""
    from tracks.formats.meshes import solid_meshes

    gates = track.scene.gates
    normal = gates.rot_w[:, :, 0]
    leave = np.concatenate([track.start_pos_w[None], gates.center_w[:-1] + 0.6 * normal[:-1]])
    reach = gates.center_w - 0.6 * normal
    low = np.minimum(leave, reach).min(0) - 4
    low[2] = 0.3
    high = np.maximum(leave, reach).max(0) + 4
    high[2] = 4.0
    axes = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    free = np.ones(grid.shape[:3], bool)
    for _, mesh in solid_meshes(track):
        # All solids are convex: outside of any face plane, pushed out by the body, is outside.
        box = [
            slice(max(int((lo - a[0]) / step) - 2, 0), int((hi - a[0]) / step) + 3)
            for lo, hi, a in zip(*mesh.bounds, axes, strict=True)
        ]
        part = grid[tuple(box)]
        normals, corner = mesh.face_normals, mesh.triangles[:, 0]
        height = part @ normals.T - np.sum(normals * corner, axis=-1)
        if height.size:
            free[tuple(box)] &= height.max(-1) > body
    labels = np.zeros(free.shape, np.int32)
    ndimage.label(free, output=labels)

    def label(point: np.ndarray) -> int:
        return int(labels[tuple(np.round((point - low) / step).astype(int))])

    return [i for i in range(8) if label(leave[i]) != label(reach[i]) or not label(reach[i])]
