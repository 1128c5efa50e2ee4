"""Read mapping files (TOML), which name the columns, units and frames of each signal of a log.

Each table describes a signal. Several tables of one name, such as `[[pos]]`, are alternatives: the
first one whose columns the log has is used. docs/import.md shows a mapping with every key.
Mappings that come with the suite are selected by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import BODIES, WORLDS
from eval.logs.columns import GROUPS, KNOWN
from eval.logs.faults.reading import DEG, RPM, TIMES
from eval.logs.files import METADATA
from tracks.common.names import unknown_name
from tracks.common.toml_table import Table, read_toml, shipped_names

SHIPPED = Path(__file__).resolve().parent / "mappings"
"""Folder of the mapping files that come with the suite."""
_LENGTH = {"m": 1.0, "cm": 0.01, "mm": 1e-3}
_BODY_RATE = {"rad/s": 1.0, "deg/s": DEG, "mrad/s": 1e-3}
_ANGLE = {"rad": 1.0, "deg": DEG}
_ACCELERATION = {"m/s^2": 1.0, "g": GRAVITY}
_ROTOR_SPEED = {"rad/s": 1.0, "rpm": RPM, "Hz": float(2.0 * np.pi)}
_FRACTION = {"1": 1.0, "%": 0.01, "65535": 1.0 / 65535.0}
"""Tables of units of length, body rate, ...: unit -> factor to the unit of the flight log."""
PER_MASS = "N"
"""Unit of a thrust command that the import divides by the mass; other units are per mass."""
UNITS: dict[str, dict[str, float]] = {
    "time": TIMES,
    "pos": _LENGTH,
    "quat": {"1": 1.0},
    "euler": _ANGLE,
    "vel": {f"{unit}/s": factor for unit, factor in _LENGTH.items()},
    "rate": _BODY_RATE,
    "cmd_rate": _BODY_RATE,
    "cmd_quat": {"1": 1.0},
    "cmd_euler": _ANGLE,
    "cmd_thrust": _ACCELERATION | {PER_MASS: 1.0},
    "cmd_torque": {"N m": 1.0},
    "throttle": _FRACTION,
    "acc": _ACCELERATION,
    "motor": _ROTOR_SPEED,
    "motor_cmd": _ROTOR_SPEED,
    "pwm": _FRACTION,
    "voltage": {"V": 1.0, "mV": 1e-3},
}
"""Signal -> unit -> factor to the flight log's unit; the first unit is the default."""
WIDTHS = {name: len(GROUPS[name]) if name in GROUPS else 3 for name in UNITS} | {
    "throttle": 1,
    "cmd_quat": 4,
}
"""Number of columns of each signal."""
AXES = {"vel": ("world", "body"), "rate": ("body", "world"), "acc": ("body", "world")}
"""Signals with a choice of axes; the flight log's axes come first."""
MIXERS: dict[str, np.ndarray] = {
    "crazyflie": np.array(
        [
            [1.0, -0.5, 0.5, 1.0],
            [1.0, -0.5, -0.5, -1.0],
            [1.0, 0.5, -0.5, 1.0],
            [1.0, 0.5, 0.5, -1.0],
        ]
    )
}
"""Mixer matrices (4, 4): rows are motors, columns thrust, roll, pitch and yaw. Crazyflie: the
firmware's legacy power distribution, in which roll and pitch have a weight of one half."""
SOURCES = ("mocap", "estimate")
"""Sources of a pose in a file that holds both: raw motion capture, or a state estimator."""


@dataclass(frozen=True)
class Column:
    """The columns of one signal, and their conversion."""

    names: tuple[str, ...]
    """Columns in the flight log's order (quaternions: wxyz); one column if its cells hold lists."""
    factor: tuple[float, ...]
    """Factors from each column's unit and sign to the flight log's."""
    other_axes: bool = False
    """Whether the signal has the second choice of `AXES`."""
    gravity: bool = True
    """Whether an acceleration in world axes is a specific force (at rest 9.81 m/s^2 upwards);
    False: it is the derivative of the velocity."""
    inverse: bool = False
    """Whether a quaternion rotates world axes to body axes; False: body axes to world axes."""
    per_mass: bool = True
    """Whether a thrust is divided by the mass; False: it is in N."""
    mixer: str = ""
    """One of `MIXERS` where the columns are thrust, roll, pitch and yaw; empty: one per motor."""
    source: str = ""
    """One of `SOURCES`, or empty where the mapping does not name the source."""


@dataclass(frozen=True)
class LogMap:
    """The contents of a mapping file."""

    columns: Mapping[str, tuple[Column, ...]] = field(default_factory=dict)
    """Signal -> its alternatives, the preferred one first."""
    world: str = "z-up"
    """World frame of the log, one of `frames.WORLDS`."""
    body: str = "flu"
    """Body frame of the log, one of `frames.BODIES`."""
    motor_side: tuple[tuple[float, float], ...] | None = None
    """Positions of the file's motors 1 to 4 (x forward, y left), in any unit; None: unknown."""
    optional: bool = False
    """Whether missing signals and columns are left out; otherwise they are an error."""
    keep: tuple[str, ...] = ()
    """Columns that are kept unchanged."""
    text_file: str = ""
    """Name of a text file in the log's folder with lines `key: value`. In the name, {stem} stands
    for the log's name without its ending, and {number} for the digits in {stem}."""
    mass_key: str = ""
    """Key of the mass [kg] in the text file."""


def map_file(path: Path) -> Path:
    """Return the path of a mapping file, or of a shipped one by its name.

    Raises:
        ValueError: for a name that is neither a file nor a shipped mapping.
    """
    if path.suffix or len(path.parts) > 1 or path.is_file():
        return path
    if path.name not in (known := shipped_names(SHIPPED)):
        raise unknown_name("mapping (or file)", path.name, known)
    return SHIPPED / f"{path.name}.toml"


def read_map(path: Path) -> LogMap:
    """Read a mapping file, or a shipped one by its name.

    Raises:
        ValueError: naming the file, the key, its value and what is allowed.
    """
    top = read_toml(map_file(path))
    frames = top.table("frames", {})
    world, body = frames.choice("world", WORLDS), frames.choice("body", BODIES)
    side = motor_side_of(frames)
    frames.close()
    columns = {signal: _alternatives(signal, top) for signal in UNITS if top.has(signal)}
    text_file = mass_key = ""
    if top.has("about"):
        about = top.table("about")
        text_file = about.text("file")
        try:
            text_file.format(stem="", number="")
        except (KeyError, IndexError, ValueError, AttributeError):
            allowed = "a name with no braces but {stem} and {number}"
            raise about.error("file", text_file, allowed) from None
        mass_key = about.text("mass") if about.has("mass") else ""
        about.close()
    optional = top.choice("optional", ("no", "yes")) == "yes"
    keep = tuple(top.texts("keep")) if top.has("keep") else ()
    reserved = [name for name in keep if name in KNOWN or name in ("throttle", METADATA)]
    if reserved:
        allowed = f"columns whose names are not a flight log's own, as {reserved[0]!r} is"
        raise top.error("keep", list(keep), allowed)
    top.has("topics")  # allow the table, which the MCAP reader uses (mcap.py)
    top.close()
    return LogMap(columns, world, body, side, optional, keep, text_file, mass_key)


def motor_side_of(frames: Table) -> tuple[tuple[float, float], ...] | None:
    """Return the positions of the file's motors 1 to 4 from the table `[frames]`; None if absent.

    Raises:
        ValueError: where the entry is not four different points apart from the centre.
    """
    if not frames.has("motors"):
        return None
    points = frames.points("motors", 2, 4)
    if len(np.unique(points[:4], axis=0)) < 4 or not points.any(axis=1).all():
        raise frames.error("motors", points.tolist(), "four different points off the middle")
    return tuple((float(x), float(y)) for x, y in points)[:4]


def own_map(columns: Mapping[str, np.ndarray]) -> LogMap:
    """Return the mapping of a flight log's columns; other columns of numbers are kept."""
    present = {
        group: (Column(names, (1.0,) * len(names)),)
        for group, names in GROUPS.items()
        if all(name in columns for name in names)
    }
    if "throttle" in columns:
        present["throttle"] = (Column(("throttle",), (1.0,)),)
    others = (name for name, v in columns.items() if name not in KNOWN and v.dtype.kind in "fiub")
    return LogMap(present, keep=tuple(name for name in others if name != "throttle"))


def _alternatives(signal: str, top: Table) -> tuple[Column, ...]:
    """Return the alternatives of one signal: its list of tables, or its only table."""
    try:
        tables = top.tables(signal)
    except ValueError:
        tables = [top.table(signal)]
    columns = tuple(_column(signal, table) for table in tables)
    for table in tables:
        table.close()
    return columns


def _column(signal: str, table: Table) -> Column:
    """Read one table of a mapping: columns, unit, sign and scale, and the keys of its signal."""
    width = WIDTHS[signal]
    is_list_column = width == 1 or table.has("column")
    names = [table.text("column")] if is_list_column else table.texts("columns")
    if not is_list_column and len(names) != width:
        raise table.error("columns", names, f"{width} column names")
    if len({*names}) < len(names):
        raise table.error("columns", names, f"{width} different column names")
    unit = table.choice("unit", tuple(UNITS[signal]))
    sign = table.vector("sign", width, [1.0] * width)
    if not np.all(np.abs(sign) == 1.0):
        raise table.error("sign", sign.tolist(), "1 or -1 for each column")
    scale = table.number("scale", 1.0, above=0.0)
    inverse = has_other_axes = False
    gravity, mixer, source = True, "", ""
    if signal in ("quat", "cmd_quat"):
        if table.choice("order", ("wxyz", "xyzw")) == "xyzw":
            order = [3, 0, 1, 2]
            # `column[3]`, `column[0]`, ... are entries of the cells' lists.
            names = [f"{names[0]}[{k}]" if is_list_column else names[k] for k in order]
            sign = sign[order]
        inverse = table.choice("maps", ("body to world", "world to body")) == "world to body"
    if signal in AXES:
        has_other_axes = table.choice("axes", AXES[signal]) != AXES[signal][0]
    if signal == "acc" and has_other_axes:
        gravity = table.choice("gravity", ("specific force", "removed")) == "specific force"
    if signal == "pwm" and table.has("mixer"):
        mixer = table.choice("mixer", tuple(MIXERS))
    if signal in ("pos", "quat", "euler", "vel") and table.has("source"):
        source = table.choice("source", SOURCES)
    factor = tuple(float(s) * scale * UNITS[signal][unit] for s in sign)
    return Column(
        tuple(names), factor, has_other_axes, gravity, inverse, unit != PER_MASS, mixer, source
    )
