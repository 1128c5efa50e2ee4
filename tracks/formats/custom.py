"""Read a custom track from a TOML file: gates of any convex shape, solids, meshes, the start.

`tracks/examples/yard.toml` has every key. Positions are in the world frame in metres, angles in
degrees; relative paths of mesh files start at the TOML file's folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from tracks.common.toml_table import REQUIRED, Table, read_toml
from tracks.families import FAMILIES
from tracks.formats.convex_parts import thickness
from tracks.formats.mesh_reader import load_convex_parts
from tracks.geometry.gates import rectangle, regular_polygon, with_frames
from tracks.geometry.rotation import quat_to_rot
from tracks.geometry.scene import Boxes, Gates, Rods, Scene, Spheres
from tracks.input.ranges import as_path
from tracks.track import Track

if TYPE_CHECKING:
    import trimesh

START_BEHIND_M = 2.5
"""Default distance of the start before gate 0 [m]."""
FARTHEST_M = 1e5
"""Largest allowed coordinate, as in a flight log [m]."""
LEAST_M, MOST_M = 1e-3, 1e5
"""Smallest and largest allowed length [m]."""
OPENING_MOST_M = 20.0
"""Largest plausible opening of a gate [m]."""
ANGLE_MOST_DEG = 3600.0
"""Largest allowed angle, ten turns: the heading along a course may count its turns [deg]."""
MOST_TABLES = 1000
"""Largest number of gates, and of solids of each kind; so many are read in about a second."""
_RESERVED = (
    *("ground", "parked", "quadrotor box"),
    *(f"rotor_{number} {part}" for number in range(1, 5) for part in ("arm", "disk")),
)
"""Names that other geoms of the suite's MuJoCo models have."""
_TOP_KEYS = (
    *("schema", "name", "start", "gates"),
    *("boxes", "cylinders", "capsules", "spheres", "meshes"),
)
"""All keys at the top of a file."""
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
"""Keys of a rotation, instead of `quat_wxyz`."""
_OPENING_KEYS = ("width", "height", "radius", "corners", "polygon")
"""Keys of an opening; `_opening` has those that are given together."""
_GATE_KEYS = ("center", *_ANGLES, "quat_wxyz", *_OPENING_KEYS, "frame_width", "frame_depth")
"""All keys of a gate."""
_ROUNDING = 0.01
"""Share by which a mesh may be thinner than `LEAST_M`, because of rounding."""
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the axes of a mesh file with y up to axes with z up; x stays."""
_ROD_SHAPES = [(3,), (3,), (), ()]
"""Shapes of the values of a cylinder or capsule: centre, axis, radius, half length."""
_SINGULAR = {"boxes": "box", "meshes": "mesh"}
"""Singular of the keys that do not end in a plain s."""


def load_track(path: str | os.PathLike[str]) -> Track:
    """Return the track of a TOML file; its family is the file's `name`, level and seed are 0.

    Raises:
        ValueError: naming the file, the key, its value and what is allowed, where a key is
            missing, unknown, of the wrong shape or impossible (a gate below the ground, an
            opening or a mesh that is not convex, a start inside a solid).
    """
    file = as_path("path", path)
    if str(file) in FAMILIES and not file.exists():
        raise ValueError(
            f"{file}: is a track family, not a file; make_track({str(file)!r}, level, seed) draws "
            "one of its tracks"
        )
    top = read_toml(file)
    top.expect(_TOP_KEYS)
    top.whole("schema", 1, least=1, most=1)
    name = top.text("name", top.path.stem)
    gate_tables = _tables(top, "gates")
    if not gate_tables:
        raise ValueError(f"{top.path}: has no gate; add at least one [[gates]]")
    gates = _gates(gate_tables)
    start_pos_w, start_yaw = _start(top, gates)

    names = _Names([f"gate {i} frame" for i in range(len(gate_tables))])
    boxes, box_names = _solids_of_kind(top, "boxes", _box, [(3,), (3, 3), (3,)], names)
    cylinders, cylinder_names = _solids_of_kind(top, "cylinders", _rod, _ROD_SHAPES, names)
    capsules, capsule_names = _solids_of_kind(top, "capsules", _rod, _ROD_SHAPES, names)
    spheres, sphere_names = _solids_of_kind(top, "spheres", _sphere, [(3,), ()], names)
    meshes, mesh_names = _meshes(top, names)

    all_boxes, frame_names = with_frames(gates, Boxes(*boxes))
    triangles = np.concatenate([np.zeros((0, 3, 3)), *meshes])
    rods = Rods(*cylinders), Rods(*capsules)
    scene = Scene(gates, all_boxes, *rods, Spheres(*spheres), triangles)
    solid_names = (*box_names, *cylinder_names, *capsule_names, *sphere_names, *mesh_names)
    sizes = tuple(len(mesh) for mesh in meshes)
    all_names = (*frame_names, *solid_names)
    track = Track(name, 0, 0, 0.0, scene, start_pos_w, start_yaw, all_names, sizes)
    _refuse_inside(top, track, frame_names)
    return track


class _Names:
    """Gives every solid a unique name and refuses duplicates."""

    def __init__(self, used: list[str]) -> None:
        self._used = set(used)

    def __call__(self, table: Table, kind: str, number: int) -> str:
        """Return the name of solid `number` of a kind: the table's, or one made of the kind."""
        name = table.text("name", f"{_SINGULAR.get(kind, kind[:-1])} {number}")
        if name in self._used or name in _RESERVED or "/" in name or not name.isprintable():
            reserved = ", ".join(map(repr, _RESERVED))
            raise table.error(
                "name",
                name,
                f"a printable name no other solid has, without '/', none of {reserved}",
            )
        self._used.add(name)
        return name

    def part(self, table: Table, name: str, part: int) -> str:
        """Return the name of a part of the solid `name`."""
        label = f"{name} part {part}"
        if label in self._used:
            raise table.error("name", name, f"another name: a solid is called {label!r} already")
        self._used.add(label)
        return label


def _tables(top: Table, kind: str) -> list[Table]:
    tables = top.tables(kind)
    if len(tables) > MOST_TABLES:
        raise top.error(kind, len(tables), f"up to {MOST_TABLES} of them")
    return tables


def _solids_of_kind(
    top: Table, kind: str, read: Callable[[Table], tuple], shapes: list[tuple], names: _Names
) -> tuple[list[np.ndarray], list[str]]:
    """Return the columns and the names of all solids of a kind.

    `read` returns the values of one table, whose `shapes` empty columns have as well.
    """
    rows, labels = [], []
    for number, table in enumerate(_tables(top, kind)):
        rows.append(read(table))
        labels.append(names(table, kind, number))
        table.close()
    if not rows:
        return [np.zeros((0, *shape)) for shape in shapes], []
    return [np.array(column) for column in zip(*rows, strict=True)], labels


def _gates(tables: list[Table]) -> Gates:
    """Return the gates of the tables [[gates]]; all openings get the same number of corners."""
    rows, openings = [], []
    for table in tables:
        table.expect(_GATE_KEYS)
        center, rot = _place(table, "center"), rotation(table)
        opening = _opening(table)
        width = _length(table, "frame_width", 0.2)
        depth = _length(table, "frame_depth", 0.05)
        table.close()
        lowest = (center[2] + opening @ rot[2, 1:]).min()
        if lowest < 0:
            raise _below_ground(table, float(-lowest), float(np.ptp(opening, axis=0).max()))
        rows.append((center, rot, width, depth))
        openings.append(opening)
    corners = max(map(len, openings))
    padded = [np.concatenate([o, np.tile(o[-1], (corners - len(o), 1))]) for o in openings]
    center, rot, width, depth = (np.array(column) for column in zip(*rows, strict=True))
    return Gates(center, rot, np.array(padded), width, depth)


def _below_ground(table: Table, depth_m: float, size_m: float) -> ValueError:
    """Return the error for an opening of a size that reaches to a depth below the ground."""
    if size_m <= OPENING_MOST_M:
        allowed = f"at least {depth_m:.2f} m higher: the opening reaches below the ground"
        return table.error("center", table.values["center"], allowed)
    given = {key: table.values[key] for key in _OPENING_KEYS if key in table.values}
    allowed = f"lengths in metres; the opening is {size_m:g} m long and reaches {depth_m:g} m"
    return table.error("opening", given, f"{allowed} below the ground: is it in centimetres?")


def _opening(table: Table) -> np.ndarray:
    """Return the corners (V, 2) of one of: width and height; corners and radius; polygon."""
    keys = [key for key in _OPENING_KEYS if table.has(key)]
    kinds = ({"width", "height"}, {"radius", "corners"}, {"polygon"})
    if not keys or not any(kind.issuperset(keys) for kind in kinds):
        raise table.error(
            "opening",
            keys,
            "only one of: width and height; radius with corners (of a regular polygon); polygon",
        )
    if keys[0] in ("width", "height"):
        return rectangle(_length(table, "width"), _length(table, "height"))
    if keys[0] != "polygon":
        corners = table.whole("corners", 12, least=3, most=64)
        return regular_polygon(corners, _length(table, "radius"))
    return _convex(table, table.points("polygon", 2, least=3, most=MOST_M))


def _convex(table: Table, polygon: np.ndarray) -> np.ndarray:
    """Return the corners (V, 2) counter-clockwise; refuse them if not convex or self-crossing."""
    side = np.roll(polygon, -1, axis=0) - polygon
    next_side = np.roll(side, -1, axis=0)
    turn_at_corner = np.arctan2(_cross(side, next_side), np.sum(side * next_side, axis=-1))
    if np.linalg.norm(side, axis=-1).min() < LEAST_M:
        allowed = f"sides of {LEAST_M:g} m at least"
        raise table.error("polygon", polygon.tolist(), allowed)
    one_direction = (turn_at_corner > 1e-6).all() or (turn_at_corner < -1e-6).all()
    if not one_direction or not np.isclose(abs(turn_at_corner.sum()), 2 * np.pi):
        allowed = "the corners [y, z] of a convex polygon in order, no three of them in line"
        raise table.error("polygon", polygon.tolist(), allowed)
    if turn_at_corner[0] < 0:
        polygon = polygon[::-1]
    if (_cross(polygon, np.roll(polygon, -1, axis=0)) <= 0).any():
        raise table.error("polygon", polygon.tolist(), "corners around [0, 0], the gate's centre")
    return polygon


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products (V,) of vectors (V, 2) in a plane."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def rotation(table: Table) -> np.ndarray:
    """Return the rotation (3, 3), local to world, that a table gives.

    Its keys are `quat_wxyz`, or `yaw_deg`, `pitch_deg` and `roll_deg`, applied in this order. Pitch
    is positive nose up, roll positive right side down, body axes forward-left-up.
    """
    if table.has("quat_wxyz"):
        for key in filter(table.has, _ANGLES):
            allowed = "only one of both: the angles, or quat_wxyz, which is given too"
            raise table.error(key, table.values[key], allowed)
        return quat_to_rot(_unit(table, "quat_wxyz", table.vector("quat_wxyz", 4)))
    angles = np.deg2rad([_angle(table, key, 0.0) for key in _ANGLES])
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    pitch = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return yaw @ pitch @ roll


def _place(table: Table, key: str, default: Iterable[float] = REQUIRED) -> np.ndarray:
    return table.vector(key, 3, default, least=-FARTHEST_M, most=FARTHEST_M)


def _length(table: Table, key: str, default: float = REQUIRED) -> float:
    return table.number(key, default, least=LEAST_M, most=MOST_M)


def _angle(table: Table, key: str, default: float) -> float:
    return table.number(key, default, least=-ANGLE_MOST_DEG, most=ANGLE_MOST_DEG)


def _unit(table: Table, key: str, vector: np.ndarray) -> np.ndarray:
    length = math.hypot(*vector)
    if not 1e-6 <= length <= 1e6:
        raise table.error(key, vector.tolist(), "a vector of a length from 1e-06 to 1e+06")
    return vector / length


def _start(top: Table, gates: Gates) -> tuple[np.ndarray, float]:
    """Return the start's position (3,) [m] and heading [rad]: the file's, or before gate 0."""
    ahead = gates.rot_w[0, :, 0] * [1.0, 1.0, 0.0]
    level = np.linalg.norm(ahead)
    pos_w = gates.center_w[0] - START_BEHIND_M * ahead / max(level, 1e-9)
    table = top.table("start", {})
    if level < 1e-6 and not table.has("position"):
        raise table.error("position", None, "a position: gate 0 is flown straight up or down")
    pos_w = _place(table, "position", pos_w.tolist())
    if pos_w[2] <= 0:
        raise table.error("position", pos_w.tolist(), "a position above the ground (z > 0)")
    to_gate = gates.center_w[0] - pos_w
    yaw_deg = _angle(table, "yaw_deg", float(np.rad2deg(np.arctan2(to_gate[1], to_gate[0]))))
    table.close()
    return pos_w, float(np.deg2rad(yaw_deg))


def _refuse_inside(top: Table, track: Track, frame_names: list[str]) -> None:
    """Refuse a start inside a solid, and a gate whose whole opening is inside a solid."""
    # Imported here, because trimesh takes long to import and only custom tracks need it.
    from tracks.formats.meshes import solid_meshes

    gates, frames = track.scene.gates, set(frame_names)
    corners_w = gates.center_w[:, None] + gates.opening_g @ np.swapaxes(gates.rot_w[:, :, 1:], 1, 2)
    for name, mesh in solid_meshes(track):
        if is_inside(mesh, track.start_pos_w):
            allowed = f"a position outside of every solid; this one is inside {name!r}"
            raise top.error("start.position", track.start_pos_w.tolist(), allowed)
        if name in frames:
            continue
        # A solid is convex: if it contains an opening's corners, it contains the opening.
        blocked = is_inside(mesh, corners_w).all(axis=-1)
        if blocked.any():
            gate = int(np.argmax(blocked))
            allowed = f"a place outside of every solid; the opening is inside {name!r}"
            raise top.error(f"gates[{gate}].center", gates.center_w[gate].tolist(), allowed)


def is_inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Return which points (..., 3) are inside a convex mesh."""
    origin = np.asarray(mesh.triangles)[:, 0]
    side = np.sum((points[..., None, :] - origin) * mesh.face_normals, axis=-1)
    # A point inside is on the same side of every face; the sign depends on the winding.
    return np.all(side < 0, axis=-1) | np.all(side > 0, axis=-1)


def _box(table: Table) -> tuple:
    """Return centre, rotation and half size of a box."""
    return (
        _place(table, "center"),
        rotation(table),
        table.vector("size", 3, least=LEAST_M, most=MOST_M) / 2,
    )


def _rod(table: Table) -> tuple:
    """Return centre, axis, radius and half length of a cylinder or capsule."""
    axis = _unit(table, "axis", table.vector("axis", 3, (0.0, 0.0, 1.0)))
    radius, length = _length(table, "radius"), _length(table, "length")
    return _place(table, "center"), axis, radius, length / 2


def _sphere(table: Table) -> tuple:
    return _place(table, "center"), _length(table, "radius")


def _meshes(top: Table, names: _Names) -> tuple[list[np.ndarray], list[str]]:
    """Return the triangles (M, 3, 3), in world axes, and the name of each convex part of meshes."""
    placed = []
    for number, table in enumerate(_tables(top, "meshes")):
        file = top.path.parent / table.text("file")
        position, rot = _place(table, "position", (0.0, 0.0, 0.0)), rotation(table)
        scale = table.number("scale", 1.0, least=1e-6, most=1e6)
        is_gltf = file.suffix.lower() in (".glb", ".gltf")  # y is up in the glTF standard
        if table.choice("up", ("y", "z") if is_gltf else ("z", "y")) == "y":
            rot = rot @ _Y_UP
        placed.append((table, file, position, rot, scale, names(table, "meshes", number)))
        table.close()
    meshes, labels = [], []
    files = load_convex_parts([file for _, file, *_ in placed])
    for (table, _, position, rot, scale, name), parts in zip(placed, files, strict=True):
        for part, triangles in enumerate(parts):
            mesh = scale * triangles @ rot.T + position
            _check_mesh(table, scale, part, mesh)
            meshes.append(mesh)
            labels.append(name if len(parts) == 1 else names.part(table, name, part))
    return meshes, labels


def _check_mesh(table: Table, scale: float, part: int, mesh: np.ndarray) -> None:
    """Refuse a part (M, 3, 3) that is too far away or, in MuJoCo's float32, too thin."""
    reach_m = float(np.abs(mesh).max())
    if not reach_m <= FARTHEST_M:
        allowed = f"one that leaves every part within {FARTHEST_M:g} m of the origin on each axis"
        raise table.error("scale", scale, f"{allowed}; part {part} reaches {reach_m:.3g}")
    thick_m = thickness(mesh.astype(np.float32).astype(float))
    if thick_m < (1.0 - _ROUNDING) * LEAST_M:
        allowed = f"one that makes every part at least {LEAST_M:g} m thick at its position"
        raise table.error("scale", scale, f"{allowed}; part {part} has {thick_m:.2g}")
