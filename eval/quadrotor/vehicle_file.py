"""Read, check and write vehicle files (TOML), which describe a quadrotor.

docs/vehicle.md lists the keys. Errors name the file, the key, the value and what is allowed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any

from eval.effects import EFFECTS
from eval.effects.interface import Effect, bound_value
from eval.quadrotor.loops import KINDS, NOMINAL
from eval.vehicles.vehicle import CollisionBox, Controller, MotorMap, Rotors, Vector, Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from tracks.common.figures import with_unit
from tracks.common.files import write_text
from tracks.common.toml_table import (
    REQUIRED,
    Table,
    load_shipped,
    shipped_names,
    to_toml,
    toml_head,
)
from tracks.geometry.camera import Camera
from tracks.input.ranges import as_path, check_type, shown

SCHEMA = 1
"""Version of the file's layout."""
SHIPPED = Path(__file__).resolve().parents[1] / "vehicles"
"""Folder of the vehicle files that the suite ships."""
KEYS = (
    *("name", "schema", "mass", "inertia", "rotors", "controller"),
    *("motors", "body", "camera", "effects"),
)
"""Keys and tables at the top of a file."""

UNUSED_GAIN = (1.0, 1.0, 1.0)
"""The nominal loop's gain of a vehicle with a firmware's loop, where its file gives none [1/s]."""


class VehicleFileError(ValueError):
    """A vehicle file is refused; the message has the key and what is allowed."""


def shipped_vehicles() -> list[str]:
    """Return the names of the vehicles that come with the suite."""
    return shipped_names(SHIPPED)


def load_vehicle(source: str | os.PathLike[str]) -> Vehicle:
    """Return the vehicle of a file, or a shipped one by its name.

    A text counts as a path if it ends in .toml, has a folder or is an existing file.

    Raises:
        VehicleFileError: for a file that cannot be used.
        ValueError: for a source that is neither a path nor a shipped name.
    """
    return load_shipped(source, SHIPPED, "vehicle", parse_vehicle, VehicleFileError)


def parse_vehicle(table: Mapping[str, Any]) -> Vehicle:
    """Return the vehicle that a file's `table` describes.

    Raises:
        ValueError: with the key, the value and what is allowed.
    """
    top = Table("", "", table)
    top.expect(KEYS)
    if top.whole("schema", SCHEMA) != SCHEMA:
        raise top.error("schema", table["schema"], f"{SCHEMA}: this version of the suite reads it")
    vehicle = Vehicle(
        name=top.text("name"),
        mass=top.value("mass", float),
        inertia=top.value("inertia", Vector),
        rotors=top.table("rotors").read(Rotors),
        controller=_controller(top.table("controller")),
        body=top.table("body", {}).read(CollisionBox),
        camera=_camera(top.table("camera", {})),
        motors=top.table("motors").read(MotorMap) if top.has("motors") else None,
    )
    if any(direction not in (1, -1) for direction in vehicle.rotors.spin):
        allowed = "1 (counter-clockwise from above) or -1 each"
        raise top.error("rotors.spin", list(vehicle.rotors.spin), allowed)
    check_vehicle(vehicle)
    effects = _effects(top.table("effects", {}), vehicle)
    return replace(vehicle, effects=MappingProxyType(effects))


def checked_vehicle(vehicle: Vehicle) -> Vehicle:
    """Return `vehicle` after the checks that a file passes.

    Raises:
        ValueError: for another object, or with the key, the value and what is allowed.
    """
    check_type("vehicle", vehicle, (Vehicle,), "a Vehicle")
    parse_vehicle(vehicle_table(vehicle))
    return vehicle


def save_vehicle(vehicle: Vehicle, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write `vehicle` as a file, from which `load_vehicle` reads an equal vehicle.

    The vehicle is checked first, as when a file is read. The file begins with the lines of
    `comment`, and with the versions that wrote it.

    Raises:
        ValueError: for a vehicle that the check refuses.
    """
    check_type("comment", comment, (str,), "a text")
    table = vehicle_table(checked_vehicle(vehicle))
    if "kind" in table["controller"] and vehicle.controller.rate_gain == UNUSED_GAIN:
        del table["controller"]["rate_gain"]  # a number that nobody gave, should `kind` become p
    write_text(as_path("path", path), toml_head(comment, SCHEMA) + to_toml(table))


def vehicle_table(vehicle: Vehicle) -> dict[str, Any]:
    """Return `vehicle` as the nested table of its file: strings, numbers, lists and dicts.

    Raises:
        ValueError: for an unknown effect, or a part of another type.
    """
    _check_parts(vehicle)
    camera, effects = vehicle.camera, {}
    for name in EFFECTS:
        if name in vehicle.effects:
            values = vehicle.effects[name]
            write = EFFECTS[name].write or (lambda values: _plain(values._asdict()))
            try:
                effects[name] = write(values)
            except (TypeError, ValueError):
                key, allowed = f"effects.{name}", "numbers, as in docs/vehicle.md"
                raise ValueError(f"{key} is {shown(values)}, allowed are {allowed}") from None
    return {
        "name": vehicle.name,
        "schema": SCHEMA,
        "mass": vehicle.mass,
        "inertia": _listed(vehicle.inertia),
        "rotors": {**_plain(vars(vehicle.rotors)), "spin": _listed(vehicle.rotors.spin)},
        "controller": _controller_table(vehicle.controller),
        "body": _plain(vars(vehicle.body)),
        "camera": {
            "pitch_deg": camera.pitch_deg,
            "fov_deg": _listed(camera.fov_deg),
            "range": camera.range_m,
        },
        **({"motors": _plain(vars(vehicle.motors))} if vehicle.motors else {}),
        **({"effects": effects} if effects else {}),
    }


def _check_parts(vehicle: Vehicle) -> None:
    """Refuse a vehicle with a part of another type, such as a dict for an effect's values."""
    parts = {"rotors": Rotors, "controller": Controller, "body": CollisionBox, "camera": Camera}
    for name, kind in parts.items():
        check_type(name, getattr(vehicle, name), (kind,), f"a {kind.__name__}")
    check_type("motors", vehicle.motors, (MotorMap, NoneType), "a MotorMap or None")
    check_type("effects", vehicle.effects, (Mapping,), "values by name of the effect")
    for name, values in vehicle.effects.items():
        kind = EFFECTS.find(name).values
        fields = ", ".join(f"{field}=..." for field in getattr(kind, "_fields", ()))
        allowed = f"EFFECTS[{name!r}].values({fields}), with EFFECTS of eval.effects"
        check_type(f"effects.{name}", values, (kind,), allowed)
    controller = vehicle.controller
    check_type("controller.kind", controller.kind, (str,), "a text")
    module = KINDS.get(controller.kind)
    if module is not None:
        allowed = f"Settings of {module.__name__}"
        check_type("controller.settings", controller.settings, (module.Settings,), allowed)
    for key in ("width", "height", "rays"):
        check_type(f"camera.{key}", getattr(vehicle.camera, key), (Integral,), "a whole number")


def _effects(tables: Table, vehicle: Vehicle) -> dict[str, Any]:
    """Return the values of the tables [effects.NAME], by name, checked against their bounds."""
    values_of = {}
    for name in tables.values:
        effect, table = EFFECTS.find(name), tables.table(name)
        if effect.read:
            try:
                values_of[name] = effect.read(table.values)
            except ValueError as error:
                raise ValueError(f"effects.{name}: {error}") from error
        else:
            values_of[name] = _effect_values(effect, table, vehicle)
        check_bounds(effect, values_of[name], vehicle)
    return values_of


def _effect_values(effect: Effect, table: Table, vehicle: Vehicle) -> Any:
    """Return the values of an effect whose keys are the names of its parameters."""
    table.expect(parameter.name for parameter in effect.parameters)
    if not table.values:
        names = " or ".join(parameter.name for parameter in effect.parameters)
        raise ValueError(f"effects.{effect.name}: empty; give {names}")
    values = []
    for parameter in effect.parameters:
        default = REQUIRED
        if not parameter.required:
            number = bound_value(parameter.neutral, vehicle)
            default = (number,) * parameter.size if parameter.size else number
        kind: Any = tuple[(float,) * parameter.size] if parameter.size else float  # pyrefly: ignore[not-a-type]
        values.append(table.value(parameter.name, kind, default))
    return effect.values(*values)


def check_bounds(effect: Effect, values: Any, vehicle: Vehicle) -> None:
    """Refuse values of `effect` that are not finite or not physical on `vehicle`.

    Raises:
        ValueError: with the key, the value and the bounds.
    """
    for parameter, value in zip(effect.parameters, values, strict=True):
        low, high = bound_value(parameter.low, vehicle), bound_value(parameter.high, vehicle)
        for number in value if parameter.size else (value,):
            if not (math.isfinite(number) and low <= number <= high):
                raise ValueError(
                    f"effects.{effect.name}.{parameter.name} = {_plain(value)}: "
                    f"must be from {with_unit(f'{low:g} to {high:g}', parameter.unit)}"
                )


def _controller(table: Table) -> Controller:
    """Return the controller of the table [controller], with the settings of a firmware's loop."""
    kind = table.choice("kind", (NOMINAL, *KINDS))
    if kind == NOMINAL:
        return table.read(Controller, ["kind"], kind=kind, settings=None)
    module = KINDS[kind]
    keys = list(module.Settings.__dataclass_fields__)
    settings_table, extra_keys = table, keys
    if module.GROUP:
        settings_table, extra_keys = table.table(module.GROUP, {}), [module.GROUP]
        settings_table.expect(keys)
    # A firmware's loop does not use the nominal loop's gain, so the key may be missing.
    fixed = {} if table.has("rate_gain") else {"rate_gain": UNUSED_GAIN}
    controller = table.read(Controller, ["kind", *extra_keys], kind=kind, settings=None, **fixed)
    settings = {key: settings_table.value(key, float) for key in keys if settings_table.has(key)}
    for key, value in settings.items():
        low, high = module.LIMITS.get(key, (0.0, 1e6))
        if not low <= value <= high:
            raise settings_table.error(key, value, f"from {low:g} to {high:g}")
    return replace(controller, settings=module.Settings(**settings))


def _controller_table(controller: Controller) -> dict[str, Any]:
    """Return the table [controller] of a controller."""
    table = _plain({k: v for k, v in vars(controller).items() if k not in ("kind", "settings")})
    if controller.kind not in KINDS:
        return {**table, "kind": controller.kind}
    settings, group = _plain(vars(controller.settings)), KINDS[controller.kind].GROUP
    return {"kind": controller.kind, **table, **({group: settings} if group else settings)}


def _camera(table: Table) -> Camera:
    """Return the camera of the table [camera]."""
    table.expect(["pitch_deg", "fov_deg", "range"])
    camera = Camera()
    return replace(
        camera,
        pitch_deg=table.value("pitch_deg", float, camera.pitch_deg),
        fov_deg=table.value("fov_deg", tuple[float, float], camera.fov_deg),
        range_m=table.value("range", float, camera.range_m),
    )


def _plain(value: Any) -> Any:
    """Return a value as dicts, lists and floats, as TOML has them; others are unchanged."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)) or getattr(value, "ndim", 0) > 0:
        return [_plain(entry) for entry in value]
    try:
        return value if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError, OverflowError):
        return value


def _listed(value: Any) -> Any:
    """Return a tuple or an array as a list; others are unchanged."""
    return list(value) if isinstance(value, tuple) or getattr(value, "ndim", 0) > 0 else value
