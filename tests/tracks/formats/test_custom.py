"""Custom tracks and their meshes: round trips, and bad files refused by file, key and value."""

import json
import os
import zipfile
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.support.marks import more
from tracks.formats import mesh_reader
from tracks.formats.custom import load_track
from tracks.formats.mesh_reader import load_convex_parts
from tracks.formats.plausibility import track_notes

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


def test_the_example_is_read_as_it_says(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    assert not track_notes("yard", track)
    gates = track.scene.gates
    assert (track.family, track.level, track.seed) == ("yard", 0, 0)
    assert gates.opening_g.shape == (4, 12, 2)
    square = [[-0.55, -0.5], [0.55, -0.5], [0.55, 0.5], [-0.55, 0.5]]
    assert np.allclose(gates.opening_g[0], [*square, *(8 * square[3:])])
    yaw, pitch = np.deg2rad([15, 5])
    ahead = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
    assert np.allclose(gates.rot_w[[1, 3], :, 0], [ahead, [-1, 0, 0]])
    assert np.allclose(np.linalg.det(gates.rot_w), 1)
    assert track.names[48:] == (
        "crate", "pole", "capsule 0", "ball", "yard mesh part 0", "yard mesh part 1",
    )  # fmt: skip
    assert np.allclose(track.scene.boxes.half_size[48], 0.3)
    assert np.allclose(track.scene.cylinders.half_length, 1.5)
    assert np.allclose(track.scene.capsules.axis_w, [[np.sqrt(0.5), np.sqrt(0.5), 0]])
    # The mesh is turned by 90 degrees about its origin and moved: its far end lies along y.
    assert np.allclose(track.scene.triangles.reshape(-1, 3).max(0), [2.6, 9.2, 1.1])
    assert track.mesh_sizes == (8, 6) and len(track.scene.triangles) == 14


def test_roll_is_right_side_down_and_a_start_left_out_is_before_gate_0_and_faces_it(tmp_path):
    track = load_track(write(tmp_path, GATE + "roll_deg = 10\n"))
    assert track.scene.gates.rot_w[0, 2, 1] == pytest.approx(np.sin(np.deg2rad(10)))
    track = load_track(write(tmp_path, GATE + "yaw_deg = 90\n"))
    assert np.allclose(track.start_pos_w, [0, -2.5, 1.5])
    assert track.start_yaw == pytest.approx(np.pi / 2)
    assert track.family == "track"


def test_clockwise_polygons_are_turned_round(tmp_path):
    gate = with_polygon("[[0, 0.5], [0.5, -0.4], [-0.5, -0.4]]")
    opening = load_track(write(tmp_path, gate)).scene.gates.opening_g[0]
    after = np.roll(opening, -1, axis=0)
    assert np.all(opening[:, 0] * after[:, 1] - opening[:, 1] * after[:, 0] > 0)


BOX = "width = 1.0\nheight = 1.0"
START = "[start]\nposition = [0, 0, 1]\n"
NAMED = GATE + '[[spheres]]\nname = "%s"\ncenter=[0,0,0]\nradius=1\n'


def with_polygon(corners):
    return GATE.replace(BOX, f"polygon = {corners}")


CAPSULE = "[[capsules]]\ncenter=[0,0,0]\nradius=1\nlength=1\n"
BAD = [
    ("schema = 1\n", "has no gate"),
    ("gates = [\n", "is not TOML"),
    ("gate = 3\n" + GATE, "key 'gate'.*Did you mean 'gates'"),
    (GATE.replace("gates", "gate"), "key 'gate' at the top is unknown. Did you mean 'gates'"),
    ("[[euler]]\nx = 1\n", "key 'euler' at the top is unknown. Allowed: "),
    (GATE + "yaw_deg = 9000\n", "yaw_deg is 9000, allowed is a number from -3600 to 3600"),
    (GATE + "yaw = 3\n", r"key 'yaw' in \[gates\[0\]\].*Did you mean 'yaw_deg'"),
    ("schema = 2\n" + GATE, "schema is 2, allowed is"),
    ("[[gates]]\ncenter=[0,0,1]\nwidth = 1\n", r"has no 'height'"),
    ("[[gates]]\ncenter=[0,0,1]\nwidht = 1\n", r"key 'widht' in .*Did you mean 'width'"),
    (GATE + "[[boxes]]\nsise = [1, 1, 1]\ncenter = [9, 9, 9]\n", "has no 'size'; add it"),
    ("[[gates]]\ncenter = [0, 0, 1]\n", "allowed is only one of: width and height"),
    *(
        (GATE + f"{key}\n", rf"\['width', 'height', '{key.split()[0]}'\], allowed is only one of:")
        for key in ("radius = 0.5", "corners = 12", "polygon = [[0, 1]]")
    ),
    (
        with_polygon("[[0, 1]]\ncorners = 3"),
        r"opening is \['corners', 'polygon'\], allowed is only",
    ),
    (GATE.replace(BOX, "corners = 12"), "has no 'radius'"),
    (GATE.replace("width = 1.0", 'width = "1"'), "width is '1'.*a number from 0.001"),
    (GATE.replace("1.5]", "nan]"), r"gates\[0\].center.*allowed is a list of 3 numbers"),
    (GATE + "frame_width = -0.1\n", "frame_width is -0.1.*from 0.001"),
    (GATE.replace("1.5]", "1e300]"), "each from -100000 to"),
    (GATE.replace("1.5]", "9" * 400 + "]"), r"characters\), allowed is a list of 3"),
    (GATE.replace("1.5]", "0.3]"), "at least 0.20 m higher"),
    (GATE.replace("1.0", "150"), r"opening is {'width': 150, 'height': 150}.* in metres; .*73.5 m"),
    (GATE.replace(BOX, "radius = 75"), "opening is {'radius': 75}, allowed is lengths in metres"),
    (GATE.replace(BOX, "radius = 1\ncorners = 2"), "corners is 2.*from 3 to 64"),
    (with_polygon("[[-1, -1], [1, -1], [0.1, 0], [1, 1], [-1, 1]]"), "polygon is.*convex"),
    (with_polygon("[[0, 1], [-0.6, -0.8], [0.95, 0.3], [-0.95, 0.3], [0.6, -0.8]]"), "convex"),
    (with_polygon("[[1, -1], [2, -1], [2, 1], [1, 1]]"), "around"),
    (with_polygon("[[0, 1e-10], [1e-10, -1e-10], [-1e-10, -1e-10]]"), "sides of 0.001 m at least"),
    (with_polygon("[[0, 1], [0, 2]]"), "list of 3 or more"),
    ("spheres = 3\n" + GATE, "spheres is 3, allowed is tables"),
    (GATE + "[[spheres]]\ncenter=[0,0,0]\nradius=0\n", r"spheres\[0\].radius is 0"),
    (GATE + "[[boxes]]\ncenter=[0,0,0]\nsize=[1,1,0]\n", r"boxes\[0\].size is \[1, 1, 0\]"),
    (GATE + CAPSULE + "axis=[0,0,0]\n", "of a length from 1e-06"),
    (GATE + "quat_wxyz = [1e200, 0, 0, 0]\n", r"quat_wxyz is .*to 1e\+06"),
    (GATE + "quat_wxyz = [1, 0, 0, 0]\nyaw_deg = 3\n", "yaw_deg is 3, allowed is only one of both"),
    (NAMED % "x" + NAMED[len(GATE) :] % "x", r"spheres\[1\].name is 'x'"),
    (NAMED % "ground", "'ground'"),
    (NAMED % "quadrotor box", "none of 'ground', 'parked', 'quadrotor box'"),
    (NAMED % "a\\u0000b", "a printable"),
    ("[start]\nposition = [0, 0, -1]\n" + GATE, "start.position.*above the ground"),
    (START + GATE + "[[boxes]]\ncenter=[0,0,0]\nsize=[3,3,3]\n", "start.position.*inside 'box 0'"),
    (START + GATE + CAPSULE, "inside 'capsule 0'"),
    (GATE + "pitch_deg = 90\n", "start.position is None.*straight up"),
    ("[start]\nyaw = 1\n" + GATE, r"key 'yaw' in \[start\]"),
    (GATE + '[[meshes]]\nfile = "none.stl"\n', "none.stl: no such mesh file"),
]


def test_a_bad_file_is_refused_by_name(tmp_path):
    for text, said in BAD:
        path = write(tmp_path, text)
        with pytest.raises(ValueError, match=said) as caught:
            load_track(path)
        assert str(tmp_path) in str(caught.value), said


def test_the_name_of_a_family_is_no_file_unless_there_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"zigzag: is a track family.*make_track\('zigzag'"):
        load_track("zigzag")
    write(tmp_path, GATE).rename("zigzag")
    assert load_track("zigzag").family == "zigzag"


def test_a_start_inside_a_mesh_is_refused_however_it_is_wound(tmp_path):
    place = "[start]\nposition = [0.4, 0, 1]\n"
    path = write(tmp_path, place + GATE + '[[meshes]]\nfile = "part.obj"\nposition=[0,0,1]\n')
    box = trimesh.creation.box((1, 1, 1))
    for faces in (box.faces, box.faces[:, ::-1]):
        trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "part.obj")
        with pytest.raises(ValueError, match="inside 'mesh 0'"):
            load_track(path)
    path = write(tmp_path, path.read_text().replace("0.4, 0, 1", "0.6, 0, 1"))
    assert load_track(path).start_pos_w[0] == 0.6


def test_parts_of_a_mesh_have_names_of_their_own(tmp_path):
    parts = [trimesh.creation.box((1, 1, 1)).apply_translation([x, 0, 0]) for x in (0, 3)]
    trimesh.util.concatenate(parts).export(tmp_path / "two.obj")
    mesh = '[[meshes]]\nname = "A"\nfile = "two.obj"\nposition = [0, 9, 1]\n'
    assert load_track(write(tmp_path, GATE + mesh)).names[-2:] == ("A part 0", "A part 1")
    box = '[[boxes]]\nname = "A part 0"\ncenter = [0, -9, 1]\nsize = [1, 1, 1]\n'
    with pytest.raises(ValueError, match=r"meshes\[0\].name is 'A'.*is called 'A part 0' already"):
        load_track(write(tmp_path, GATE + box + mesh))


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


@pytest.mark.parametrize(
    ("suffix", "key", "sides"),
    [("glb", "", [1, 3, 2]), ("glb", 'up = "z"', [1, 2, 3]), ("obj", 'up = "y"', [1, 3, 2])],
)
def test_a_mesh_with_y_up_is_turned(tmp_path, suffix, key, sides):
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation([0, 0, -9])  # z of the file is -y of the world
    box.export(tmp_path / f"box.{suffix}")
    text = GATE + f'[[meshes]]\nfile = "box.{suffix}"\nposition = [0, 0, 20]\n{key}\n'
    corners = load_track(write(tmp_path, text)).scene.triangles.reshape(-1, 3)
    center = [0, 0, 11] if "z" in key else [0, 9, 20]
    assert np.allclose(np.ptp(corners, axis=0), sides)
    assert np.allclose((corners.min(0) + corners.max(0)) / 2, center)


def test_parts_that_touch_are_objects_of_their_own(tmp_path):
    """As a decomposition into convex parts writes them."""
    left, right = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 2, 1))
    right.apply_translation([1, 0, 0])
    lines = []
    for number, mesh in enumerate([left, right]):
        lines += [f"o part {number}", *("v {} {} {}".format(*v) for v in mesh.vertices)]
        lines += ["f {} {} {}".format(*(face + 1 + 8 * number)) for face in mesh.faces]
    (tmp_path / "two.obj").write_text("\n".join(lines) + "\n")
    path = write(tmp_path, GATE + '[[meshes]]\nfile = "two.obj"\nposition = [0, 0, 1]\n')
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


def test_meshes_that_are_not_convex_open_flat_or_broken_are_refused(tmp_path):
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
    trimesh.Trimesh(good.vertices * [1, 1, 0], good.faces, process=False).export(
        tmp_path / "part.stl"
    )
    with pytest.raises(ValueError, match=r"part.stl: part \d of \d .* is flat; give it"):
        load_track(path)
    (tmp_path / "part.stl").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="part.stl"):
        load_track(path)


@pytest.mark.parametrize(
    ("size", "keys", "said"),
    [
        ((1, 1, 1e-7), "", "0.001 m thick .*; part 0 has "),
        ((1, 1, 1), "scale = 1e-4", "0.001 m thick .* part 0 has 0.0001"),
        ((1, 1, 1), "scale = 0.002\nposition = [9e4, 9e4, 9e4]", "thick at its position; part 0"),
        ((1, 1, 1), "scale = 1e6", r"within 100000 m .*; part 0 reaches 5e\+05"),
    ],
)
def test_meshes_that_mujoco_finds_no_body_are_refused(tmp_path, size, keys, said):
    """It stores corners as singles: far from the origin a small body is none."""
    path = write(tmp_path, GATE + f'[[meshes]]\nfile = "part.stl"\n{keys}\n')
    trimesh.creation.box(size).export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=rf"track.toml: meshes\[0\].scale is .* {said}"):
        load_track(path)


def test_a_gate_inside_a_solid_is_refused(tmp_path):
    """It can be flown by nobody; one whose opening stands out of the solid can."""
    start = "[start]\nposition = [-9, 0, 1]\n"
    box = '[[boxes]]\nname = "hall"\ncenter = [0, {y}, 1.5]\nsize = [2, 3, 3]\n'
    with pytest.raises(ValueError, match=r"gates\[0\].center is .*the opening is inside 'hall'"):
        load_track(write(tmp_path, GATE + start + box.format(y=0.0)))
    assert load_track(write(tmp_path, GATE + start + box.format(y=1.2))).names[-1] == "hall"


@pytest.mark.parametrize("kind", ["gates", "spheres", "meshes"])
def test_more_gates_and_solids_than_can_be_read_in_time_are_refused(tmp_path, kind):
    with pytest.raises(ValueError, match=rf"{kind} is 100[12], allowed is up to 1000 of them"):
        load_track(write(tmp_path, GATE + f"[[{kind}]]\n" * 1001))


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
    with pytest.raises(ValueError, match=r"model.gltf: takes more than 3 GB of memory"):
        load_convex_parts([gltf(tmp_path, count=1_500_000_000)])
    assert len(load_convex_parts([gltf(tmp_path)])[0][0]) == 12, "the next one is read"


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import time; time.sleep(100)", "cannot be read as a mesh within 0.5 s"),
        more("import os; os.abort()", "ended with -6"),
        more("import sys; sys.stdout.write('{'); sys.exit(3)", "to the end, its reader ended with"),
    ],
)
def test_a_reader_that_hangs_or_dies_is_named_and_replaced(tmp_path, monkeypatch, program, said):
    (tmp_path / "it.obj").write_text(CUBE)
    with monkeypatch.context() as patch:
        patch.setattr(mesh_reader, "READ_S", 0.5 if "sleep" in program else 60.0)
        patch.setattr(mesh_reader, "_PROGRAM", program)
        mesh_reader.end_process(mesh_reader._process())
        with pytest.raises(ValueError, match=f"it.obj: .*{said}"):
            load_convex_parts([tmp_path / "it.obj"])
    assert len(load_convex_parts([tmp_path / "it.obj"])[0][0]) == 12
