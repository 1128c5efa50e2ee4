"""Meshes show what the scene holds."""

import numpy as np
import pytest

from tracks.families import make_track
from tracks.formats.custom import load_track
from tracks.formats.meshes import named_meshes, solid_meshes


def test_meshes_have_the_solids_names_places_and_volumes():
    track = make_track("ellipse", 9, 5)
    scene = track.scene
    meshes = solid_meshes(track)
    assert [name for name, _ in meshes] == list(track.names)
    assert all(mesh.is_watertight and mesh.volume > 0 for _, mesh in meshes)
    solids = (scene.boxes, scene.cylinders, scene.capsules, scene.spheres)
    center_w = np.concatenate([kind.center_w for kind in solids])
    assert np.allclose([mesh.center_mass for _, mesh in meshes], center_w, atol=1e-3)
    volume = np.concatenate(
        [
            8 * scene.boxes.half_size.prod(-1),
            2 * np.pi * scene.cylinders.radius**2 * scene.cylinders.half_length,
            np.pi * scene.capsules.radius**2 * 2 * scene.capsules.half_length
            + 4 / 3 * np.pi * scene.capsules.radius**3,
            4 / 3 * np.pi * scene.spheres.radius**3,
        ]
    )
    share = np.array([mesh.volume for _, mesh in meshes]) / volume
    assert np.all((share > 0.95) & (share < 1 + 1e-9))


def test_long_axes_point_where_the_rods_do():
    track = make_track("zigzag", 9, 4)
    scene = track.scene
    first = len(scene.boxes.center_w)
    rods = zip(
        np.concatenate([scene.cylinders.axis_w, scene.capsules.axis_w]),
        np.concatenate([scene.cylinders.center_w, scene.capsules.center_w]),
        np.concatenate(
            [scene.cylinders.half_length, scene.capsules.half_length + scene.capsules.radius]
        ),
        strict=True,
    )
    for (_, mesh), (axis, center, half) in zip(solid_meshes(track)[first:], rods, strict=False):
        along = (mesh.vertices - center) @ axis
        assert along.max() == pytest.approx(half, abs=1e-6)
        assert along.min() == pytest.approx(-half, abs=1e-6)


def test_a_gates_bars_are_one_mesh_and_parked_bars_none(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    meshes = named_meshes(track)
    assert list(meshes) == list(dict.fromkeys(track.names))
    assert len(meshes["gate 0 frame"].faces) == 4 * 12
    assert len(meshes["gate 1 frame"].faces) == 12 * 12
    assert len(meshes["gate 2 frame"].faces) == 3 * 12
    gate = meshes["gate 0 frame"]
    assert np.allclose(gate.bounds, [[-0.025, -0.75, 0.6], [0.025, 0.75, 2.0]])
