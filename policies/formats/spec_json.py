"""A `PolicySpec` as JSON, checked key by key when it is read.

A torch or ONNX file holds one: an object under the key `policy.json`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from policies.spec import DepthEncoding, PolicyError, PolicySpec, check_spec
from tracks.common.files import to_json
from tracks.common.names import unknown_name
from tracks.common.provenance import stamp
from tracks.geometry.camera import Camera
from tracks.input.ranges import is_finite, shown
from tracks.input.reading import InputError, parse_json


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


KEY = "policy.json"
"""Name of the extra file in a torch archive, and of the metadata entry in ONNX."""
SCHEMA = 1
KEYS = ("schema", "suite_version", "git_commit", "seed", "name", "spec")
"""Of the object; what a policy says of itself stands under `spec`."""


def embed(spec: PolicySpec, name: str, seed: int | None) -> str:
    """Return the text that goes under `KEY`."""
    data = {**stamp(SCHEMA, seed), "name": name, "spec": spec_to_json(spec)}
    return to_json(data)


def extract(text: str | bytes | None, where: str) -> PolicySpec:
    """Return the spec that a file holds; the default one where it holds none.

    Args:
        text: what stands under `KEY`, or None.
        where: the file, for the message.

    Raises:
        PolicyError: where the text is not JSON, of a newer schema, or not a spec.
    """
    if not text:
        return PolicySpec()
    where = f"{where}: {KEY}"
    try:
        data: Any = parse_json(text, where)
    except InputError as error:
        raise PolicyError(f"{error}; write it again") from None
    if not isinstance(data, dict) or data.get("schema", SCHEMA) != SCHEMA:
        raise PolicyError(f"{where}: expected an object with schema {SCHEMA}; update the suite")
    for key in data:
        if key not in KEYS:
            raise PolicyError(f"{where}: {unknown_name('key', key, KEYS)}")
    return spec_from_json(data.get("spec", {}), f"{where}: spec")
