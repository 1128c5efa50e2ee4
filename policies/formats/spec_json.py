"""A `PolicySpec` as JSON, checked key by key when it is read."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from policies.errors import PolicyError
from policies.spec import DepthEncoding, PolicySpec
from tracks.geometry.camera import Camera

_RANGES: dict[str, tuple[float, float]] = {
    "rate_hz": (1.0, 500.0),
    "hidden_size": (1, 65536),
    "camera.pitch_deg": (-90.0, 90.0),
    "camera.fov_deg": (1.0, 179.0),
    "camera.range_m": (0.1, 1000.0),
    "camera.width": (1, 4096),
    "camera.height": (1, 4096),
    "depth.scale": (1e-6, 1e6),
    "depth.near": (1e-3, 100.0),
    "depth.offset": (-1e6, 1e6),
}


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
    for key, (low, high) in _RANGES.items():
        value: Any = spec
        for part in key.split("."):
            value = getattr(value, part)
        for number in value if isinstance(value, tuple) else (value,):
            if not low <= number <= high:
                raise PolicyError(f"{where}: {key} is {number}, allowed is {low} to {high}")
    if depth.near >= camera.range_m:
        raise PolicyError(
            f"{where}: depth.near is {depth.near} m, allowed is below camera.range_m "
            f"({camera.range_m} m)"
        )
    return spec


def _table(data: Any, where: str, cls: type) -> dict[str, Any]:
    """Return `data` with every value checked against the type of the field's default."""
    if not isinstance(data, Mapping):
        raise PolicyError(f"{where}: is {data!r}, expected a table")
    defaults = cls()
    allowed = [field.name for field in dataclasses.fields(cls)]
    table = {}
    for key, value in data.items():
        if key not in allowed:
            raise PolicyError(f"{where}: unknown key {key!r}, allowed are {', '.join(allowed)}")
        table[key] = _as_type(value, getattr(defaults, key), f"{where}: {key}")
    return table


def _as_type(value: Any, default: Any, where: str) -> Any:
    if isinstance(default, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(default):
            raise PolicyError(f"{where} is {value!r}, expected {len(default)} numbers")
        return tuple(_as_type(v, d, where) for v, d in zip(value, default, strict=True))
    if dataclasses.is_dataclass(default):
        return value
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise PolicyError(f"{where} is {value!r}, expected true or false")
        return value
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value):
        raise PolicyError(f"{where} is {value!r}, expected a finite number")
    if isinstance(default, int):
        if value != int(value):
            raise PolicyError(f"{where} is {value!r}, expected a whole number")
        return int(value)
    return float(value)


def _replace(default: Any, table: dict[str, Any]) -> Any:
    return dataclasses.replace(default, **table)
