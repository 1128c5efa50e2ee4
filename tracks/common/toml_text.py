"""Nested tables of strings, numbers and lists as TOML text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def to_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """Return `table` as TOML that reads back equal; its own keys come before its subtables."""
    lines = [
        f"{key} = {_value(entry)}\n"
        for key, entry in table.items()
        if not isinstance(entry, Mapping)
    ]
    for key, entry in table.items():
        if isinstance(entry, Mapping):
            inside = to_toml(entry, f"{prefix}{key}.")
            only_tables = entry and all(isinstance(value, Mapping) for value in entry.values())
            head = "" if only_tables else f"\n[{prefix}{key}]\n"
            lines.append(head + inside)
    return "".join(lines)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(float(value))  # numpy's own floats say their type besides
    if isinstance(value, str):
        # TOML's basic strings take JSON's escapes, except that DEL must be escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    raise TypeError(f"TOML has no {type(value).__name__}: {value!r}")
