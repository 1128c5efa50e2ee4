"""Mesh files come in as convex closed parts, or are refused by name."""

import numpy as np
import pytest
import trimesh

from tracks.formats.custom import load_track

GATE = """
[[gates]]
center = [0, 0, 1.5]
width = 1.0
height = 1.0
"""


def write(folder, text):
    path = folder / "track.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_meshes_come_from_any_common_file(tmp_path, suffix):
    two = [trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(2, 0.5)]
    two[1].apply_translation([3, 0, 0])
    trimesh.util.concatenate(two).export(tmp_path / f"two.{suffix}")
    text = GATE + f'[[meshes]]\nfile = "two.{suffix}"\nposition = [0, 0, 1]\nscale = 0.5\n'
    track = load_track(write(tmp_path, text))
    assert sorted(track.mesh_sizes) == [12, 320]
    assert np.allclose(
        np.ptp(track.scene.triangles.reshape(-1, 3), axis=0), [1.75 + 0.25, 0.5, 0.5], atol=0.02
    )


def as_objects(meshes):
    """Return an OBJ file's text with an object for each mesh, as a decomposition writes it."""
    lines, first = [], 1
    for number, mesh in enumerate(meshes):
        lines += [f"o part {number}", *("v {} {} {}".format(*v) for v in mesh.vertices)]
        lines += ["f {} {} {}".format(*(face + first)) for face in mesh.faces]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def test_parts_that_touch_are_objects_of_their_own(tmp_path):
    left, right = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 2, 1))
    right.apply_translation([1, 0, 0])
    path = write(tmp_path, GATE + '[[meshes]]\nfile = "two.obj"\nposition = [0, 0, 1]\n')
    (tmp_path / "two.obj").write_text(as_objects([left, right]))
    assert load_track(path).mesh_sizes == (12, 12)


def test_a_triangle_without_an_area_is_none(tmp_path):
    """An edge is split by a point that only one of its two triangles knows: a sliver closes it."""
    box = trimesh.creation.box((1, 1, 1))
    (a, b, c), rest = box.faces[0], box.faces[1:]
    middle = len(box.vertices)
    vertices = np.vstack([box.vertices, box.vertices[[a, b]].mean(0)])
    faces = np.vstack([rest, [[a, middle, c], [middle, b, c], [a, b, middle]]])
    sliced = trimesh.Trimesh(vertices, faces, process=False)
    assert sliced.is_watertight and sliced.area_faces.min() == 0.0
    sliced.export(tmp_path / "box.ply")
    path = write(tmp_path, GATE + '[[meshes]]\nfile = "box.ply"\nposition = [0, 20, 1]\n')
    triangles = load_track(path).scene.triangles
    sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert len(triangles) == 13 and np.linalg.norm(sides, axis=1).min() > 0.1
    inside = "\n[start]\nposition = [0, 20, 1]\n"
    with pytest.raises(ValueError, match=r"start.position is \[0.0, 20.0, 1.0\]"):
        load_track(write(tmp_path, path.read_text() + inside))


def test_meshes_that_are_not_convex_open_or_broken_are_refused(tmp_path):
    path = write(tmp_path, GATE + '[[meshes]]\nfile = "part.stl"\n')
    good = trimesh.creation.box((1, 1, 1))
    dented = good.subdivide()
    top = np.argmax(dented.vertices @ [0, 0, 1] - np.linalg.norm(dented.vertices[:, :2], axis=-1))
    dented.vertices[top, 2] -= 0.8
    dented.apply_translation([4, 0, 0])
    trimesh.util.concatenate([good, dented]).export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=r"part.stl: part \d of 2 .*not convex.*split it"):
        load_track(path)
    trimesh.Trimesh(good.vertices, good.faces[:-1]).export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=r"part 0 of 1 .11 triangles. is not closed"):
        load_track(path)
    (tmp_path / "part.stl").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="part.stl"):
        load_track(path)


@pytest.mark.parametrize(
    ("size", "keys", "said"),
    [
        ((1, 1, 1e-7), "", "0.001 m thick .*; part 0 has "),
        ((1, 1, 1), "scale = 0.002\nposition = [9e4, 9e4, 9e4]", "thick where it stands; part 0"),
        ((1, 1, 1), "scale = 1e6", r"within 100000 m .*; part 0 reaches 5e\+05"),
    ],
)
def test_meshes_that_mujoco_finds_no_body_are_refused(tmp_path, size, keys, said):
    """It stores corners as singles: far from the origin a small body is none."""
    path = write(tmp_path, GATE + f'[[meshes]]\nfile = "part.stl"\n{keys}\n')
    trimesh.creation.box(size).export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=rf"track.toml: meshes\[0\].scale is .* {said}"):
        load_track(path)


def test_flat_and_tiny_meshes_are_refused(tmp_path):
    path = write(tmp_path, GATE + '[[meshes]]\nfile = "part.stl"\nscale = 1e-4\n')
    box = trimesh.creation.box((1, 1, 1))
    box.export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=r"scale is 0.0001, .* part 0 has 0.0001"):
        load_track(path)
    trimesh.Trimesh(box.vertices * [1, 1, 0], box.faces, process=False).export(
        tmp_path / "part.stl"
    )
    with pytest.raises(ValueError, match=r"part.stl: part \d of \d .* is flat; give it"):
        load_track(path)
