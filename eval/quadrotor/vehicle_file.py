"""The vehicle file (TOML): read, checked by key, written.

What a file may hold is in docs/vehicle.md; every refusal names the file, the key, the value and
what is allowed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from eval.effects import EFFECTS, find_effect
from eval.effects.interface import Effect, at
from eval.quadrotor.loops import KINDS, NOMINAL
from eval.vehicles.vehicle import CollisionBox, Controller, MotorMap, Rotors, Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from tracks.common.files import write_text
from tracks.common.names import LONGEST, closest, unknown_name
from tracks.common.toml_table import to_toml
from tracks.geometry.camera import Camera
from tracks.input.ranges import is_number, shown
from tracks.input.reading import InputError, read_toml, reason

SCHEMA = 1
SHIPPED = Path(__file__).resolve().parents[1] / "vehicles"

KEYS = (
    *("name", "schema", "mass", "inertia", "rotors", "controller"),
    *("motors", "body", "camera", "effects"),
)


class VehicleFileError(ValueError):
    """A vehicle file that cannot be used; the message says where and what is allowed."""


def shipped_vehicles() -> list[str]:
    """Return the names of the vehicles that come with the suite."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def load_vehicle(source: str | os.PathLike[str]) -> Vehicle:
    """Return the vehicle of a file, or a shipped one by its name.

    Args:
        source: a path (it ends in .toml, has a folder or exists) or a shipped name.

    Raises:
        VehicleFileError: for what the file says or lacks.
        ValueError: for a name that is neither.
    """
    path = Path(source)
    if path.suffix != ".toml" and len(path.parts) == 1 and not path.is_file():
        if str(source) not in shipped_vehicles():
            raise unknown_name("vehicle (or file)", str(source), shipped_vehicles())
        path = SHIPPED / f"{source}.toml"
    try:
        table = read_toml(path)
    except FileNotFoundError as error:
        known = ", ".join(shipped_vehicles())
        raise VehicleFileError(f"{path}: no such file; shipped by name: {known}") from error
    except OSError as error:
        raise VehicleFileError(f"{path}: cannot be read: {reason(error)}") from error
    except InputError as error:
        raise VehicleFileError(str(error)) from error
    try:
        return parse_vehicle(table)
    except ValueError as error:
        raise VehicleFileError(f"{path}: {error}") from error


def parse_vehicle(table: Mapping[str, Any]) -> Vehicle:
    """Return the vehicle that a file's `table` describes.

    Raises:
        ValueError: with the key, the value and what is allowed.
    """
    _known_keys("", table, KEYS)
    schema = table.get("schema", SCHEMA)
    if schema is True or schema != SCHEMA:
        raise ValueError(f"schema = {shown(schema)}: this version of the suite reads {SCHEMA}")
    name = _required("", table, "name")
    if not isinstance(name, str) or not name:
        raise ValueError(f"name = {shown(name)}: must be a text that is not empty")
    vehicle = Vehicle(
        name=name,
        mass=_number("mass", _required("", table, "mass")),
        inertia=_numbers("inertia", _required("", table, "inertia"), 3),
        rotors=_rotors(_section(table, "rotors")),
        controller=_controller(_section(table, "controller")),
        body=_body(_section(table, "body", needed=False)),
        camera=_camera(_section(table, "camera", needed=False)),
        motors=_motors(_section(table, "motors")) if "motors" in table else None,
    )
    check_vehicle(vehicle)
    effects = _section(table, "effects", needed=False)
    return replace(vehicle, effects=MappingProxyType(_effects(effects, vehicle)))


def save_vehicle(vehicle: Vehicle, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write `vehicle` as a file that `load_vehicle` reads back equal, whole or not at all.

    Args:
        vehicle: what to write; it is checked as a file would be.
        path: where to.
        comment: lines for the head of the file.

    Raises:
        ValueError: for a vehicle that could not be read back.
    """
    table = vehicle_table(vehicle)
    parse_vehicle(table)
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    write_text(path, head + to_toml(table))


def vehicle_table(vehicle: Vehicle) -> dict[str, Any]:
    """Return `vehicle` as the nested table of its file: strings, numbers, lists and dicts."""
    camera, effects = vehicle.camera, {}
    for name in EFFECTS:
        if name in vehicle.effects:
            values = vehicle.effects[name]
            write = EFFECTS[name].write or (lambda values: _plain(values._asdict()))
            effects[name] = write(values)
    return {
        "name": vehicle.name,
        "schema": SCHEMA,
        "mass": vehicle.mass,
        "inertia": list(vehicle.inertia),
        "rotors": {**_plain(vars(vehicle.rotors)), "spin": list(vehicle.rotors.spin)},
        "controller": _controller_table(vehicle.controller),
        "body": _plain(vars(vehicle.body)),
        "camera": {
            "pitch_deg": camera.pitch_deg,
            "fov_deg": list(camera.fov_deg),
            "range": camera.range_m,
        },
        **({"motors": _plain(vars(vehicle.motors))} if vehicle.motors else {}),
        **({"effects": effects} if effects else {}),
    }


def _effects(tables: Mapping[str, Any], vehicle: Vehicle) -> dict[str, Any]:
    values = {}
    for name, table in tables.items():
        effect = find_effect(name)
        if not isinstance(table, Mapping):
            raise ValueError(f"effects.{name} = {shown(table)}: must be a table [effects.{name}]")
        if effect.read:
            try:
                values[name] = effect.read(table)
            except ValueError as error:
                raise ValueError(f"effects.{name}: {error}") from error
        else:
            values[name] = _effect_values(effect, table, vehicle)
        check_bounds(effect, values[name], vehicle)
    return values


def _effect_values(effect: Effect, table: Mapping[str, Any], vehicle: Vehicle) -> Any:
    where = f"effects.{effect.name}."
    _known_keys(where, table, [parameter.name for parameter in effect.parameters])
    if not table:
        names = " or ".join(parameter.name for parameter in effect.parameters)
        raise ValueError(f"effects.{effect.name}: empty; give {names}")
    values = []
    for parameter in effect.parameters:
        key = where + parameter.name
        if parameter.name not in table and not parameter.required:
            number = at(parameter.neutral, vehicle)
            values.append((number,) * parameter.size if parameter.size else number)
        elif parameter.size:
            entry = _required(where, table, parameter.name)
            values.append(_numbers(key, entry, parameter.size))
        else:
            values.append(_number(key, _required(where, table, parameter.name)))
    return effect.values(*values)


def check_bounds(effect: Effect, values: Any, vehicle: Vehicle) -> None:
    """Refuse values of `effect` that are not finite or not physical on `vehicle`.

    Raises:
        ValueError: with the key, the value and the bounds.
    """
    for parameter, value in zip(effect.parameters, values, strict=True):
        low, high = at(parameter.low, vehicle), at(parameter.high, vehicle)
        for number in value if parameter.size else (value,):
            if not (math.isfinite(number) and low <= number <= high):
                raise ValueError(
                    f"effects.{effect.name}.{parameter.name} = {_plain(value)}: "
                    f"must be from {low:g} to {high:g} {parameter.unit}"
                )


def _rotors(table: Mapping[str, Any]) -> Rotors:
    where = "rotors."
    names = list(Rotors.__dataclass_fields__)
    _known_keys(where, table, names)
    hubs = _required(where, table, "position")
    if not isinstance(hubs, list) or len(hubs) != 4:
        raise ValueError(
            f"rotors.position = {shown(hubs)}: must be a list of 4 lists of 3 numbers [m]"
        )
    spin = _numbers("rotors.spin", _required(where, table, "spin"), 4)
    if any(direction not in (1, -1) for direction in spin):
        raise ValueError(
            f"rotors.spin = {_plain(spin)}: must be 1 (counter-clockwise from above) or -1 each"
        )
    first, second, third, fourth = (
        _numbers(f"rotors.position[{i}]", hub, 3) for i, hub in enumerate(hubs)
    )
    a, b, c, d = (int(direction) for direction in spin)
    scalars = {key: _number(where + key, _required(where, table, key)) for key in names[2:]}
    return Rotors((first, second, third, fourth), (a, b, c, d), **scalars)


def _controller(table: Mapping[str, Any]) -> Controller:
    where = "controller."
    kind = table.get("kind", NOMINAL)
    if not isinstance(kind, str) or kind not in (NOMINAL, *KINDS):
        allowed = ", ".join((NOMINAL, *KINDS))
        raise ValueError(f"controller.kind = {shown(kind)}: allowed: {allowed}")
    settings, own = None, set()
    if kind != NOMINAL:
        settings, own = _settings(kind, table)
    known = [key for key in Controller.__dataclass_fields__ if key != "settings"]
    _known_keys(where, {k: v for k, v in table.items() if k not in own}, [*known, *sorted(own)])
    given = {
        key: _numbers(where + key, table[key], 3)
        for key in ("attitude_gain", "rate_max")
        if key in table
    }
    gain = (1.0, 1.0, 1.0)
    if kind == NOMINAL or "rate_gain" in table:
        gain = _numbers(where + "rate_gain", _required(where, table, "rate_gain"), 3)
    return Controller(
        rate_gain=gain,
        frequency=_number(where + "frequency", _required(where, table, "frequency")),
        kind=kind,
        settings=settings,
        **given,
    )


def _settings(kind: str, table: Mapping[str, Any]) -> tuple[Any, set[str]]:
    """Return a firmware's settings, and the keys of [controller] that are theirs."""
    module, where, given = KINDS[kind], "controller.", table
    keys = list(module.Settings.__dataclass_fields__)
    own = set(keys)
    if module.GROUP:
        where, own = f"controller.{module.GROUP}.", {module.GROUP}
        given = table.get(module.GROUP, {})
        if not isinstance(given, Mapping):
            raise ValueError(f"{where[:-1]} = {shown(given)}: must be a table [{where[:-1]}]")
        _known_keys(where, given, keys)
    values = {key: _number(where + key, given[key]) for key in keys if key in given}
    for key, value in values.items():
        low, high = module.LIMITS.get(key, (0.0, 1e6))
        if not low <= value <= high:
            raise ValueError(f"{where}{key} = {value:g}: must be from {low:g} to {high:g}")
    return module.Settings(**values), own


def _controller_table(controller: Controller) -> dict[str, Any]:
    table = _plain({k: v for k, v in vars(controller).items() if k not in ("kind", "settings")})
    if controller.kind == NOMINAL:
        return table
    settings, group = _plain(vars(controller.settings)), KINDS[controller.kind].GROUP
    return {"kind": controller.kind, **table, **({group: settings} if group else settings)}


def _motors(table: Mapping[str, Any]) -> MotorMap:
    where = "motors."
    _known_keys(where, table, list(MotorMap.__dataclass_fields__))
    thrust = _numbers(where + "thrust", _required(where, table, "thrust"), 2)
    scalars = {
        key: _number(where + key, table[key])
        for key in ("voltage", "voltage_exponent")
        if key in table
    }
    _required(where, table, "voltage")
    return MotorMap(thrust, **scalars)


def _body(table: Mapping[str, Any]) -> CollisionBox:
    _known_keys("body.", table, ["half_size"])
    return CollisionBox(**{key: _numbers(f"body.{key}", table[key], 3) for key in table})


def _camera(table: Mapping[str, Any]) -> Camera:
    _known_keys("camera.", table, ["pitch_deg", "fov_deg", "range"])
    camera = Camera()
    if "pitch_deg" in table:
        camera = replace(camera, pitch_deg=_number("camera.pitch_deg", table["pitch_deg"]))
    if "fov_deg" in table:
        camera = replace(camera, fov_deg=_numbers("camera.fov_deg", table["fov_deg"], 2))
    if "range" in table:
        camera = replace(camera, range_m=_number("camera.range", table["range"]))
    return camera


def _section(table: Mapping[str, Any], key: str, needed: bool = True) -> Mapping[str, Any]:
    section = _required("", table, key) if needed else table.get(key, {})
    if not isinstance(section, Mapping):
        raise ValueError(f"{key} = {shown(section)}: must be a table [{key}]")
    return section


def _required(where: str, table: Mapping[str, Any], key: str) -> Any:
    if key not in table:
        raise ValueError(f"{where}{key}: missing; it must be given")
    return table[key]


def _known_keys(where: str, table: Mapping[str, Any], allowed: Any) -> None:
    for key in table:
        if key not in allowed:
            guess = closest(key, allowed)
            meant = f" did you mean {guess!r}?" if guess else ""
            raise ValueError(
                f"{where}{key[:LONGEST]}: unknown key;{meant} allowed: {', '.join(allowed)}"
            )


def _number(key: str, value: Any) -> float:
    if not is_number(value):
        raise ValueError(f"{key} = {shown(value)}: must be a finite number")
    return float(value)


def _numbers(key: str, value: Any, size: int) -> Any:
    if not isinstance(value, list) or len(value) != size:
        raise ValueError(f"{key} = {shown(value)}: must be a list of {size} numbers")
    return tuple(_number(key, entry) for entry in value)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)) or getattr(value, "ndim", 0) > 0:
        return [_plain(entry) for entry in value]
    return float(value)
