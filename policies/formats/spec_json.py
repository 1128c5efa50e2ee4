"""A `PolicySpec` as JSON, checked key by key when it is read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from policies.errors import PolicyError
from policies.spec import DepthEncoding, PolicySpec, check_spec
from tracks.geometry.camera import Camera
from tracks.input.ranges import is_finite, shown


def spec_to_json(spec: PolicySpec) -> dict[str, Any]:
    """Return a spec as a dict of JSON values, nested as the dataclasses are."""
    return dataclasses.asdict(spec)


def spec_from_json(data: Any, where: str) -> PolicySpec:
    """Return the spec that `data` holds; keys that are left out take the default.

    Args:
        data: what `spec_to_json` gave, after JSON.
        where: the file and key it came from, for the message.

    Raises:
        PolicyError: for an unknown key, a wrong type or a value out of range.
    """
    spec = PolicySpec()
    table = _table(data, where, PolicySpec)
    camera = _replace(spec.camera, _table(table.pop("camera", {}), f"{where}.camera", Camera))
    depth = _replace(spec.depth, _table(table.pop("depth", {}), f"{where}.depth", DepthEncoding))
    spec = dataclasses.replace(_replace(spec, table), camera=camera, depth=depth)
    try:
        check_spec(spec, f"{where}: ")
    except ValueError as error:
        raise PolicyError(str(error)) from None
    return spec


def _table(data: Any, where: str, cls: type) -> dict[str, Any]:
    """Return `data` with every value checked against the type of the field's default."""
    if not isinstance(data, Mapping):
        raise PolicyError(f"{where}: is {shown(data)}, expected a table")
    defaults = cls()
    allowed = [field.name for field in dataclasses.fields(cls)]
    table = {}
    for key, value in data.items():
        if key not in allowed:
            raise PolicyError(
                f"{where}: unknown key {shown(key)}, allowed are {', '.join(allowed)}"
            )
        table[key] = _as_type(value, getattr(defaults, key), f"{where}: {key}")
    return table


def _as_type(value: Any, default: Any, where: str) -> Any:
    if isinstance(default, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(default):
            raise PolicyError(f"{where} is {shown(value)}, expected {len(default)} numbers")
        return tuple(_as_type(v, d, where) for v, d in zip(value, default, strict=True))
    if dataclasses.is_dataclass(default):
        return value
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise PolicyError(f"{where} is {shown(value)}, expected true or false")
        return value
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not is_finite(value):
        raise PolicyError(f"{where} is {shown(value)}, expected a finite number")
    if isinstance(default, int):
        if value != int(value):
            raise PolicyError(f"{where} is {shown(value)}, expected a whole number")
        return int(value)
    return float(value)


def _replace(default: Any, table: dict[str, Any]) -> Any:
    return dataclasses.replace(default, **table)
