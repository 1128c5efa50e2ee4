"""Mesh files that refer to others, unpack to much or never end are refused, and cost little."""

import json
import os
import zipfile
from typing import Any

import numpy as np
import pytest
import trimesh

from tracks.formats import mesh_reader
from tracks.formats.mesh_reader import load_convex_parts

CUBE = str(trimesh.creation.box((1, 1, 1)).export(file_type="obj"))


@pytest.mark.parametrize("side", ["pipe", "20 GB", "device"])
def test_materials_are_left_alone(tmp_path, monkeypatch, side):
    """On a pipe that nobody writes to, reading would wait for ever."""
    monkeypatch.setattr(mesh_reader, "READ_S", 30.0)
    place = tmp_path / "it.mtl"
    if side == "pipe":
        os.mkfifo(place)
    elif side == "20 GB":
        with place.open("wb") as file:
            file.truncate(20 * 2**30)  # a hole: takes no room on the disk
    else:
        place.symlink_to("/dev/zero")
    (tmp_path / "it.obj").write_text("mtllib it.mtl\nusemtl a\n" + CUBE)
    (parts,) = load_convex_parts([tmp_path / "it.obj"])
    assert [part.shape for part in parts] == [(12, 3, 3)]


def test_a_part_wound_inwards_is_turned_outwards(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    for _ in range(2):
        box.export(tmp_path / "it.stl")
        ((part,),) = load_convex_parts([tmp_path / "it.stl"])
        assert trimesh.triangles.mass_properties(part).volume == pytest.approx(1.0)
        box.invert()


def test_archives_and_other_kinds_are_refused_unread(tmp_path):
    for ending in ("zip", "tar.gz", "3mf", "bz2", "dae", "mtl", ""):
        path = tmp_path / f"it.{ending}"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("it.obj", CUBE)
        with pytest.raises(ValueError, match=r"must end in one of .obj, .stl, .ply, .off, .glb"):
            load_convex_parts([path])


def gltf(folder, buffer=None, count=None):
    """Write a cube as a glTF, with another buffer or another count of corners."""
    scene = trimesh.Scene(trimesh.creation.box((1, 1, 1)))
    files: Any = scene.export(file_type="gltf")
    for name, data in files.items():
        (folder / name).write_bytes(data)
    tree = json.loads(files["model.gltf"])
    if buffer:
        tree["buffers"][0]["uri"] = buffer
    if count:
        tree["accessors"] = [
            {k: v for k, v in each.items() if k != "bufferView"} | {"count": count}
            for each in tree["accessors"]
        ]
    (folder / "model.gltf").write_text(json.dumps(tree))
    return folder / "model.gltf"


def test_buffers_of_a_gltf_are_plain_files_beside_it(tmp_path):
    (parts,) = load_convex_parts([gltf(tmp_path)])
    assert np.ptp(parts[0].reshape(-1, 3), axis=0) == pytest.approx(1.0)
    os.mkfifo(tmp_path / "pipe.bin")
    with pytest.raises(ValueError, match="pipe.bin: cannot be read: it is a named pipe"):
        load_convex_parts([gltf(tmp_path, "pipe.bin")])
    with pytest.raises(ValueError, match="not below the folder of the mesh"):
        load_convex_parts([gltf(tmp_path, "../secret.bin")])


def test_more_memory_than_allowed_is_refused_by_its_size(tmp_path):
    with pytest.raises(ValueError, match=r"model.gltf: .*(memory|cannot be read)"):
        load_convex_parts([gltf(tmp_path, count=1_500_000_000)])
    assert len(load_convex_parts([gltf(tmp_path)])[0][0]) == 12, "the next one is read"


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import time; time.sleep(100)", "cannot be read as a mesh within 0.5 s"),
        ("import os; os.abort()", "ended with -6"),
        ("import sys; sys.stdout.write('{'); sys.exit(3)", "to the end, its reader ended with"),
    ],
)
def test_a_reader_that_hangs_or_dies_is_named_and_replaced(tmp_path, monkeypatch, program, said):
    (tmp_path / "it.obj").write_text(CUBE)
    with monkeypatch.context() as patch:
        patch.setattr(mesh_reader, "READ_S", 0.5 if "sleep" in program else 60.0)
        patch.setattr(mesh_reader, "_PROGRAM", program)
        mesh_reader._end(mesh_reader._process())
        with pytest.raises(ValueError, match=f"it.obj: .*{said}"):
            load_convex_parts([tmp_path / "it.obj"])
    assert len(load_convex_parts([tmp_path / "it.obj"])[0][0]) == 12
